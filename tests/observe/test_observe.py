"""The table of observables: fixed names, states of traces, parts of the field."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

import napari_mufasa as nm
from napari_mufasa.discover.read_off import (
    averaged,
    background_beyond,
    bright_side,
    in_scale_of,
    read_off,
    relief_beyond,
)
from napari_mufasa.effects.camera import BaselineDrift
from napari_mufasa.effects.illumination import IlluminationProfile, LaserDrift
from napari_mufasa.effects.motion import StageDrift
from napari_mufasa.effects.optics import Astigmatism, BackgroundDecay, BackgroundGradient
from napari_mufasa.effects.photophysics import BrightnessHeterogeneity, MultipleEmitters
from napari_mufasa.observe import PARTS, _near_spots, checkerboard, observe
from napari_mufasa.observe.field import _correlation, _line_pattern, _map, map_at
from napari_mufasa.observe.kernels import line_noise
from napari_mufasa.observe.summary import (
    HIGHEST,
    Background,
    Part,
    _gap_lengths,
    _level_positions,
    _slope,
    mean_shape,
    molecules,
    trace_kinetics,
    well_seen,
)
from napari_mufasa.observe.table import Table
from napari_mufasa.simulate.movie import SimulatedAcquisition
from napari_mufasa.spots.evidence import block_means
from napari_mufasa.spots.find import Found
from napari_mufasa.spots.follow import follow
from napari_mufasa.traces.dynamics import dynamics


def small(n_frames=60, **values):
    changes = {"acquisition.n_frames": n_frames, "acquisition.shape_px": (48, 48), "sample.n_molecules": 8}
    return nm.preset("EGFP").with_values(
        changes | {"excitation.power_density_w_per_cm2": 30, "camera.electrons_per_adu": 12.0} | values
    )


def test_the_same_names_whatever_the_movie_shows():
    model = small()
    dark = nm.simulate_dark(model, 20, seed=2)
    rich = observe(nm.simulate(model, seed=1).movie, model, dark)
    empty = observe(nm.simulate(small(**{"sample.n_molecules": 0}), seed=1).movie, model, dark)
    assert rich.names == empty.names and len(rich.names) == len(set(rich.names)) > 90
    assert rich.values.shape == (len(PARTS), len(rich.names))
    assert np.isfinite(rich.values).all()
    # Without molecules no pixel of a spot has a variance over its mean; that is told, not set to 0.
    not_shown = {
        name for name, shown in zip(rich.names, np.isfinite(empty.values).all(axis=0), strict=True) if not shown
    }
    assert not_shown == {"photon_transfer_middle", "photon_transfer_top", "peak_quantile"}
    assert set(rich.meanings) == set(rich.names)
    no_dark = observe(nm.simulate(model, seed=1).movie, model)
    assert no_dark.names == tuple(n for n in rich.names if not n.startswith("dark_"))


def test_the_same_movie_gives_the_same_numbers():
    model = small()
    movie = nm.simulate(model, seed=1).movie
    np.testing.assert_array_equal(observe(movie, model).values, observe(movie.astype(float), model).values)


def test_parts_are_apart():
    tiles = checkerboard((96, 80))
    assert set(np.unique(tiles)) == {1, 2}
    assert abs((tiles == 1).mean() - 0.5) < 0.1
    model = small()
    values = observe(nm.simulate(model, seed=1).movie, model).values
    assert not np.allclose(values[1], values[2])


def test_states_of_a_hand_made_trace():
    light = np.random.default_rng(0).normal(0, 1, (1, 100))
    light[0, 20:50] += 100.0
    light[0, 60:80] += 100.0
    states = dynamics(light)
    assert (states.first[0], states.last[0]) == (20, 79)
    assert states.on_level[0] == pytest.approx(100, abs=0.6)  # 50 frames of noise 1: standard error 0.14
    assert _gap_lengths(states.lit) == [10]


def test_a_molecule_that_ends_within_the_first_frames_does_not_rule_the_level_of_last_steps():
    """Most of its movie it is dark: 0.95 of its smoothed trace lie about zero: what it had over that is no level."""
    rng = np.random.default_rng(1)
    light = rng.normal(0, 1, (12, 300))
    light[:6, :150] += 40.0
    light[6:, :8] += 40.0
    table = Table()
    trace_kinetics(table, light, dynamics(light))
    # Six last steps at the top, at most six at the bound, eight at the usual 0.9.
    assert (6 + 8 * 0.9) / 20 - 0.05 < table.values["last_level_mean"] < (6 + 6 * HIGHEST + 8 * 0.9) / 20
    assert max(np.abs(list(table.values.values()))) < 100


def test_what_shines_on_where_a_molecule_has_bleached_is_seen_as_a_share_of_it():
    """Half of twelve molecules end, at a fifth of their light; drawn towards none as if by eight that left nothing."""
    rng = np.random.default_rng(2)
    light = rng.normal(0, 1, (12, 300))
    light[:6] += np.where(np.arange(300) < 150, 40.0, 8.0)
    light[6:] += 40.0
    table = Table()
    trace_kinetics(table, light, dynamics(light))
    # Six times 147 dark frames of noise 1 know the light left to 0.03 of 40; levels are as sure.
    assert table.values["left_after"] == pytest.approx(6 / (6 + 8) * 0.2, abs=4 * 0.001)


def test_table_keeps_order():
    table = Table()
    table.add("a", 0.5, "t", "u", "w")
    table.log("b", np.e, "t", "w")
    table.count("c", 9.0, "t", "w")
    assert list(table.values.items()) == [("a", 0.5), ("b", 1.0), ("c", 3.0)]
    assert table.meanings["b"].unit == "ln"


def test_expansion_is_not_ruled_by_one_spot_that_jumped():
    """Thirty spots of a field that grows by 2 %, one of them displaced by 40 pixels."""
    rng = np.random.default_rng(0)
    place = rng.uniform(-30, 30, 60)
    moved = 0.02 * place + 0.02 * rng.standard_normal(60)
    moved[7] += 40
    assert _slope(place, moved) == pytest.approx(0.02, abs=0.001)
    assert _slope(np.zeros(0), np.zeros(0)) == 0.0


def test_the_tilt_of_brightness_is_not_ruled_by_pairs_that_pass_for_one_spot():
    """Sixty spots, 4 % apart, 10 % brighter towards one side; nine are pairs. A straight fit to the others alone is
    uncertain by 0.04 / √(51 / 3) = 0.010, one to all by √(0.04² + 0.15 × 0.85 × ln² 2) / √(60 / 3) = 0.056."""
    rng, tilts = np.random.default_rng(0), []
    for _ in range(200):
        at = rng.uniform(0, 63, (60, 2))
        level = 0.04 * rng.standard_normal(60) + 0.1 * (at[:, 1] - 31.5) / 32
        level[:9] += np.log(2)
        table = Table()
        _level_positions(table, SimpleNamespace(on_level=np.exp(level)), at, (64, 64), np.zeros(60))
        tilts.append([table.values["level_position_tilt_y"], table.values["level_position_tilt_x"]])
    assert np.std(tilts, axis=0).max() < 0.056 / 2
    np.testing.assert_allclose(np.mean(tilts, axis=0), [0.0, 0.1], atol=0.02)  # drawn in, as simulated ones are


def looks_at(model, effect, movies):
    """What movies with an effect show."""
    return [observe(nm.simulate(model.with_effects(effect), seed=seed).movie, model) for seed in range(movies)]


@pytest.mark.parametrize("form", ["linear", "gaussian"])
def test_uneven_light_is_on_spots_and_background_alike(form):
    """Where the background is brighter by a spread, spots are by the same share; in haze they are as elsewhere."""
    model = standing_apart().with_values({"optics.background_photons_per_px": 20})
    light = IlluminationProfile(form=form, edge_dimming=0.5)
    haze = BackgroundGradient(form="hump" if form == "gaussian" else "linear", relative_height=0.5)

    def seen(effect):
        found = looks_at(model, effect, 6)
        along = [each.values[0, each.names.index("level_position_background")] for each in found]
        counted = [each.spots.positions_px[well_seen(each.spots, each.states)] for each in found]
        around = [map_at(each.background_map, places) for each, places in zip(found, counted, strict=True)]
        spread = [places.std() / places.mean() for places in around]
        return np.mean(along), np.std(along) / np.sqrt(len(along)), np.mean(spread)

    along, uncertain, spread = seen(light)
    assert along == pytest.approx(spread, abs=4 * uncertain) and spread > 0.05
    assert along > 10 * uncertain
    along, uncertain, spread = seen(haze)
    assert along == pytest.approx(0, abs=4 * uncertain) and spread > 0.05
    assert uncertain < spread / 10


def seen_of(model, effect, names, movies=4):
    """Means of some observables of movies with an effect."""
    found = looks_at(model, effect, movies)
    return np.mean([[each.values[0, each.names.index(name)] for name in names] for each in found], axis=0)


@pytest.mark.parametrize("form", ["linear", "step"])
def test_a_lasers_power_is_on_spots_and_background_and_a_drift_of_the_background_is_not(form):
    """A course that moves by a third has, over its mean, a spread of √(1/12) of that if steadily, and of half of it
    with a step at half; noise is as the square root of light. 120 frames × 40 molecules of 0.3 relative noise tell
    spots to 0.005. What moves with the background alone is on no spot, and a converter's offset brings no noise."""
    model = standing_apart().with_values({"optics.background_photons_per_px": 20})
    names = ("level_time_background", "background_time_noise")
    spread = {"linear": 1 / 3 / 12**0.5, "step": 1 / 6}[form] / (1 + 1 / 6)
    laser, noise = seen_of(model, LaserDrift(form=form, change=1 / 3, step_at=0.5), names)
    np.testing.assert_allclose([laser, noise], [spread, spread / 2], rtol=0.1)
    background, noise = seen_of(model, BackgroundDecay(form="linear", fraction=1 / 3), names)
    assert background == pytest.approx(0, abs=0.015)
    assert noise == pytest.approx(1 / 3 / 12**0.5 / (1 - 1 / 6) / 2, rel=0.1)
    offset, still = seen_of(model, BaselineDrift(form=form, drift_adu=100.0), names)
    np.testing.assert_allclose([offset, still], 0.0, atol=0.015)


