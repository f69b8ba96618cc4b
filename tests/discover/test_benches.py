"""What a bench shows of measurements and models: dark frames by their camera, and what cannot be measured."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import napari_mufasa as nm
from napari_mufasa.discover.bench import Bench
from napari_mufasa.discover.investigation import Investigation
from napari_mufasa.discover.library import CHECK_SEED, build
from napari_mufasa.discover.measurement import prepare
from napari_mufasa.discover.movie_bench import MovieBench
from napari_mufasa.discover.reporting import NOT_HERE
from napari_mufasa.discover.rules import BASE_SIMULATIONS
from napari_mufasa.discover.seen_courses import stands_still
from napari_mufasa.effects import effect_class
from napari_mufasa.observe.table import Meaning, Table

P = 12
NAMES = tuple(f"o{i}" for i in range(P))


def test_dark_frames_of_cameras_that_differ_in_a_few_pixels_are_not_taken_for_each_other():
    """Arrays of more than a thousand values are printed without most of them: a name that is made of print is none."""
    model = nm.preset("FF").with_values(
        {"acquisition.n_frames": 30, "acquisition.shape_px": (48, 48), "sample.n_molecules": 20}
    )
    raised = np.zeros((48, 48))
    raised[10:38, 10:38] = 40.0
    plain, patch = (model.with_values({"camera.offset_map_adu": offset}) for offset in (np.zeros((48, 48)), raised))
    assert repr(plain.camera) == repr(patch.camera)
    bench = MovieBench(prepare(nm.simulate(plain, seed=1).movie, plain, nm.simulate_dark(plain, 20, 2)), 1)
    means = [bench.simulated.dark_view(m, 5).tables[0].values["dark_mean"] for m in (plain, patch, plain)]
    assert means[1] - means[0] == pytest.approx(40.0 * (28 / 48) ** 2, rel=0.1) and means[2] == means[0]
    assert len(bench.simulated._dark) == 2  # made once for each


def test_dark_frames_tell_how_the_read_noise_is_mixed_unless_the_model_believed_does():
    model = nm.preset("FF").with_values(
        {"acquisition.n_frames": 30, "acquisition.shape_px": (48, 48), "sample.n_molecules": 20}
    )
    mixed = model.with_effects(effect_class("serial_readout")(share=-0.15, dark_rows=(0.3,)))
    movie, dark = nm.simulate(mixed, seed=1).movie, nm.simulate_dark(mixed, 40, 2)
    bench = MovieBench(prepare(movie, model, dark), 1)
    assert bench.size == movie.size + dark.size  # what a simulation costs: it has dark frames, too
    seen = bench.read_off("serial_readout")
    assert set(seen) == {"dark_rows", "noise_ratio"}  # the latter of no account then, and not fitted
    np.testing.assert_allclose(seen["dark_rows"][0], 0.3, atol=6 * 1.2 / np.sqrt(40 * 48 * 48))
    believed = model.with_values({"camera.read_noise_kernel": (0.3,)})
    assert MovieBench(prepare(movie, believed, dark), 1).read_off("serial_readout") == {"noise_ratio": 0.0}
    assert MovieBench(prepare(movie, model, None), 1).read_off("serial_readout") == {}


def test_dark_frames_have_a_part_in_a_drift_where_they_show_one():
    """Of series that stand still 0.8 % are taken for drifting by chance (15 of 1000 or more: 2 %; the seed is fixed),
    though they alternate; a drift of six standard deviations passes for none in 0.3 % (12 of 1000 or more: 10⁻⁴). Both
    shares are of 20 000: the scatter itself is told by 28 differences."""
    noise = np.random.default_rng(1).standard_normal((1000, 30, 2, 2))
    alternating = np.where(np.arange(30) % 2, 3.0, -3.0)[:, None, None]
    assert sum(not stands_still(each + alternating) for each in noise) < 15
    slope = 6 * 0.5 * np.sqrt(2 / 10) / 20  # per frame: thirds lie 20 frames apart
    drift = slope * np.arange(30)[:, None, None]
    assert sum(stands_still(each + alternating + drift) for each in noise) < 12
    assert not stands_still(np.zeros((5, 2, 2)))  # too few to tell


def test_dark_frames_that_walk_do_not_stand_still_wherever_they_end():
    """Steps of half the scatter of a frame's mean: of 20 000 such walks through 100 frames 1.5 % pass for standing
    still, of white noise 1.5 % does not, of that with an alternating baseline 0.3 % (12 of 300 or more where it is
    1.5 %: 0.2 %; the seed is fixed)."""
    rng = np.random.default_rng(3)
    noise = rng.standard_normal((300, 100, 2, 2))
    walks = 0.25 * rng.standard_normal((300, 100)).cumsum(axis=1)[:, :, None, None]
    alternating = np.where(np.arange(100) % 2, 3.0, -3.0)[:, None, None]
    assert sum(stands_still(each) for each in noise + walks) < 12
    assert sum(not stands_still(each) for each in noise) < 12
    assert sum(not stands_still(each) for each in noise + alternating) < 12


def test_a_drift_that_dark_frames_do_not_show_is_not_looked_for_there():
    model = nm.preset("FF").with_values(
        {"acquisition.n_frames": 60, "acquisition.shape_px": (48, 48), "sample.n_molecules": 20}
    )
    drifting = model.with_effects(effect_class("baseline_drift")(drift_adu=8.0))
    movie = nm.simulate(drifting, seed=1).movie
    before, apart = nm.simulate_dark(drifting, 40, 2), nm.simulate_dark(model, 40, 2)
    seen = MovieBench(prepare(movie, model, before), 1).read_off("baseline_drift")
    assert "in_dark" not in seen
    # 40 frames before a movie of 60 that rises by 8: eight values, the last of them 0. All within 4.5 of their sd.
    noise = before.std() * np.sqrt(2 / (5 * 48 * 48))
    assert seen["dark_course"] == pytest.approx(-8 * np.arange(35, -1, -5) / 59, abs=4.5 * noise)
    assert MovieBench(prepare(movie, model, apart), 1).read_off("baseline_drift")["in_dark"] == 0.0
    assert "in_dark" not in MovieBench(prepare(movie, model, None), 1).read_off("baseline_drift")


def test_of_two_that_drift_each_is_what_the_other_leaves():
    """A walk of the baseline beside light that fades: read off the movie alone it would be both; beside a model whose
    light fades, it is the walk (up to 1500 ADU; a frame's mean has a noise of 50 ADU, that of three simulations 29)."""
    walk = np.cumsum(np.random.default_rng(2).standard_normal(300))
    walk = tuple((walk - walk[0]) / np.abs(walk - walk[0]).max())
    fading = effect_class("laser_drift")(change=-0.5, form="saturating", settling_time=0.3)
    wandering = effect_class("baseline_drift")(drift_adu=1500.0, form="wandering", course=walk)
    model = nm.preset("FF").with_values(
        {"acquisition.n_frames": 300, "acquisition.shape_px": (64, 64), "sample.n_molecules": 20}
    )
    bench = MovieBench(prepare(nm.simulate(model.with_effects(fading, wandering), seed=3).movie, model, None), 1)

    def alike(*beside):
        course = bench.read_off("baseline_drift", bench.start.with_effects(*beside))["course"]
        return abs(np.corrcoef(course, walk)[0, 1])

    assert alike(fading) > 0.98 > 0.5 > alike()
    assert alike(wandering) == alike()  # what it does itself is not taken off
    before = bench.done
    bench.read_off("stage_drift", bench.start.with_effects(fading))
    assert bench.done == before  # nothing is simulated for what does not drift with the light


def test_beside_columns_at_random_their_pattern_is_no_relief_and_a_hump_is():
    """Of columns 400 ADU apart (rms) one movie in four passes for a relief: this one. Beside a model of such columns it
    is none (nor are the other three), and a hump of three times the background is one in all four."""
    columns = effect_class("column_offset")(rms_adu=400.0)
    hump = effect_class("background_gradient")(relative_height=3.0, form="hump", width=0.3)
    model = nm.preset("FF").with_values(
        {"acquisition.n_frames": 60, "acquisition.shape_px": (96, 96), "sample.n_molecules": 20}
    )

    def seen(*effects):
        bench = MovieBench(prepare(nm.simulate(model.with_effects(*effects), seed=3).movie, model, None), 1)
        return [bench.read_off(hump.kind, bench.start.with_effects(*beside))["seen"] for beside in ((), (columns,))]

    alone, beside = seen(columns)
    assert alone and not beside and all(seen(columns, hump))


class GapBench(Bench):
    """Noise, of which some numbers are not to be had: "o3" not in the measurement, "o5" not in one simulation of the
    base model, "o7" not in half of those with hot pixels, "o9" in half of all."""

    matching_simulations = 0

    def __init__(self, gaps=True):
        self.with_gaps = gaps
        shown = self.made(nm.preset("FF"), 999)
        if gaps:
            shown[1, 3] = np.nan
        measured = SimpleNamespace(values=shown, names=NAMES, meanings=dict.fromkeys(NAMES, Meaning("t", "", "w")))
        super().__init__(nm.preset("FF"), measured, 1)

    def made(self, model, number):
        row = np.random.default_rng([4, number]).standard_normal((3, P))
        row[:, :2] += sum(100 * effect.fraction for effect in model.effects)
        if self.with_gaps:
            row[0, 5] = np.nan if number == 7 else row[0, 5]
            row[1, 9] = np.nan if number % 2 else row[1, 9]
            row[2, 7] = np.nan if model.effects and number % 2 else row[2, 7]
        return row

    def rows(self, jobs):
        return np.array([self.made(model, number) for model, number in jobs])

    def free_values(self, model):
        return []

    def read_off(self, kind, beside=None, part="all"):
        return {}

    simulated = matched = curves = w1 = restored = None


@pytest.fixture(scope="module")
def with_gaps():
    return build(GapBench(), nm.preset("FF"), ["hot_pixels"])


def test_what_cannot_be_measured_takes_no_part(with_gaps):
    state, x = with_gaps.base, with_gaps.bench.x
    np.testing.assert_array_equal(np.flatnonzero(~state.measurable), [3, 9])
    wild = x.copy()
    wild[:, [3, 9]] = 1e6
    assert state.score(wild) == state.score(x) and np.isfinite(state.score(x))
    assert state.held_out_error(wild) == state.held_out_error(x)
    assert (
        state.screen(wild, with_gaps.rays)["hot_pixels"][0].gain
        == state.screen(x, with_gaps.rays)["hot_pixels"][0].gain
    )
    evidence, misfit = with_gaps.null_distribution()
    assert set(evidence) == set(with_gaps.rays) and np.isfinite([*evidence.values(), misfit]).all()


def test_what_few_simulations_do_not_show_is_that_of_the_next_one(with_gaps):
    """One of the base simulations lacks "o5", half of them "o9"."""
    assert with_gaps.rows[7, 0, 5] == with_gaps.rows[8, 0, 5] != 0
    assert with_gaps.rows[7, 1, 5] != with_gaps.rows[8, 1, 5] and not with_gaps.rows[:, :, 9].any()
    here = nm.preset("FF").with_effects(effect_class("hot_pixels")())
    further = build(with_gaps.bench, here, [], ("hot_pixels",), with_gaps)  # half of its simulations lack "o7"
    np.testing.assert_array_equal(np.flatnonzero(~further.base.measurable), [3, 7, 9])


def test_the_error_is_that_of_the_others(with_gaps):
    """The root of a mean over those that can be measured: of noise 1, not √(10/12)."""
    errors = [with_gaps.base.held_out_error(row) for row in np.random.default_rng(8).standard_normal((400, 3, P))]
    # 20 numbers each: mean square 1 ± √(2/20); of 400 of them ± 1.6 %; the spread of 72 simulations is known to 1/√144.
    assert np.mean(np.square(errors)) == pytest.approx(1.0, abs=0.2)
    whole = build(GapBench(gaps=False), nm.preset("FF"), ["hot_pixels"])
    assert whole.base.measurable.all()


def test_what_a_simulation_with_an_effect_does_not_show_is_no_evidence(with_gaps):
    strong = nm.preset("FF").with_effects(effect_class("hot_pixels")(fraction=0.02))
    rows = with_gaps.simulated([(strong, 4), (strong, 3), (strong, CHECK_SEED + 1)])
    assert np.isfinite(rows).all() and with_gaps.bench.gaps == {"o5", "o7"}
    assert rows[1, 2, 7] == with_gaps.rows[3, 2, 7] and rows[2, 2, 7] == with_gaps.base.check[1, 2, 7]
    np.testing.assert_allclose(rows[1, :, :2] - with_gaps.rows[3, :, :2], 2.0)  # what it shows counts
    assert len(with_gaps.rows) == BASE_SIMULATIONS


def test_a_number_that_is_none_is_kept_as_such():
    table = Table()
    table.add("one", 1 / 3, "", "", "")
    for name, value in (("two", np.inf), ("three", np.nan)):
        table.add(name, value, "", "", "")
        table.log(name + "_log", value, "", "")
    table.count("count", np.nan, "", "")
    assert table.values["one"] == 1 / 3
    assert all(np.isnan(value) for name, value in table.values.items() if name != "one")


def test_a_report_tells_what_could_not_be_measured():
    """A part of the field without spots has no photon transfer of spots."""
    model = nm.preset("FF").with_values(
        {"acquisition.n_frames": 40, "acquisition.shape_px": (48, 48), "sample.n_molecules": 12}
    )
    inquiry = Investigation(nm.simulate(model, seed=5).movie, model, seed=2, effects=["row_noise"])
    at = inquiry.bench.names.index("photon_transfer_top")
    lacking = inquiry.bench.measured.values.copy()
    lacking[1, at] = np.nan
    inquiry.bench.measured = replace(inquiry.bench.measured, values=lacking)
    report = inquiry.report()
    row = report.observables.iloc[at]
    assert row["where"] == NOT_HERE and np.isnan(row["z_before"]) and np.isnan(row["z_after"])
    assert any(row["title"] in note and "Not measurable here" in note for note in report.notes)
    assert np.isfinite(report.error["before"]) and np.isfinite(report.error["floor"])
    assert all(np.isfinite(f["z"]) for f in report.failing)
