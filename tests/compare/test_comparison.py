"""Whole comparisons: a right model reaches the floor, a wrong one does not (docs/comparison.md)."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.blind import generator
from tests.real_data import real_data

import napari_mufasa as nm
from napari_mufasa.compare import (
    compare_movie,
    compare_traces,
    comparison,
    difference_interval,
    distributions,
    to_photoelectrons,
)
from napari_mufasa.compare.comparison import is_without_background
from napari_mufasa.compare.distributions import Sample, dwell_frames, survival, until_bleaching
from napari_mufasa.compare.fit import Fit
from napari_mufasa.effects import effect_class
from napari_mufasa.files.traces import read_traces
from napari_mufasa.files.whole import write_json
from napari_mufasa.traces.darkness import dark_level
from napari_mufasa.traces.dynamics import dynamics
from napari_mufasa.traces.extract import held_share

MODELS = Path(__file__).resolve().parents[2] / "docs" / "models"


@pytest.fixture(scope="module")
def bleaching():
    """An independent movie with bleaching, the belief right but for 12 % errors of brightness and background."""
    movie = generator.make(generator.base_model("emccd_bleach"), seed=4, n_molecules=50)
    model = nm.Model.from_dict(movie.believed)
    return movie, model, compare_movie(movie.movie, model, movie.dark, seed=1, n_bootstrap=20)


def test_a_fitted_right_model_reaches_the_floor(bleaching):
    _, _, found = bleaching
    assert found.w1["fitted"] <= 1.5 * found.w1["floor"]
    assert found.w1["fitted"] <= found.w1["mufasa"] + 0.5 * found.w1["floor"]
    assert found.w1["fitted"] < 0.5 * found.w1["poisson"]  # Poisson never bleaches


def test_the_report_is_plain_data(bleaching, tmp_path):
    _, _, found = bleaching
    write_json(tmp_path / "report.json", found.report())
    report = json.loads((tmp_path / "report.json").read_text())
    assert set(report["w1"]) == {"mufasa", "poisson", "sofi", "fitted", "floor", "unit"}
    assert report["w1"]["unit"] == "photoelectrons per frame"
    assert set(report["distributions"]) == {"counts", "autocorrelation", "on_times", "off_times", "survival", "levels"}
    for curve in report["distributions"].values():
        assert len(curve["x"]) == len(curve["measured"]) == len(curve["mufasa"])
    assert nm.Model.from_dict(report["fitted_model"]) == found.fit.model


def test_the_fit_knows_the_brightness(bleaching):
    case, model, found = bleaching
    true = case.truth["true_values"]
    believed = nm.simulate_emission(model.with_values({"fluorophore.cycles_before_bleaching": None}), 50, seed=1)
    per_s = believed.mean() / model.acquisition.frame_length_s * model.optics.collection_efficiency
    fitted = per_s * found.fit.model.optics.brightness_correction
    assert fitted / true["photons_per_s_per_molecule"] == pytest.approx(1.0, abs=0.1)
    background = found.fit.model.optics.background_photons_per_px
    assert background / true["background_photons_per_px"] == pytest.approx(1.0, abs=0.05)


def test_a_fit_that_leads_away_is_told_and_not_offered(bleaching, monkeypatch):
    _, model, found = bleaching
    assert found.nearer == "fitted" and comparison.FIT_FAILED not in found.notes
    brighter = model.with_values({"optics.brightness_correction": 3 * model.optics.brightness_correction})
    monkeypatch.setattr(comparison, "fit_model", lambda traces, believed, simulate: Fit(brighter, {}))
    led_away = compare_traces(found.samples["measured"].traces, model, seed=1, n_bootstrap=5)
    assert led_away.nearer == "mufasa" and led_away.report()["notes"][-1] == comparison.FIT_FAILED
    unseen = replace(led_away, w1=led_away.w1 | {"mufasa": None})  # the model as it is shows no molecule
    assert unseen.nearer == "fitted"


@pytest.mark.parametrize("seed", [1, 2])
def test_the_right_model_of_molecules_mostly_unseen_reaches_the_floor(seed):
    """Bright molecules in the places of all candidates, the dim ones that were found among them, would be too many and
    too bright: W1 is 1.7 and 1.8 floors then."""
    model = nm.Model.from_json(MODELS / "smfret_ixon.json").in_shape(n_frames=300, shape_px=(96, 160))
    model = model.with_values({"sample.n_molecules": 150, "optics.brightness_correction": 3.0})
    dim = effect_class("dim_population")(number_ratio=3.5, brightness=0.2)
    model = model.model_copy(update={"effects": (dim,)})
    movie = nm.simulate(model, seed=100 + seed).movie
    found = compare_movie(movie, model, fit=False, seed=seed, max_steps=1, n_bootstrap=20)
    assert found.w1["mufasa"] < 1.25 * found.w1["floor"]
    n, kept = (len(found.samples[name].traces) for name in ("measured", "mufasa"))
    assert abs(kept / 4 - n) < 3 * np.sqrt(n)  # four movies were simulated


def test_same_seed_same_numbers(bleaching):
    movie, model, found = bleaching
    again = compare_movie(movie.movie, model, movie.dark, seed=1, fit=False, n_bootstrap=5)
    assert again.w1["mufasa"] == found.w1["mufasa"]
    assert again.w1["sofi"] == found.w1["sofi"]


def test_traces_alone_in_every_unit():
    model = nm.Model.from_dict(generator.base_model("emccd")).with_values({"acquisition.n_frames": 60})
    from napari_mufasa.compare.simulated import FarApart
    from napari_mufasa.traces import Options

    options = Options(psf_sigma_px=model.sigma_px, profile="brightest_pixel", subtract_background=False)
    field = FarApart(model.sigma_px, 100, options, seed=9)
    electrons = field.traces(field.acquisitions(model, 9)["mufasa"])
    camera = model.camera
    raw = electrons * camera.em_gain / camera.electrons_per_adu + camera.baseline_adu - 0.5
    np.testing.assert_allclose(to_photoelectrons(raw, model, "adu"), electrons, rtol=1e-4, atol=1e-3)
    # Where the background was taken off, so was the baseline.
    above = electrons * camera.em_gain / camera.electrons_per_adu
    told = to_photoelectrons(above, model, "adu", background_subtracted=True)
    np.testing.assert_allclose(told, electrons, rtol=1e-4, atol=1e-3)
    # Where nobody says, counts are as recorded.
    said = {(u, off): is_without_background(u, off) for u in ("adu", "photons") for off in (None, True, False)}
    assert [key for key, without in said.items() if without] == [("adu", True), ("photons", None), ("photons", True)]
    settings = {"profile": "brightest_pixel", "background_subtracted": False, "fit": False, "n_bootstrap": 5}
    one = compare_traces(electrons, model, **settings)
    two = compare_traces(np.round(raw).astype(np.uint16), model, unit="adu", **settings)
    assert two.w1["mufasa"] == pytest.approx(one.w1["mufasa"], abs=0.05)
    # Made by this very model: at the floor. Twice as bright: far from it.
    assert one.w1["mufasa"] < 2 * one.w1["floor"]
    bright = model.with_values({"optics.brightness_correction": 2.0})
    assert compare_traces(electrons, bright, **settings).w1["mufasa"] > 5 * one.w1["floor"]


def test_a_file_of_traces_says_itself_what_it_holds(tmp_path):
    """Counts without background of smFRET software, counts as recorded of a TIFF: each read as what it is, by all."""
    import struct

    import tifffile

    from napari_mufasa.discover.trace_bench import TraceBench
    from napari_mufasa.files.traces import read_trace_file

    model = nm.preset("FF").with_values(
        {"camera.type": "CCD", "camera.em_gain": None, "camera.electrons_per_adu": 2.0, "camera.read_noise_e": 5.0,
         "acquisition.n_frames": 80, "excitation.power_density_w_per_cm2": 10.0}
    )  # fmt: skip
    rng, shape = np.random.default_rng(3), (60, 80)
    electrons = rng.poisson(0.9 * nm.simulate_emission(model, 60, seed=3)) + rng.normal(0, 5, shape)
    rows = np.repeat(electrons / 2, 2, axis=0).round().astype("<i2")
    (tmp_path / "a.traces").write_bytes(struct.pack("<ih", 80, 120) + rows.T.tobytes())
    pixel = electrons / 2 + model.camera.baseline_adu + 9 - 0.5  # 18 photoelectrons of background; the floor to counts
    tifffile.imwrite(tmp_path / "a.tif", pixel.T.round().astype(np.uint16))
    plain, raw = read_trace_file(tmp_path / "a.traces"), read_trace_file(tmp_path / "a.tif")
    for found, held in ((plain, 0.0), (raw, 18.0)):
        compared = compare_traces(found, model, fit=False, n_bootstrap=2).samples["measured"]
        assert compared.traces.mean() == pytest.approx(electrons.mean() + held, abs=0.6)
        diagnosed = TraceBench(found, model)
        assert diagnosed.background_subtracted == (held == 0)
        inferred = nm.infer_photophysics(found, model)
        share = 1.0 if held == 0 else held_share("brightest_pixel", model.sigma_px)
        level = inferred.values["level_e"].value * share
        assert level == pytest.approx(0.9 * nm.predict(model).emitted_photons_per_frame, rel=0.05)
        for call in (compare_traces, nm.infer_photophysics, nm.diagnose_traces):
            with pytest.raises(nm.MufasaError, match="are in adu, not in photons"):
                call(found, model, unit="photons")


def test_extracted_traces_are_not_taken_for_counts():
    model = nm.Model.from_dict(generator.base_model("cmos")).in_shape(n_frames=30, shape_px=(48, 48))
    places = np.array([[12.0, 12.0], [12.0, 34.0], [34.0, 12.0], [34.0, 34.0], [23.0, 23.0]])
    movie = nm.simulate(model, places, seed=1).movie
    kept = nm.extract_traces(movie, model.camera, psf_sigma_px=model.sigma_px, subtract_background=False)
    found = compare_traces(kept, model, fit=False, n_bootstrap=2)
    np.testing.assert_array_equal(found.samples["measured"].traces, kept.traces)
    assert found.w1["mufasa"] < found.samples["measured"].dynamics.on_level.mean()  # its background is simulated, too
    for call in (compare_traces, nm.infer_photophysics):
        with pytest.raises(nm.MufasaError, match="are in photoelectrons, not in adu"):
            call(kept, model, unit="adu")


def test_one_pixel_traces_equal_those_of_a_movie():
    """The short cut (one pixel per molecule) against the field of images, in distribution."""
    from napari_mufasa.compare import floor, wasserstein
    from napari_mufasa.compare.simulated import FarApart, recorded
    from napari_mufasa.traces import Options, extract_traces

    model = nm.Model.from_dict(generator.base_model("emccd")).with_values({"acquisition.n_frames": 40})
    options = Options(psf_sigma_px=model.sigma_px, profile="brightest_pixel", subtract_background=False)
    quick = FarApart(model.sigma_px, 200, options, seed=3)
    slow = FarApart(model.sigma_px, 200, options, seed=3)
    one = quick.traces(quick.acquisitions(model, 5)["mufasa"])
    slow.one_pixel = False
    at = np.arange(10, 10 + 15 * 15, 15.0)
    offset = np.random.default_rng(0).uniform(-0.5, 0.5, (225, 2))
    slow.positions_px = (np.stack(np.meshgrid(at, at, indexing="ij"), axis=-1).reshape(-1, 2) + offset)[:200]
    slow.shape_px = (240, 240)
    acquisition = slow.acquisitions(model, 5)["mufasa"]
    movie = recorded(acquisition)
    other = extract_traces(movie, model.camera, options=options, positions_px=slow.positions_px).all_traces
    assert wasserstein(one, other) < 2 * floor(one).value


@pytest.mark.parametrize("profile", ["brightest_pixel", "sum"])
def test_traces_without_images_begin_as_bright_as_they_go_on_where_the_image_lags(profile):
    """The sensor was in the light of the first frame before it."""
    from napari_mufasa.compare.simulated import FarApart
    from napari_mufasa.traces import Options

    model = nm.preset("FF").with_values({"acquisition.n_frames": 40, "fluorophore.cycles_before_bleaching": None})
    model = model.with_effects(effect_class("image_lag")(fraction=0.4, kept=0.8, form="decaying"))
    field = FarApart(
        model.sigma_px,
        1500,
        Options(psf_sigma_px=model.sigma_px, profile=profile, subtract_background=False),
        3,
        quick=True,
    )
    traces = field.traces(field.acquisitions(model, 5)["mufasa"])
    start, later = traces[:, :2].mean(axis=1), traces[:, 20:].mean()
    assert start.mean() == pytest.approx(later, abs=4 * start.std() / np.sqrt(1500) + 0.01 * later)


@pytest.mark.parametrize("camera", ["emccd", "cmos"])
@pytest.mark.parametrize(
    ("profile", "subtracted"), [("psf", True), ("sum", True), ("brightest_pixel", True), ("psf", False)]
)
def test_traces_without_images_equal_those_of_images(camera, profile, subtracted):
    """The quick way against movies and extraction: level, noise, and distribution."""
    from napari_mufasa.compare import floor, wasserstein
    from napari_mufasa.compare.simulated import FarApart
    from napari_mufasa.traces import Options

    model = nm.Model.from_dict(generator.base_model(camera)).with_values({"acquisition.n_frames": 60})
    options = Options(psf_sigma_px=model.sigma_px, profile=profile, subtract_background=subtracted)
    quick = FarApart(model.sigma_px, 100, options, 3, quick=True)
    slow = FarApart(model.sigma_px, 100, options, 3)
    one = quick.traces(quick.acquisition(model, 5))
    two = slow.traces(slow.acquisition(model, 6))
    noise = [float(np.mean(traces.std(axis=1))) for traces in (one, two)]
    assert abs(one.mean() - two.mean()) < 0.04 * noise[1] + 0.01 * two.mean()
    assert noise[0] == pytest.approx(noise[1], rel=0.05)
    assert wasserstein(one, two) < 2.5 * floor(two).value


@pytest.mark.parametrize(
    ("preset", "changes"),
    [
        ("FF", {}),  # 96 photoelectrons fill its converter, in one pixel
        ("STORM", {"camera.read_noise_e": 10.0, "camera.electrons_per_adu": 18.0}),  # half of the noise is rounding
        ("Blinking", {"camera.electrons_per_adu": 2.0}),
    ],
)
@pytest.mark.parametrize("light", [45.0, 360.0])
@pytest.mark.parametrize("subtracted", [True, False])
def test_traces_without_images_have_the_noise_of_all_their_pixels(preset, changes, light, subtracted):
    """Whatever one pixel's converter would do to all of a molecule's light. The mean of 16 000 frames is known to 0.008
    of their noise, their variance to 1.1 % in each way, and 0.5 % for places within the pixel."""
    from napari_mufasa.compare.simulated import FarApart
    from napari_mufasa.traces import Options

    shining = {
        "excitation.power_density_w_per_cm2": 2 * light / 0.9 / 67.249, "fluorophore.cycles_before_bleaching": None,
        "acquisition.n_frames": 160,
    }  # fmt: skip
    model = nm.preset("FF").model_copy(update={"camera": nm.preset(preset).camera}).with_values(shining | changes)
    options = Options(psf_sigma_px=model.sigma_px, subtract_background=subtracted)
    quick, slow = (
        field.traces(field.acquisition(model, 5))
        for field in (FarApart(model.sigma_px, 100, options, 3, quick=is_quick) for is_quick in (True, False))
    )
    variance = [float(np.mean(traces.var(axis=1, ddof=1))) for traces in (quick, slow)]
    assert quick.mean() == pytest.approx(slow.mean(), abs=0.035 * np.sqrt(variance[1]) + 0.003 * light)
    assert variance[0] == pytest.approx(variance[1], rel=3 * np.hypot(0.016, 0.005))


@pytest.mark.parametrize("profile", ["psf", "sum"])
def test_the_background_in_a_trace_is_that_of_all_its_pixels(profile):
    """The fit finds the background of a pixel, not of the trace's twenty: known to 2 % from what is left when 95 % have
    bleached, but that what fades smoothly is told from it by moments. exp(-0.3) - exp(-2.7) of the molecules shine for
    ten frames and bleach ten before the end: 0.67, with an sd of 0.04 for 120 of them."""
    from napari_mufasa.compare.simulated import FarApart
    from napari_mufasa.traces import Options

    model = nm.Model.from_dict(generator.base_model("cmos")).with_values({"acquisition.n_frames": 100})
    rate = 3.0 / (100 * model.acquisition.interval_s)
    model = model.with_effects(effect_class("photobleaching")(rate_per_s=rate))
    options = Options(psf_sigma_px=model.sigma_px, profile=profile, subtract_background=False)
    field = FarApart(model.sigma_px, 120, options, 3)
    traces = field.traces(field.acquisition(model, 5))
    found = compare_traces(traces, model, profile=profile, background_subtracted=False, seed=1, n_bootstrap=5)
    bleached = found.samples["measured"].dynamics.bleaching_frame >= 0
    assert bleached.mean() > 0.67 - 3 * 0.04
    background = found.fit.values["optics.background_photons_per_px"]
    assert background == pytest.approx(model.optics.background_photons_per_px, rel=0.15)


def holding_their_background(background, rate_per_movie, n=120, seed=5):
    """A model of 10 background photons per pixel, and traces of one with `background`, 100 frames, profile psf."""
    from napari_mufasa.compare.simulated import FarApart
    from napari_mufasa.traces import Options

    model = nm.Model.from_dict(generator.base_model("cmos")).with_values({"acquisition.n_frames": 100})
    model = model.with_effects(
        effect_class("photobleaching")(rate_per_s=rate_per_movie / (100 * model.acquisition.interval_s))
    )
    options = Options(psf_sigma_px=model.sigma_px, profile="psf", subtract_background=False)
    field = FarApart(model.sigma_px, n, options, 3, quick=True)
    true = model.with_values({"optics.background_photons_per_px": background})
    return model, field.traces(field.acquisition(true, seed))


@pytest.mark.parametrize("background", [3.0, 10.0, 30.0])
@pytest.mark.parametrize("window", [None, 20])
def test_light_is_told_above_the_background_measured(background, window):
    """Whatever is believed of it: by the model's 10 photons, all or none of the molecules would seem to shine."""
    model, traces = holding_their_background(background, 1.5)
    found = compare_traces(traces, model, background_subtracted=False, window=window, fit=False, n_bootstrap=2)
    seen = found.samples["measured"]
    level = nm.predict(model).detected_e_per_frame
    assert np.median(seen.dynamics.on_level) == pytest.approx(level, rel=0.1)
    # exp(-0.1) - exp(-1.4) of them shine for seven frames and bleach seven before the end: 0.66, sd 0.044 of 120.
    # Windows: of the 0.74 that live for 20 frames.
    if window is None:
        assert (seen.dynamics.bleaching_frame >= 0).mean() == pytest.approx(0.66, abs=4 * 0.044)
    else:
        assert len(seen.traces) / 120 == pytest.approx(0.74, abs=4 * 0.04)
    assert not found.notes