def test_spots_of_several_emitters_are_brighter_and_show_more_levels_and_unequal_ones_do_not():
    """Where molecules bleach, one after the other in a spot of two; of unequal ones the dim show more noise instead."""
    model = standing_apart(200).with_values({"fluorophore.cycles_before_bleaching": 3e4})
    names = ("steps_between_brighter",)
    (several,) = seen_of(model, MultipleEmitters(form="dimers", fraction=0.5), names)
    (unequal,) = seen_of(model, BrightnessHeterogeneity(form="two_levels", spread=0.4), names)
    assert unequal < -0.4 and several > 0


def test_the_mean_shape_is_not_ruled_by_pairs_that_pass_for_one_spot():
    """Thirty spots 5 % of a pixel² longer along y, four of them five pixels² longer along x."""
    rng = np.random.default_rng(0)
    excess = np.array([0.05, 0.0, 0.0]) + 0.01 * rng.standard_normal((30, 10, 3))
    excess[:4, :, 1] += 5.0
    light = rng.uniform(50, 100, (30, 10))
    spots = SimpleNamespace(shape=excess * light[..., None], shape_weight=light)
    everyone, nobody = np.ones(30, bool), np.zeros(30, bool)
    # 0.01 over √(15 molecules × 10 blocks) is 0.0008; the four shift the middle half by a tenth of a spread.
    np.testing.assert_allclose(mean_shape(spots, everyone, range(10)), [0.05, 0.0, 0.0], atol=0.004)
    np.testing.assert_array_equal(mean_shape(spots, nobody, range(10)), 0.0)


