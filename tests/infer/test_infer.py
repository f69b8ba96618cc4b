"""Photophysics from traces: known rates come back, within their own intervals."""

from __future__ import annotations

import json

import numpy as np
import pytest
from benchmarks.inference import CASES, recorded, truths
from scipy import stats

import napari_mufasa as nm
from napari_mufasa import MufasaError
from napari_mufasa.infer.hidden import BLEACHED, BRIGHT, Hidden
from napari_mufasa.traces.extract import held_share


def test_shares_of_a_frame_are_those_of_the_chain():
    hidden = Hidden(bleaching=1.0, off=8.0, back=5.0, starts_bright=0.4)
    within = hidden.within(0.1)
    ends = within.sum(axis=0)
    np.testing.assert_allclose(ends.sum(axis=1), 1.0)
    np.testing.assert_allclose(ends @ ends, hidden.between(0.2), atol=1e-12)
    assert within[-1, BRIGHT, BRIGHT] == pytest.approx(np.exp(-0.9), rel=0.1)  # or back before it was looked at
    assert within[0, BLEACHED, BLEACHED] == 1
    # Mean share of a frame that begins bright: ∫ of the chance to be bright, by fine steps.
    step = hidden.between(0.1 / 1000)
    at, total = np.array([1.0, 0.0, 0.0]), 0.0
    for _ in range(1000):
        total += at[BRIGHT] / 1000
        at = at @ step
    shares = np.linspace(0, 1, len(within)) @ within[:, BRIGHT].sum(axis=1)
    assert shares == pytest.approx(total, rel=0.01)


def test_where_in_a_frame_a_molecule_switches_is_anywhere():
    hidden = Hidden(bleaching=1e-3)  # so slow that a frame has one switch at most
    ends = hidden.within(0.1)[:, BRIGHT, BLEACHED]
    shares, chances = np.linspace(0, 1, len(ends)), ends / ends.sum()
    mean = chances @ shares
    assert mean == pytest.approx(1 / 2, rel=1e-3)  # of a uniform share
    assert chances @ (np.square(shares - mean) + hidden.widths) == pytest.approx(1 / 12, rel=1e-3)


def test_how_long_a_frame_is_bright_scatters_as_in_fine_steps():
    hidden = Hidden(bleaching=1.0, off=8.0, back=5.0)
    within = hidden.within(0.1)[:, BRIGHT].sum(axis=1)
    shares = np.linspace(0, 1, len(within))
    found = within @ (np.square(shares) + hidden.widths) - (within @ shares) ** 2
    rng, steps, n = np.random.default_rng(2), 200, 40_000
    step = hidden.between(0.1 / steps).cumsum(axis=1)
    at, bright = np.full(n, BRIGHT), np.zeros(n)
    for _ in range(steps):
        bright += at == BRIGHT
        at = (rng.random(n)[:, None] > step[at]).sum(axis=1)
    # Two switches in one part are none to the chain: a few in a hundred here; the sample's variance is known to 1 %.
    assert found == pytest.approx(np.var(bright / steps), rel=0.06)


def test_counts_without_their_background_have_no_baseline():
    ccd = {"camera.type": "CCD", "camera.em_gain": None, "camera.electrons_per_adu": 2.0}
    model = nm.preset("FF").with_values(ccd)
    rng = np.random.default_rng(3)
    electrons = rng.poisson(0.9 * nm.simulate_emission(model, 30, seed=3)) + rng.normal(0, 5, (30, 100))
    one = nm.infer_photophysics(electrons, model).values["level_e"]
    assert one.value == pytest.approx(0.9 * nm.predict(model).emitted_photons_per_frame, rel=0.05)
    for counts, taken_off in ((electrons / 2, True), (electrons / 2 + model.camera.baseline_adu - 0.5, False)):
        two = nm.infer_photophysics(counts, model, unit="adu", background_subtracted=taken_off).values["level_e"]
        assert two.value == pytest.approx(one.value, rel=1e-3)