def test_a_background_that_nothing_tells_is_the_model_s_or_the_dimmest_trace_s():
    model, traces = holding_their_background(10.0, 1e-3)
    held = np.median(traces)
    for believed, words in ((10.0, "as the model has it"), (30.0, "dimmest trace")):
        here = model.with_values({"optics.background_photons_per_px": believed})
        found = compare_traces(traces, here, background_subtracted=False, fit=False, n_bootstrap=2)
        assert words in found.notes[0]
        assert (found.samples["measured"].dynamics.on_level < held).all()
    assert dark_level(traces) is None


@pytest.mark.parametrize("best", [15, 60])
def test_the_best_are_compared_with_the_best(best):
    """Molecules of unequal brightness. W1 of the right model was 0.2 to 1.1 floors in 24 such tables; with all of its
    molecules beside the best of the measured ones it was 1.9 to 5.6."""
    from napari_mufasa.compare.simulated import FarApart
    from napari_mufasa.traces import Options

    model = nm.Model.from_dict(generator.base_model("cmos")).with_values({"acquisition.n_frames": 40})
    model = model.with_effects(effect_class("brightness_heterogeneity")(spread=0.6))
    field = FarApart(model.sigma_px, 120, Options(psf_sigma_px=model.sigma_px), 3, quick=True)
    traces = field.traces(field.acquisition(model, 5))
    found = compare_traces(traces, model, best=best, window=30, fit=False, n_simulated=480, n_bootstrap=2)
    seen = {name: sample.traces for name, sample in found.samples.items()}
    assert len(seen["measured"]) == best
    assert len(seen["mufasa"]) == pytest.approx(4 * best, rel=0.05)  # of those active in the window
    assert found.w1["mufasa"] < 1.5 * found.w1["floor"]