def test_own_displacement_is_not_ruled_by_a_spot_that_jumps_to_a_neighbour():
    model = standing_apart()
    found = observe(nm.simulate(model, seed=3).movie, model)
    jumped = found.spots.displacement_px.copy()
    jumped[:2, 5:] += 2.5
    other, states = replace(found.spots, displacement_px=jumped), found.states
    dark = Background(found.course, found.background_map, np.zeros(len(jumped)))
    own = []
    for spots in (found.spots, other):
        table = Table()
        molecules(table, spots, states, Part((1, 2), np.ones(len(jumped), bool)), (96, 96), dark)
        own.append(np.exp(table.values["individual_shift_half"]))
    assert own[1] < 1.3 * own[0]  # the mean over all rises by 2 · 6.25 · 2 / 40 = 0.6 px², from 0.2


@pytest.mark.parametrize("name", ["course", "seen"])
def test_what_a_half_shows_is_told_in_the_scale_of_the_whole(name):
    """Its own largest and first values are matters of noise."""
    rng = np.random.default_rng(0)
    truth = np.cumsum(rng.standard_normal(60))

    def read(values):
        values = values - values[0]
        return {name: tuple(values / np.abs(values).max()), "form": "whatever"}

    whole, half = read(truth), read(truth + 0.5 * rng.standard_normal(60))
    scaled = in_scale_of(whole, half)
    rest = np.array(scaled[name]) - whole[name]
    assert abs(rest.mean()) < 1e-4 < np.abs(np.subtract(half[name], whole[name]).mean())
    assert rest.std() < 0.5 * np.std(whole[name]) and scaled["form"] == "whatever"
    assert in_scale_of({name: ()}, half) == half and in_scale_of(whole, {name: ()}) == {name: ()}