def test_counts_coarser_than_the_noise_are_told():
    """A count of the preset Blinking is 20.74 electrons, of which a dark pixel's noise is a fifth: such light is read
    up to a quarter too bright, whatever the interval says. With a finer converter, or a register, it is right."""
    model = nm.preset("Blinking")
    traces = np.random.default_rng(0).poisson(0.9 * nm.simulate_emission(model, 60, seed=3)).astype(float)
    traces += np.random.default_rng(1).normal(0, 15, traces.shape)
    for epa, told in ((20.74, True), (8.5, True), (7.5, False), (1.0, False)):  # noise 4.1: √(0.9² · 18 + 1.58²)
        found = nm.infer_photophysics(traces, model.with_values({"camera.electrons_per_adu": epa}))
        assert any("rounding is not right on average" in note for note in found.notes) == told
    register = nm.preset("FF").camera.model_copy(update={"electrons_per_adu": 20.74})
    found = nm.infer_photophysics(traces, model.model_copy(update={"camera": register}))
    assert not any("rounding" in note for note in found.notes)


def test_a_background_in_the_traces_is_no_light_of_molecules(tmp_path):
    """One pixel of each, as a TIFF of counts holds it: with 10 photoelectrons of background the level was twice the
    right one, and no bleaching was told. 4 sd: by chance once in 16 000."""
    import tifffile
    from typer.testing import CliRunner

    from napari_mufasa.cli.app import app

    model = nm.preset("FF").with_values(CASES["FF"])
    camera, share = model.camera, held_share("brightest_pixel", model.sigma_px)
    background = np.random.default_rng(1).poisson(10.0, (120, model.acquisition.n_frames))
    electrons = share * recorded(model, 120, seed=77) + background
    counts = electrons * camera.em_gain / camera.electrons_per_adu + camera.baseline_adu
    tifffile.imwrite(tmp_path / "t.tif", np.clip(counts, 0, 65535).astype(np.uint16).T)
    model.to_json(tmp_path / "model.json")
    paths = [str(tmp_path / name) for name in ("t.tif", "model.json", "out.json", "report.json")]
    given = ["infer", paths[0], "--model", paths[1], "--out", paths[2], "--report", paths[3]]
    told = CliRunner().invoke(app, given, catch_exceptions=False)
    assert told.exit_code == 0 and "were taken off as background" in told.output
    values = json.loads((tmp_path / "report.json").read_text())["values"]
    for key, least in (("level_e", 0.03), ("cycles_before_bleaching", 0.0)):  # the background is known to 0.1 of 5
        truth, value = truths(model)[key], values[key]
        assert abs(value["value"] - truth) < max(4 * value["sd"], least * truth), key
    bright = recorded(model.with_values({"fluorophore.cycles_before_bleaching": None}), 40, seed=2) + 10.0
    with pytest.raises(MufasaError, match="too few molecules go dark"):
        nm.infer_photophysics(bright, model, background_subtracted=False)


@pytest.mark.parametrize("name", ["FF", "Blinking", "PALM"])
def test_rates_come_back(name):
    model = nm.preset(name).with_values(CASES[name])
    # Believed otherwise: what is inferred must not rest on it.
    believed = model.with_values(
        {"excitation.power_density_w_per_cm2": 9.0, "fluorophore.cycles_before_bleaching": None}
    )
    found = nm.infer_photophysics(recorded(model, 200, seed=77), believed, all_molecules=True)
    for key, truth in truths(model).items():
        value = found.values[key]
        # 4 sd: by chance once in 16 000 numbers. 200 molecules tell rates to 7 to 12 %, light to 1 %.
        assert abs(value.value - truth) < 4 * value.sd, key
        assert value.sd < (0.02 if key in ("level_e", "k01_per_s") else 0.15) * truth, key
    assert nm.predict(found.model).detected_e_per_frame == pytest.approx(found.values["level_e"].value, rel=0.01)
    assert nm.predict(found.model).bleaching_time_s == pytest.approx(nm.predict(model).bleaching_time_s, rel=0.4)
    json.dumps(found.report())


