"""A table of traces alone: what is hidden in it is found, on molecules that no fit has seen (docs/comparison.md,
docs/discovery.md).
"""

from __future__ import annotations

import numpy as np
import pytest
from tests.blind import generator

import napari_mufasa as nm
from napari_mufasa.compare.fit import fit_gain
from napari_mufasa.compare.simulated import FarApart
from napari_mufasa.discover import diagnose_traces, rules
from napari_mufasa.discover.investigation import TraceInvestigation
from napari_mufasa.discover.trace_bench import TraceBench, candidate_kinds
from napari_mufasa.files.whole import write_json
from napari_mufasa.observe.lone_traces import Eyes, observe_traces, views
from napari_mufasa.traces import Options, extract_traces


@pytest.fixture(scope="module")
def believed():
    return nm.Model.from_dict(generator.base_model("emccd")).with_values({"acquisition.n_frames": 80})


def made(model, n=160, seed=21):
    options = Options(psf_sigma_px=model.sigma_px)
    field = FarApart(model.sigma_px, n, options, seed, quick=True)
    return field.traces(field.acquisition(model, seed))


def test_views_keep_the_mean_and_the_steps():
    values = np.arange(24.0).reshape(2, 12)
    found = {scale: (means, steps) for scale, means, steps in views(values)}
    assert list(found) == [1, 2, 4, 12]
    np.testing.assert_array_equal(found[2][1], 2.0)
    np.testing.assert_allclose(found[4][0][:, 0], values[:, :4].mean(axis=1))
    np.testing.assert_allclose(found[12][0][:, 0], values.mean(axis=1))
    assert found[12][1].size == 0


def test_halves_of_a_table_are_made_of_runs_of_neighbours():
    """What neighbours share must not be fitted on one and judged on the other."""
    light = np.repeat(np.arange(1.0, 5.0), 8)[:, None] * np.ones((1, 40))
    seen = observe_traces(light, Eyes(0.0, 1.0))
    middle = seen.names.index("signal_mean_1_50")
    np.testing.assert_allclose(seen.values[:, middle], [3.0, 3.0, 4.0])  # of 1 2 3 4, of 1 3, of 2 4: upper middle
    assert np.isfinite(seen.values).all() and set(seen.meanings) == set(seen.names)


@pytest.mark.parametrize("subtracted", [True, False])
def test_a_table_is_matched_by_brightness_and_background(believed, subtracted):
    """The believed light is three times too little; of traces that keep it, the background half of what it is."""
    options = Options(psf_sigma_px=believed.sigma_px, profile="brightest_pixel", subtract_background=subtracted)
    blinking = {"kind": "long_dark_state", "off_rate_per_s": 1.5, "dark_time_s": 0.4}
    truth = believed.with_values({"effects": [blinking]})  # without it light and background are told by noise alone
    field = FarApart(truth.sigma_px, 160, options, 21, quick=True)
    traces = field.traces(field.acquisition(truth, 21))
    light, background = (truth.optics.brightness_correction, truth.optics.background_photons_per_px)
    wrong = {"optics.brightness_correction": light / 3}
    if not subtracted:
        wrong["optics.background_photons_per_px"] = background / 2
    bench = TraceBench(traces, truth.with_values(wrong), "photoelectrons", "brightest_pixel", subtracted)
    found = bench.matched(bench.start).optics
    assert found.brightness_correction == pytest.approx(light, rel=0.15)
    assert found.background_photons_per_px == pytest.approx(background, rel=0.1)


def test_only_what_a_trace_shows_is_fitted_beside_effects(believed):
    bench = TraceBench(made(believed), believed)
    paths = {value.path for value in bench.free_values(believed)}
    assert {"optics.brightness_correction", "optics.background_photons_per_px", "camera.read_noise_e"} <= paths
    assert not {"optics.psf_fwhm_nm", "sample.n_molecules", "camera.baseline_adu"} & paths
    for value in bench.free_values(believed):  # to the end of its room it is a value that the model takes
        for end in value.room(believed):
            believed.with_values(value.changes(believed, end))


def test_the_budget_counts_a_table_not_the_field_of_its_model(believed):
    """A model of 512 × 512 pixels would leave a table a quarter of what it may spend."""
    traces = made(believed)
    wide = believed.with_values({"acquisition.shape_px": [512, 512]})
    assert TraceBench(traces, wide).size == traces.size
    assert TraceInvestigation(traces, wide).budget == rules.BUDGET


def test_counts_are_what_photoelectrons_are_with_a_baseline_or_without(believed):
    traces, camera = made(believed), believed.camera
    counts = traces * (camera.em_gain or 1.0) / camera.electrons_per_adu
    level = TraceBench(traces, believed)._electrons.mean()
    without = TraceBench(counts, believed, "adu", background_subtracted=True)
    assert without._electrons.mean() == pytest.approx(level, rel=1e-3)
    # As recorded, with the half that the floor to whole counts takes; what a count is worth is told by the noise.
    kept = TraceBench(counts + camera.baseline_adu - 0.5, believed, "adu")
    _, gain = fit_gain(counts + camera.baseline_adu - 0.5, believed)
    assert not kept.background_subtracted and kept._electrons.mean() == pytest.approx(level / gain, rel=1e-3)


def test_two_frames_tell_no_gain(believed):
    model, ratio = fit_gain(np.full((4, 2), 500.0), believed)
    assert model == believed and ratio == 1.0