def test_the_course_of_a_half_points_where_that_of_the_whole_does():
    """Light that rises as far as it falls: the size of an effect is that where its course is farthest from 0."""
    whole = (0.0, 0.5, 1.0, 0.0, -0.99)
    half = in_scale_of({"course": whole}, {"course": (0.0, 0.5, 0.97, 0.0, -1.0)})["course"]
    assert max(half, key=abs) > 0
    np.testing.assert_allclose(half, whole, atol=0.05)
    falling = in_scale_of({"course": tuple(-np.array(whole))}, {"course": (0.0, -0.5, -0.97, 0.0, 1.0)})["course"]
    np.testing.assert_allclose(falling, -np.array(half))
    flicker = (0.4, -2.0, 1.0, 0.6)  # begins anywhere: has no side
    other = in_scale_of({"course": flicker}, {"course": (0.4, 2.0, -4.0, 0.6)})["course"]
    assert np.corrcoef(other, (0.4, 2.0, -4.0, 0.6))[0, 1] ** 2 == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("axis_deg", [20.0, 135.0])
def test_the_axis_of_astigmatism_is_read_off(axis_deg):
    values = {"acquisition.shape_px": (96, 96), "sample.n_molecules": 30, "sample.min_distance_px": 8}
    model = small(**values)
    turned = Astigmatism(log_ratio=0.4, axis_deg=axis_deg)
    seen = read_off("astigmatism", observe(nm.simulate(model.with_effects(turned), seed=3).movie, model))["axis_deg"]
    assert abs((seen - axis_deg + 90) % 180 - 90) < 10


@pytest.mark.parametrize(
    "added",
    [
        IlluminationProfile(edge_dimming=0.5, direction_deg=200.0, form="linear"),
        IlluminationProfile(edge_dimming=0.5, direction_deg=200.0, form="off_centre"),
        BackgroundGradient(relative_height=0.5, direction_deg=200.0, form="linear"),
        BackgroundGradient(relative_height=0.5, centre_y=-0.17, centre_x=-0.47, width=0.5, form="hump"),
    ],
)
def test_the_bright_side_is_read_off(added):
    model = small(**{"acquisition.shape_px": (96, 96)})
    seen = read_off(added.kind, observe(nm.simulate(model.with_effects(added), seed=4).movie, model))["direction_deg"]
    assert abs((seen - 200.0 + 180) % 360 - 180) < 15