@pytest.mark.slow
def test_values_are_unbiased_and_intervals_hold_the_truth():
    model = nm.preset("Blinking").with_values(CASES["Blinking"] | {"acquisition.n_frames": 250})
    ratios, held = [], []
    for seed in range(30):
        found = nm.infer_photophysics(recorded(model, 200, seed), model, all_molecules=True)
        told = truths(model)
        ratios.append([found.values[key].value / truth for key, truth in told.items()])
        held.append([found.values[key].holds(truth) for key, truth in told.items()])
    error = np.std(ratios, axis=0) / np.sqrt(30)
    assert (np.abs(np.mean(ratios, axis=0) - 1) < 0.05 + 2 * error).all()
    # Where an interval holds in 90 % of cases, so few happen once in 1000: binom.ppf(1e-3, 30, 0.9) = 21.
    assert (np.sum(held, axis=0) >= stats.binom.ppf(1e-3, 30, 0.9)).all()


def test_a_molecule_that_fits_badly_does_not_hold_up_the_fit():
    """One of these 200 molecules rules the information where the fit begins: steps by that alone come to a seventh of
    the cycles before they are used up. A right number is off by four of its errors once in 16 000 times."""
    model = nm.preset("STORM").with_values(CASES["STORM"])
    found = nm.infer_photophysics(recorded(model, 200, 27), model, all_molecules=True)
    for name in ("cycles_before_bleaching", "isc_ratio", "triplet_decay_rate_per_s"):
        value = found.values[name]
        assert abs(value.value - truths(model)[name]) < 4 * value.sd, name


def extracted(cycles, seed, **options):
    """A model of 100 molecules that bleach after so many cycles, and their traces from its movie."""
    model = nm.preset("FF").with_values(
        {"acquisition.n_frames": 150, "acquisition.shape_px": (160, 160), "sample.n_molecules": 100,
         "sample.layout": "grid", "excitation.power_density_w_per_cm2": 6.0,
         "fluorophore.cycles_before_bleaching": cycles}
    )  # fmt: skip
    result = nm.simulate(model, seed=seed)
    places = {"positions_px": result.positions_px, "psf_sigma_px": model.sigma_px}
    return model, nm.extract_traces(result.movie, model.camera, **places, **options)


def test_molecules_of_a_movie():
    model, traces = extracted(cycles=1.5e4, seed=5)
    found = nm.infer_photophysics(traces, model)
    told = truths(model)
    assert found.values["level_e"].value == pytest.approx(told["level_e"], rel=0.05)
    cycles = found.values["cycles_before_bleaching"]
    assert abs(cycles.value - told["cycles_before_bleaching"]) < 4 * cycles.sd


def test_molecules_too_short_lived_to_be_found_are_allowed_for():
    """Of molecules that live for 4 frames on average, those found live for 6.3: they shone in 3 frames."""
    four_frames = 4 * nm.predict(nm.preset("FF")).k01_per_s * nm.preset("FF").acquisition.frame_length_s
    model = nm.preset("FF").with_values(
        {"acquisition.n_frames": 60, "fluorophore.cycles_before_bleaching": four_frames}
    )
    found = nm.infer_photophysics(recorded(model, 300, seed=0), model)
    cycles = found.values["cycles_before_bleaching"]
    assert abs(cycles.value - four_frames) < 4 * cycles.sd < 0.4 * four_frames  # by chance once in 16 000
    assert any("left out" in note for note in found.notes)


def test_a_window_before_bleaching_does_not_prolong_lives():
    """Molecules lit in the 50 frames before they bleach live for 50 frames more than others."""
    model, traces = extracted(cycles=1.2e4, seed=0, window=50)
    found = nm.infer_photophysics(traces, model)
    cycles = found.values["cycles_before_bleaching"]
    assert abs(np.log(cycles.value / 1.2e4)) < 3 * cycles.sd / cycles.value < 0.6  # by chance once in 370; 0.67 if not
    assert any("window = 50" in note for note in found.notes)


def test_light_that_hardly_scatters_on_a_high_background_leaves_other_errors_alone():
    model = nm.preset("FF").with_values(
        {"acquisition.n_frames": 150, "acquisition.shape_px": (160, 160), "sample.n_molecules": 100,
         "sample.layout": "grid", "excitation.power_density_w_per_cm2": 6.0, "camera.em_gain": 30.0,
         "camera.read_noise_e": 10.0, "optics.background_photons_per_px": 200.0,
         "fluorophore.cycles_before_bleaching": 1.21e4}
    )  # fmt: skip
    traces = nm.extract_traces(nm.simulate(model, seed=1).movie, model.camera, psf_sigma_px=model.sigma_px)
    found = nm.infer_photophysics(traces, model)
    level = found.values["level_e"]  # its error was 500 times the level, and no rate was told
    assert level.sd < 0.05 * level.value
    assert abs(level.value - nm.predict(model).detected_e_per_frame) < 4 * level.sd  # by chance once in 16 000
    assert found.values["cycles_before_bleaching"].holds(1.21e4)