def test_a_gain_that_is_wrong_shows(believed):
    """The table is what the camera believed made of the counts: with another gain the same counts are other numbers."""
    bench = TraceBench(made(believed), believed)
    wrong = believed.with_values({"camera.electrons_per_adu": 1.05 * believed.camera.electrons_per_adu})
    one, other = (bench.simulated.traces(model, 3).mean() for model in (believed, wrong))
    assert other / one == pytest.approx(1 / 1.05, rel=0.02)


def test_a_hidden_dark_state_is_found_and_brings_the_error_to_the_floor(believed, tmp_path):
    """In three tables. Errors of the right model scatter by a fifth about the floor, so that one table in ten is above
    1.25 floors by chance, and two of three in 3 %."""
    hidden = {"kind": "long_dark_state", "off_rate_per_s": 1.5, "dark_time_s": 0.4}
    truth = believed.with_values({"effects": [hidden]})
    dim = believed.with_values({"optics.brightness_correction": 0.85})  # a belief 15 % too dim is not an effect
    at_the_floor = 0
    for seed in (21, 31, 41):
        traces = made(truth, seed=seed)
        report = diagnose_traces(traces, dim, effects=["photobleaching", "long_dark_state", "laser_drift"], seed=2)
        assert report.chosen == ["long_dark_state"]
        assert report.error["before"] > 2 * report.error["after"]
        assert report.w1["after"] < 1.5 * report.w1["floor"] < report.w1["before"]
        found = report.model.effects[-1]
        assert (found.form, found.start) == ("exponential", "bright")  # as it was hidden
        assert found.off_rate_per_s * found.dark_time_s == pytest.approx(0.6, rel=0.4)  # time dark over time lit
        at_the_floor += report.verdict == "missing_effect" and report.error["after"] < 1.25 * report.error["floor"]
    assert at_the_floor >= 2
    plain = report.to_dict()
    write_json(tmp_path / "report.json", plain)
    contract = {"verdict", "error", "failing", "ranking", "chosen", "history", "model", "seconds", "seed", "w1"}
    assert contract <= set(plain)
    assert {row["effect"] for row in plain["ranking"]} == {"photobleaching", "long_dark_state", "laser_drift"}
    assert nm.Model.from_dict(plain["model"]) == report.model


def test_a_right_model_is_adequate(believed):
    """False alarms are allowed in 5 % of tables; these seeds were not chosen among several."""
    wrong = believed.with_values({"optics.brightness_correction": 1.2})
    report = diagnose_traces(made(believed), wrong, effects=["photobleaching", "triplet_blinking"], seed=3)
    assert report.verdict == "adequate"
    assert report.model.optics.brightness_correction == pytest.approx(1.0, rel=0.05)


def test_a_right_model_is_adequate_where_no_pixel_holds_all_the_light():
    """Of 240 photoelectrons on an EMCCD whose converter ends at 96: simulated in one pixel they were 128."""
    strong = {
        "excitation.power_density_w_per_cm2": 8.0, "fluorophore.cycles_before_bleaching": 5e4,
        "acquisition.n_frames": 60,
    }  # fmt: skip
    model = nm.preset("FF").with_values(strong)
    field = FarApart(model.sigma_px, 96, Options(psf_sigma_px=model.sigma_px), 9)  # images, and what is read of them
    traces = field.traces(field.acquisition(model, 9))
    report = diagnose_traces(traces, model, effects=["photobleaching", "brightness_heterogeneity"], seed=1)
    assert report.verdict == "adequate" and report.error["before"] < 1.5 * report.error["floor"]
    assert not any("cut off" in note for note in report.notes)
    # Eight times the light fills the brightest pixel, too: a tenth of 1920 photoelectrons, and 18 of background.
    brighter = model.with_values({"excitation.power_density_w_per_cm2": 64.0})
    bench = TraceBench(field.traces(field.acquisition(brighter, 9)), brighter)
    assert any("the camera believed ends at 96" in note for note in bench.notes)


def test_candidates_are_what_a_lone_trace_can_show():
    kinds = candidate_kinds()
    assert {"photobleaching", "triplet_blinking", "laser_flicker", "background_decay"} <= set(kinds)
    assert not {"stage_drift", "illumination_profile", "column_offset"} & set(kinds)


def test_bad_input_is_told(believed):
    with pytest.raises(nm.MufasaError, match="all traces are 5 throughout: give measured ones"):
        nm.diagnose_traces(np.full((40, 60), 5.0), nm.preset("FF"))
    with pytest.raises(nm.MufasaError, match="needs at least 32 traces"):
        diagnose_traces(np.ones((10, 80)), believed)
    with pytest.raises(nm.MufasaError, match="no effect 'photobleeching': did you mean photobleaching"):
        diagnose_traces(np.ones((40, 80)), believed, effects=["photobleeching"])
    with pytest.raises(nm.Cancelled):
        diagnose_traces(made(believed), believed, cancel=lambda: True)


def test_traces_extracted_from_an_independent_movie(believed):
    """End to end: another program's movie with bleaching, extraction, then the table alone."""
    case = generator.make(generator.base_model("emccd"), seed=5, n_molecules=80, effects=[("photobleaching", 0.8)])
    model = nm.Model.from_dict(case.believed)
    found = extract_traces(case.movie, model.camera, case.dark, psf_sigma_px=model.sigma_px)
    report = diagnose_traces(found.traces, model, effects=["photobleaching", "brightness_heterogeneity"], seed=1)
    assert report.chosen[:1] == ["photobleaching"]
    assert report.w1["after"] < 0.5 * report.w1["before"]