@dataclass
class Shown:
    """Of an observation its maps alone."""

    maps: np.ndarray

    @property
    def background_map(self):
        return self.maps[0]


def test_the_background_beyond_a_model_is_read_off():
    """Map and course relative to those of the model; a transient of ten frames is kept, the noise of frames is not."""
    rng = np.random.default_rng(1)
    y, x = np.mgrid[:12, :16]
    beyond_map = 1 + 0.2 * (x - 7.5) / 7.5
    beyond = np.where(np.abs(np.arange(300) - 150) < 5, 1.3, 1.0)
    model_course, model_map = 20 * np.exp(-np.arange(300) / 400), 20 + y

    def seen(course, tiles):
        return SimpleNamespace(course=course, background_map=np.where(rng.random((12, 16)) < 0.2, np.nan, tiles))

    shown = [seen(model_course, model_map) for _ in range(3)]
    course = model_course * beyond * (1 + 0.01 * rng.standard_normal(300))
    found = background_beyond(seen(course, model_map * beyond_map + 0.1 * rng.standard_normal((12, 16))), shown)
    got = np.array(found["course"])
    assert np.sqrt(np.mean((got - beyond / beyond.mean()) ** 2)) < 0.01  # below that of the frames' noise
    assert got[145:155].mean() / np.delete(got, range(140, 160)).mean() == pytest.approx(1.3, rel=0.02)
    tiles = np.reshape(found["map"], (12, found["map_columns"]))
    assert np.abs(tiles[:, 3:-3] - beyond_map[:, 3:-3]).max() < 0.04  # a hole is filled from one side, of slope 0.027
    alike = background_beyond(seen(model_course, model_map), shown)
    np.testing.assert_allclose(alike["course"], 1.0, atol=1e-3)


def test_background_that_spots_hide_in_a_whole_quarter_is_read_off_and_none_is_told_where_the_model_has_none():
    """Many molecules leave no background tile for many tiles around: the nearest known stands in."""
    tiles = np.full((32, 32), 20.0)
    hidden = tiles.copy()
    hidden[:16, :16] = np.nan
    course = np.full(90, 20.0)
    one = SimpleNamespace(course=course, background_map=hidden)
    found = background_beyond(one, [one, SimpleNamespace(course=course, background_map=tiles)])
    np.testing.assert_allclose(found["map"], 1.0, atol=1e-4)
    dark = SimpleNamespace(course=np.zeros(90), background_map=np.zeros((32, 32)))
    assert background_beyond(one, [dark]) == {"map": (), "map_columns": 1, "course": ()}