def test_the_best_of_few_simulated_ones_is_one_at_least():
    """A third of a trace was none: no W1, and a note that no trace is active in a window that nobody gave."""
    model, traces = holding_their_background(10.0, 1.5, n=300)
    found = compare_traces(
        traces, model, background_subtracted=False, best=1, n_simulated=100, fit=False, n_bootstrap=2
    )
    assert all(found.w1[name] > 0 for name in ("mufasa", "poisson", "sofi"))
    assert any(note.startswith("mufasa: W1 rests on 1 trace;") for note in found.notes)
    assert not any("no active trace" in note for note in found.notes)


def test_light_of_all_samples_is_told_above_a_background_of_one_kind(monkeypatch):
    """That believed, where the measured traces do not tell theirs; where they do and the model's do not, it is said."""
    dark, steady = (holding_their_background(10.0, rate) for rate in (1.5, 1e-3))
    held, asked = comparison.background_held, []

    def watched(traces, believed_e, own):
        asked.append(own)
        return held(traces, believed_e, own)

    monkeypatch.setattr(comparison, "background_held", watched)
    given = {"background_subtracted": False, "fit": False, "n_bootstrap": 2}
    found = compare_traces(steady[1], dark[0], **given)
    assert asked == [True, False, False, False] and len(found.notes) == 1
    asked.clear()
    found = compare_traces(dark[1], steady[0], **given)
    assert asked == [True] * 4
    assert [note.split(",")[0] for note in found.notes] == ["mufasa: too few molecules go dark"]
    assert not compare_traces(dark[1], dark[0], **given).notes


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_where_hardly_a_molecule_bleaches_light_and_background_stay_themselves(seed):
    """Their mean is the same in every frame: it could be all background or all light. Brightness 0.0 to 2.9 was fitted,
    and rates up to 15 per movie."""
    model, traces = holding_their_background(10.0, 1e-3, seed=seed)
    bleached = int((compare_traces(traces, model, background_subtracted=False, fit=False, n_bootstrap=2)
                    .samples["measured"].dynamics.bleaching_frame >= 0).sum())  # fmt: skip
    found = compare_traces(traces, model, background_subtracted=False, n_bootstrap=2)
    values = found.fit.values
    assert values["optics.brightness_correction"] == pytest.approx(1.0, abs=0.05)
    assert values["optics.background_photons_per_px"] == pytest.approx(10.0, rel=0.02)
    assert values["photobleaching.rate_per_s"] * 100 * model.acquisition.interval_s < 0.05
    assert any(f"{bleached} of 120 molecules bleach" in note for note in found.notes)
    assert found.w1["fitted"] < 3 * found.w1["floor"]