def test_a_background_left_over_is_told_where_nothing_is_dark():
    model = nm.preset("FF").with_values({"acquisition.n_frames": 40, "fluorophore.cycles_before_bleaching": None})
    found = nm.infer_photophysics(recorded(model, 20, seed=1), model)
    assert any("left of the background" in note for note in found.notes)


def test_brightness_that_differs_is_no_noise():
    model = nm.preset("FF").with_values(CASES["FF"])
    traces = recorded(model, 120, seed=3) * np.random.default_rng(3).lognormal(0, 0.25, (120, 1))
    found = nm.infer_photophysics(traces, model, all_molecules=True)
    # The sd of 120 molecules is known to 6.5 %; four of them, and what short lives blur.
    assert found.values["brightness_spread"].value == pytest.approx(0.25, rel=0.35)
    # The level is the mean of 120 molecules that differ so: it is no better known than that mean (their number and the
    # spread, drawn and shrunk, leave a third of doubt).
    level = found.values["level_e"]
    assert level.sd / level.value == pytest.approx(0.25 / np.sqrt(120), rel=1 / 3)
    cycles = found.values["bleaching_rate_per_s"]
    assert abs(cycles.value - 1 / nm.predict(model).bleaching_time_s) < 4 * cycles.sd


def test_molecules_that_are_alike_have_no_factors_of_their_own():
    model = nm.preset("FF").with_values({"acquisition.n_frames": 60})
    found = [nm.infer_photophysics(recorded(model, 60, seed), model, all_molecules=True) for seed in range(20)]
    # Three standard errors: one set in 700. More than one of 20 happens once in 2600.
    assert sum("brightness_spread" in each.values for each in found) <= stats.binom.isf(1e-3, 20, 1 / 700)


def test_what_does_not_show_is_told():
    model = nm.preset("FF").with_values({"acquisition.n_frames": 60, "fluorophore.cycles_before_bleaching": None})
    found = nm.infer_photophysics(recorded(model, 40, seed=1), model)
    assert "below" in found.unknown["bleaching_rate_per_s"] and "dark state" in found.unknown["isc_ratio"]
    assert found.model.fluorophore.cycles_before_bleaching is None
    assert any("only as their product" in note for note in found.notes)


@pytest.mark.parametrize(
    ("shape", "words"), [((3, 100), "too few"), ((20, 5), "too short"), ((20, 50), "no trace is bright")]
)
def test_bad_traces_are_named(shape, words):
    with pytest.raises(MufasaError, match=words):
        nm.infer_photophysics(np.zeros(shape), nm.preset("FF"))


def test_traces_of_the_brightest_pixel_hold_a_share_of_the_light(tmp_path):
    from typer.testing import CliRunner

    from napari_mufasa.cli.app import app

    model = nm.preset("FF").with_values(CASES["FF"])
    share = held_share("brightest_pixel", model.sigma_px)
    model.to_json(tmp_path / "model.json")
    electrons = share * recorded(model, 20, seed=2)
    molecule, frame = np.indices(electrons.shape)
    table = np.stack([molecule.ravel(), frame.ravel(), electrons.ravel()], axis=1)
    np.savetxt(tmp_path / "t.csv", table, delimiter=",", header="molecule,frame,photoelectrons", comments="")
    paths = [str(tmp_path / name) for name in ("t.csv", "model.json", "out.json")]
    given = ["infer", paths[0], "--model", paths[1], "--out", paths[2], "--profile", "brightest_pixel"]
    told = CliRunner().invoke(app, given, catch_exceptions=False)
    assert told.exit_code == 0
    found = nm.Model.from_json(paths[2])
    assert nm.predict(found).k01_per_s == pytest.approx(nm.predict(model).k01_per_s, rel=0.05)