def test_of_a_relief_is_read_off_what_the_model_s_own_patterns_do_not_show():
    """Columns at random, as the model has them, are no relief (taken for one in 1 of 300 draws); a slope beside them
    is (missed in 2 of 300), and what the model shows of another is not in it. The seed is fixed."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:12, :16]

    def seen(*reliefs):
        tiles = 50 + sum(reliefs) + rng.standard_normal(16) + 0.05 * rng.standard_normal((12, 16))
        return Shown(np.repeat(np.where(rng.random((12, 16)) < 0.1, np.nan, tiles)[None], 3, axis=0))

    model_slope, slope = 0.4 * (x - 7.5), 0.6 * (y - 5.5)
    shown = [seen(model_slope) for _ in range(3)]
    assert np.isnan(relief_beyond(seen(model_slope), shown).background_map).all()
    left = averaged(relief_beyond(seen(model_slope, slope), shown).background_map)
    tilt_y, tilt_x = (np.polyfit(at.ravel(), left.ravel(), 1)[0] for at in (y, x))
    assert tilt_y == pytest.approx(0.6, abs=0.06)  # smoothed: 0.58 of sd 0.01
    assert abs(tilt_x) < 0.2  # of the model's 0.4 columns leave 0 of sd 0.06


def test_what_one_half_shows_does_not_depend_on_the_other():
    """The light of the black tiles grows by half; what is read off the white ones stays what it was."""
    model = small(**{"acquisition.shape_px": (96, 96), "optics.background_photons_per_px": 40.0})
    movie = nm.simulate(model, seed=4).movie.astype(float)
    growing = 1 + 0.5 * np.linspace(0, 1, len(movie))[:, None, None]
    black = checkerboard(movie.shape[1:]) == 2
    light = movie - model.camera.baseline_adu
    changed = np.where(black, model.camera.baseline_adu + light * growing, movie)
    plain, other = (observe(m, model) for m in (movie, changed))
    for name, alike in (("white", True), ("black", False), ("all", False)):
        one, two = plain.only(name), other.only(name)
        assert np.allclose(one.course, two.course, rtol=0.02) == alike
        same = np.isfinite(one.background_map) & np.isfinite(two.background_map)
        assert np.allclose(one.background_map[same], two.background_map[same], rtol=0.05) == alike
        assert (read_off("background_decay", two)["course"] == ()) == alike
    white = plain.only("white")
    np.testing.assert_array_equal(white.part("all"), plain.part("white"))
    assert len(white.spots.light) == len(white.states.first) == int((plain.side == 1).sum())
    assert white.spots.frame_shift.shape[1] == len(white.spots.light)
    np.testing.assert_array_equal(plain.only("all").values[0], plain.values[0])


def standing_apart(n_frames=120):
    """Molecules enough to tell a motion to a twentieth of a pixel in every frame."""
    return small(n_frames, **{"acquisition.shape_px": (96, 96), "sample.n_molecules": 40, "sample.min_distance_px": 8})


@pytest.mark.parametrize("at", [0.2, 0.467, 0.64])
@pytest.mark.parametrize("distance", [0.8, 3.0])
def test_a_bumped_stage_tells_when_and_where_to(at, distance):
    model = standing_apart()
    bump = StageDrift(form="step", step_at=at, distance_px=distance, direction_deg=200.0)
    seen = read_off("stage_drift", observe(nm.simulate(model.with_effects(bump), seed=3).movie, model))
    n = model.acquisition.n_frames
    # Within a block of n/10 frames the apertures stand still: to the frame it is told by where the light lies in them.
    assert seen["step_at"] * (n - 1) == pytest.approx(at * (n - 1), abs=1.0)
    assert seen["direction_deg"] == pytest.approx(200.0, abs=3)
    # What is read off puts the stage where it was.
    again = SimulatedAcquisition(
        model.with_effects(StageDrift(form="step", distance_px=distance, **seen))
    ).scene.shift_px
    path, end = np.array(seen["path"]), np.array([np.sin(np.deg2rad(200)), np.cos(np.deg2rad(200))])
    assert np.flatnonzero(again.any(axis=1))[0] == pytest.approx(at * (n - 1), abs=1.5)
    np.testing.assert_allclose(again[-1], distance * end, atol=0.06 * distance)
    # Each value is read to 0.03 to 0.05 px along either axis.
    assert path[-2:].mean(axis=0) == pytest.approx(end, abs=0.15 / distance)
    assert path[:2].mean(axis=0) == pytest.approx([0, 0], abs=0.15 / distance)


def test_a_wandering_stage_is_seen_finer_than_by_blocks():
    model = standing_apart()
    walk = np.cumsum(np.random.default_rng(5).standard_normal((30, 2)), axis=0)
    walk = (walk - walk[0]) / np.hypot(*(walk - walk[0]).T).max()
    drift = StageDrift(form="wandering", distance_px=3.0, path=tuple(map(tuple, walk)))
    spots = observe(nm.simulate(model.with_effects(drift), seed=5).movie, model).spots
    n = model.acquisition.n_frames
    at = (np.arange(30) + 0.5) / 30
    truth = 3 * np.stack([np.interp(np.linspace(0, 1, n), at, along) for along in walk.T], axis=1)

    def rms(motion):
        error = np.stack([part.mean(axis=0) for part in np.array_split(motion - truth, 30)])
        return np.sqrt(((error - error.mean(axis=0)) ** 2).mean())

    assert rms(spots.common_motion()) < 0.6 * rms(spots.path_px[np.arange(n) * 10 // n])


def test_spots_without_light_stand_still():
    model = small()
    spots = observe(nm.simulate(model, seed=1).movie, model).spots
    dark = replace(spots, light=np.zeros_like(spots.light), frame_shift=np.zeros_like(spots.frame_shift))
    np.testing.assert_array_equal(dark.common_motion(), spots.path_px[np.arange(60) * 10 // 60])


def test_a_spot_on_the_edge_is_no_background():
    model = small(**{"acquisition.shape_px": (96, 96)})
    places = np.array([[95.45, 40.0], [30.0, -0.45], [30.0, 60.0]])
    spots = observe(nm.simulate(model, places, seed=5).movie, model).spots
    near = _near_spots((96, 96), spots, 5.0)
    assert near[95, 40] and near[92, 40] and near[30, 0] and not near[60, 20]


def test_a_crowded_field_has_its_farthest_pixels_for_a_background():
    y, x = np.indices((48, 48))
    for apart, kept in ((24, None), (6, 0.1)):  # px; of circles of 6 px a quarter of the field is left, or nothing
        positions = np.argwhere((y % apart == 0) & (x % apart == 0))
        near = _near_spots((48, 48), SimpleNamespace(positions_px=positions, path_px=np.zeros((1, 2))), 6.0)
        distance = np.min(np.hypot(y[..., None] - positions[:, 0], x[..., None] - positions[:, 1]), axis=-1)
        if kept is None:
            np.testing.assert_array_equal(near, distance < 6)
        else:
            assert kept <= np.mean(~near) < 0.3 and distance[~near].min() >= distance[near].max()


def test_what_too_few_pixels_show_is_not_told():
    """A part whose background has no line of four pixels, and fewer than six tiles: no number stands in for patterns
    and unevenness, and nothing tilts."""
    assert np.isnan(line_noise(np.ones((2, 9, 3)), np.array([0, 1]), np.array([3, 0, 2])))
    few = np.zeros((8, 8), dtype=bool)
    few[::4, ::4] = True
    assert np.isnan(_line_pattern(np.ones((8, 8)), few, 0))
    assert np.isnan(_correlation(np.ones((8, 8)), np.ones((8, 8)), np.flatnonzero(few)))
    table, tiles = Table(), np.full((3, 3), np.nan)
    tiles[0] = 8.0
    _map(table, tiles, (24, 24))
    np.testing.assert_array_equal(list(table.values.values()), [0, 0, 0, np.nan])
    seen = observe(nm.simulate(small(), seed=1).movie, small())
    blank = np.where(np.char.startswith(seen.names, "background_map_tilt"), 0.0, seen.values)
    assert bright_side(replace(seen, values=blank)) == {}


def test_a_spot_that_leaves_the_field_is_measured_as_far_as_it_goes():
    """Far outside its patch a spot is zero in every pixel: nothing may be divided by that."""
    movie = np.random.default_rng(2).poisson(100, (40, 32, 32)).astype(np.uint16)
    path = np.linspace(0, 1, 10)[:, None] * [60.0, 0.0]  # out of the field and 30 px on
    found = Found(np.array([[16.0, 16.0]]), np.ones(1), np.ones(1), None)
    spots = follow(movie, block_means(movie, np.arange(0, 41, 4)), 100.0, 1.0, 1.2, path, found)
    assert not spots.inside.any()
    assert np.isfinite(spots.light).all() and np.isfinite(spots.shape).all()