def test_what_varies_slowly_in_the_measurement_is_found_once(monkeypatch):
    from napari_mufasa.compare import fit

    model, traces = holding_their_background(10.0, 1.5)
    slow, of = fit._slow_variances, []
    monkeypatch.setattr(fit, "_slow_variances", lambda values: of.append(values) or slow(values))
    fit.fit_raw_traces(traces, model, lambda candidate: traces, rounds=3)
    assert len(of) == 1 + 3


@pytest.mark.parametrize("window", [None, 15, 30])
def test_the_fit_knows_the_bleaching_whatever_window_is_kept(window):
    """Molecules that live 40 of 100 frames: of 64, 92 % bleach, 33 are seen in windows of 30 frames, and 83 % of those
    bleach in the 70 frames left: ln(1 - share) has an sd of sqrt(0.83 / (0.17 * 33)) = 0.38 of 1.75, more than in the
    other two. Windows end at the bleaching: they show none."""
    model = nm.Model.from_dict(generator.base_model("emccd")).with_values({"acquisition.n_frames": 100})
    model = model.with_values({"acquisition.shape_px": (136, 136)})
    rate = 1 / (40 * model.acquisition.interval_s)
    model = model.with_effects(effect_class("photobleaching")(rate_per_s=rate))
    places = np.stack(np.meshgrid(*[8.0 + 17 * np.arange(8)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    movie = nm.simulate(model, places, seed=3).movie
    found = compare_movie(movie, model, seed=1, n_bootstrap=5, window=window)
    assert found.fit.values["photobleaching.rate_per_s"] == pytest.approx(rate, rel=3 * 0.38 / 1.75)


def test_molecules_that_were_never_seen_do_not_count_as_not_bleached():
    """Of 200 that live 20 of 100 frames 14 % are gone within three, and are dark in a table of traces. Of the others
    0.7 % are left at the end: 0 to 4 of 172, a share that gives the rate within a fifth and a third."""
    from napari_mufasa.compare.simulated import FarApart
    from napari_mufasa.traces import Options

    model = nm.Model.from_dict(generator.base_model("cmos")).with_values({"acquisition.n_frames": 100})
    rate = 1 / (20 * model.acquisition.interval_s)
    model = model.with_effects(effect_class("photobleaching")(rate_per_s=rate))
    field = FarApart(model.sigma_px, 200, Options(psf_sigma_px=model.sigma_px), 3)
    traces = field.traces(field.acquisition(model, 5))
    found = compare_traces(traces, model, seed=1, n_bootstrap=5)
    assert 0.7 < found.fit.values["photobleaching.rate_per_s"] / rate < 1.25
    assert found.w1["fitted"] < 3 * found.w1["floor"]  # a rate at the lower end of these leaves 2 to 2.5


def test_a_movie_whose_traces_keep_their_background_bleaches_as_well(bleaching):
    """The same molecules, judged by their light above the background in the samples and in the fit."""
    case, model, without = bleaching
    found = compare_movie(case.movie, model, case.dark, seed=1, n_bootstrap=5, subtract_background=False)
    bleached = [(c.samples["measured"].dynamics.bleaching_frame >= 0).mean() for c in (found, without)]
    assert bleached[0] == pytest.approx(bleached[1], abs=0.1)
    assert found.fit.values == pytest.approx(without.fit.values, rel=0.15, abs=0.1)
    assert found.w1["fitted"] <= 1.5 * found.w1["floor"]


def test_a_live_distance_takes_well_under_a_second():
    """What the viewer does when a parameter changes: simulate, W1, floor."""
    import time

    from napari_mufasa.compare import floor, wasserstein
    from napari_mufasa.compare.simulated import FarApart
    from napari_mufasa.traces import Options

    model = nm.Model.from_dict(generator.base_model("emccd"))
    field = FarApart(model.sigma_px, 200, Options(psf_sigma_px=model.sigma_px), 3, quick=True)
    measured = field.traces(field.acquisition(model, 1))
    start = time.process_time()
    w1 = wasserstein(measured, field.traces(field.acquisition(model, 2)))
    lowest = floor(measured).value
    assert time.process_time() - start < 1.0
    assert w1 < 2 * lowest


def test_progress_and_stop_of_a_comparison_of_traces():
    model = nm.Model.from_dict(generator.base_model("emccd"))
    traces = np.random.default_rng(0).normal(100, 25, (20, 30))
    seen: list[tuple[int, int]] = []
    compare_traces(traces, model, n_simulated=30, n_bootstrap=2, progress=lambda *p: seen.append(p))
    assert seen == [(i, 5) for i in range(1, 6)]
    with pytest.raises(nm.Cancelled):
        compare_traces(traces, model, n_simulated=30, cancel=lambda: True)
    with pytest.raises(nm.MufasaError, match="sofi_times"):
        compare_traces(traces, model, n_simulated=30, sofi_times="mine")


def test_autocorrelation_of_known_noise():
    rng = np.random.default_rng(0)
    white = rng.normal(size=(200, 400))
    smooth = white[:, 1:] + 0.5 * white[:, :-1]
    rows = Sample(smooth + 100, dynamics(smooth + 100))
    found = until_bleaching(rows, 4)
    # MA(1): ρ₁ = 0.5/1.25; standard error of 200·399 samples below 0.005.
    np.testing.assert_allclose(found, [1.0, 0.4, 0.0, 0.0], atol=0.015)


def test_dwell_times_count_complete_intervals_only():
    lit = np.array([[1, 1, 0, 0, 0, 1, 0, 1, 1], [1] * 9, [0] * 9], dtype=bool)
    assert sorted(dwell_frames(lit, False)) == [1, 3]
    assert sorted(dwell_frames(lit, True)) == [1]


def test_densities_integrate_to_one():
    rng = np.random.default_rng(0)
    traces = rng.normal(50, 5, (30, 60))
    sample = Sample(traces, dynamics(traces))
    counts = distributions({"measured": sample, "mufasa": sample}, "photoelectrons")["counts"]
    width = counts.x[1] - counts.x[0]
    assert counts.curves["measured"].sum() * width == pytest.approx(1.0, abs=0.01)


def test_one_bright_molecule_does_not_squeeze_the_others_into_a_bin():
    """One in 400 molecules is 40 times as bright as the mean; the bins are where the others are."""
    rng = np.random.default_rng(0)
    level = np.where(np.arange(400) < 1, 4000.0, rng.uniform(50, 150, 400))
    traces = rng.normal(level[:, None], 5.0, (400, 40))
    levels = distributions({"measured": Sample(traces, dynamics(traces))}, "photoelectrons")["levels"]
    assert (levels.x < 150).sum() > 0.9 * len(levels.x)


def test_nothing_to_compare_is_said():
    model = nm.Model.from_dict(generator.base_model("emccd"))
    dark = nm.simulate_dark(model, 30, seed=1)
    with pytest.raises(nm.MufasaError, match="no molecule left"):
        compare_movie(dark, model)
    with pytest.raises(nm.MufasaError, match="unit"):
        compare_traces(np.ones((3, 4)), model, unit="volts")


@pytest.mark.realdata
def test_real_movie_fitted_model_near_the_floor():
    path = real_data("smfret_ixon_emccd.tif")
    import tifffile

    model = nm.Model.from_json(MODELS / "smfret_ixon.json")
    found = compare_movie(tifffile.imread(path), model, seed=1, max_steps=1, n_bootstrap=10)
    assert len(found.samples["measured"].traces) >= 90
    assert found.w1["fitted"] <= 1.5 * found.w1["floor"]


@pytest.mark.realdata
def test_real_egfp_traces_order_and_fit():
    path = real_data("egfp_emccd_traces.tif")
    traces, unit = read_traces(path)
    model = nm.Model.from_json(MODELS / "egfp.json").with_values({"fluorophore.quantum_yield": 1.0})
    adu = model.camera.em_gain / model.camera.electrons_per_adu
    shared = {"unit": unit, "profile": "brightest_pixel", "background_subtracted": False, "pixel_share": 1.0}
    found = compare_traces(traces, model, n_simulated=500, n_bootstrap=10, sofi_times="tool", **shared)
    shown = {name: sample.traces for name, sample in found.samples.items()}
    for near, far in (("mufasa", "poisson"), ("poisson", "sofi")):
        assert difference_interval(shown["measured"], shown[near], shown[far])[1] < 0
    for name, source in (("mufasa", 2263), ("poisson", 2269), ("sofi", 3065)):
        assert found.w1[name] * adu == pytest.approx(source, rel=0.15)
    assert found.w1["fitted"] < 0.2 * found.w1["mufasa"]
    few = compare_traces(
        traces, model, n_simulated=500, n_bootstrap=10, sofi_times="tool", window=50, best=20, **shared
    )
    shown = {name: sample.traces for name, sample in few.samples.items()}
    assert difference_interval(shown["measured"], shown["poisson"], shown["sofi"])[1] < 0
    assert few.w1["fitted"] < 1.5 * few.w1["floor"]


def test_molecules_that_never_shone_are_not_among_those_not_bleached():
    traces = np.random.default_rng(1).normal(0, 1, (8, 40))
    traces[:4, :20] += 50
    assert (dynamics(traces).first[4:] < 0).all()
    np.testing.assert_array_equal(survival(dynamics(traces), 40), [1.0] * 20 + [0.0] * 20)
