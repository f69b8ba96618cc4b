"""Effects speak of a whole movie or of a part of it; a part of a movie looks like that part."""

import numpy as np
import pytest

import napari_mufasa as nm
from napari_mufasa.discover.measurement import prepare
from napari_mufasa.discover.movie_bench import MovieBench
from napari_mufasa.discover.read_off import told_for
from napari_mufasa.errors import MufasaError
from napari_mufasa.model.extent import Extent
from napari_mufasa.model.model import Model
from napari_mufasa.simulate.movie import simulate, simulate_dark

from .helpers import effect, plain, scene_of

HUMP = tuple(np.linspace(0, 1, 12) ** 2)
RAMP = tuple(np.linspace(0, 1, 9))
WHOLE = plain(n_frames=60, shape=(40, 64))
REGION = (slice(0, 40), slice(8, 33), slice(10, 44))
FIELDS = [
    effect("illumination_profile", edge_dimming=0.7, form=form, direction_deg=30.0, seen=HUMP, seen_columns=4)
    for form in ("gaussian", "off_centre", "linear", "as_seen", "beam")
] + [
    effect("background_gradient", form=form, direction_deg=200.0, seen=HUMP, seen_columns=4)
    for form in ("linear", "hump", "as_seen")
]  # fmt: skip
COURSES = [
    *(effect("laser_drift", change=-0.4, form=f, step_at=0.3, course=RAMP)
      for f in ("linear", "saturating", "step", "wandering")),
    *(effect("background_decay", form=f, course=RAMP) for f in ("exponential", "linear", "as_seen")),
    *(effect("stage_drift", form=f, step_at=0.2) for f in ("linear", "saturating", "step")),
    *(effect("focus_drift", form=f, course=RAMP) for f in ("linear", "accelerating", "step", "wandering")),
    effect("background_as_measured", map=tuple(1 + 0.5 * np.array(HUMP)), map_columns=4, course=(1.4, 1.2, 0.8, 0.6)),
]  # fmt: skip


@pytest.mark.parametrize("one", FIELDS, ids=lambda e: f"{e.kind} {e.form}")
def test_a_part_of_the_field_is_lit_like_that_part(one):
    model = WHOLE.with_effects(one)
    whole, part = scene_of(model), scene_of(model.in_shape(region=REGION))
    np.testing.assert_allclose(part.background_map(), whole.background_map()[REGION[1:]], rtol=1e-6)
    y, x = part.pixel_coordinates()
    np.testing.assert_allclose(part.light_at(y, x), whole.light_at(y + 8, x + 10), rtol=1e-6)


@pytest.mark.parametrize("one", COURSES, ids=lambda e: f"{e.kind} {getattr(e, 'form', '')}")
def test_the_first_frames_of_a_movie_are_its_first_frames(one):
    model = WHOLE.with_effects(one)
    whole, part = scene_of(model), scene_of(model.in_shape(region=REGION))
    names = ("light", "background", "shift_px", "sigma_px")
    for name in names:
        np.testing.assert_allclose(getattr(part, name), getattr(whole, name)[:40], rtol=1e-6, err_msg=name)
    assert any(np.ptp(getattr(part, name), axis=0).max() > 0 for name in names)


def test_what_was_found_in_a_part_goes_on_beyond_it_by_the_same_law():
    part = plain(n_frames=30, shape=(20, 32)).with_effects(
        effect("laser_drift", change=-0.3), effect("background_gradient", relative_height=0.5)
    )
    whole = part.in_shape(n_frames=60, shape_px=(20, 64)).referring_to(Extent(frames=(0, 0.5), columns=(0.25, 0.75)))
    small, large = scene_of(part), scene_of(whole)
    np.testing.assert_allclose(large.light[:30], small.light)
    np.testing.assert_allclose(np.diff(large.light), np.diff(small.light)[0])
    np.testing.assert_allclose(large.background_map()[:, 16:48], small.background_map())
    assert large.background_map()[10, 60] > small.background_map().max()


def test_a_model_comes_back_from_the_part_that_a_diagnosis_looked_at():
    """As found there, and as it was where nothing was cropped; molecules per area stay."""
    truth = plain(n_frames=700, shape=(110, 130), **{"sample.n_molecules": 60})
    measured = prepare(simulate(truth, seed=1).movie, truth)
    assert measured.part.frames == pytest.approx((0, 6 / 7)) and measured.part.rows[0] > 0
    bench = MovieBench(measured, seed=1)
    found = measured.model.with_effects(effect("illumination_profile"))
    whole = bench.restored(found, truth)
    assert whole.effects_refer_to == measured.part and whole.acquisition == truth.acquisition
    assert whole.sample.n_molecules == pytest.approx(
        found.sample.n_molecules * 110 * 130 / np.prod(found.acquisition.shape_px), abs=1
    )
    again = prepare(simulate(truth, seed=1).movie, whole).model
    assert again.effects_refer_to is None and again.effects == found.effects
    assert Model.from_dict(whole.to_dict()) == whole
    assert bench.restored(measured.model, truth).effects_refer_to is None


def test_the_completed_model_is_that_of_the_movie_whatever_the_length_and_shape_of_the_model_believed():
    """A model.json of 1000 frames of 64 × 64 px, a movie of 700 of 110 × 130, the first 6 of them without light."""
    truth = plain(n_frames=700, shape=(110, 130), **{"sample.n_molecules": 60})
    believed = plain(n_frames=1000, shape=(64, 64), **{"sample.n_molecules": 60})
    movie = np.concatenate([simulate_dark(truth, 6, seed=2), simulate(truth, seed=1).movie[:694]])
    measured = prepare(movie, believed)
    assert measured.whole == (694, 110, 130)
    found = measured.model.with_effects(effect("laser_drift"))
    whole = MovieBench(measured, seed=1).restored(found, believed)
    assert (whole.acquisition.n_frames, whole.acquisition.shape_px) == (694, (110, 130))
    assert whole.effects_refer_to is not None and whole.effects_refer_to.frames == pytest.approx((0, 594 / 694))
    assert whole.sample.n_molecules == pytest.approx(
        found.sample.n_molecules * 110 * 130 / np.prod(found.acquisition.shape_px), abs=1
    )


def test_a_drift_found_in_the_first_frames_is_that_of_the_whole_movie():
    """Of 750 frames a diagnosis looks at 600: a change of −40 % is one of −32 % there."""
    believed = plain(n_frames=750, shape=(40, 40), **{"sample.n_molecules": 10})
    truth = believed.with_effects(effect("laser_drift", change=-0.4))
    report = nm.refine(simulate(truth, seed=2).movie, believed, [effect("laser_drift", change=-0.2)])
    (found,) = report.model.effects
    assert found.change == pytest.approx(-0.32, abs=3 * report.ranking[0].parameters_sd["change"])
    assert report.model.effects_refer_to == Extent(frames=(0, 0.8))
    assert any("carries their laws beyond it" in note for note in report.notes)
    np.testing.assert_allclose(scene_of(report.model).light, scene_of(truth).light, atol=0.04)


def test_light_flickers_on_beyond_the_part_in_which_its_flicker_was_seen():
    course = np.random.default_rng(1).standard_normal(90)
    seen = effect("laser_flicker", rms=0.1, form="pink", course=tuple(course))
    light = scene_of(plain(n_frames=300).with_effects(seen).referring_to(Extent(frames=(0, 0.3)))).light
    np.testing.assert_allclose(light[:90], 1 + 0.1 * course, rtol=1e-6)
    assert 0.03 < light[90:].std() < 0.2  # of 1/f noise, 0.1 over the movie


def test_what_is_read_off_a_part_is_told_for_the_whole():
    around = Extent(frames=(0, 2), rows=(-0.5, 1.5), columns=(0, 1))
    seen = {"course": (0.0, 0.5, 1.0), "step_at": 0.5, "seen": (0.0, 1.0, 0.2, 0.8), "seen_columns": 2}
    told = told_for(around, seen)
    assert told["course"] == (0.0, 0.5, 1.0, 1.0, 1.0, 1.0) and told["step_at"] == 0.25
    assert told["seen_columns"] == 2
    np.testing.assert_allclose(np.reshape(told["seen"], (4, 2)), [[0, 1], [0, 1], [0.2, 0.8], [0.2, 0.8]])
    same = {"path": ((0.0, 0.0), (0.5, 1.0)), "map": (1.0, 2.0), "map_columns": 2, "axis_deg": 30.0}
    assert told_for(Extent(), same) == same


def test_an_extent_that_ends_before_it_starts_is_told():
    with pytest.raises(MufasaError, match="start < stop"):
        Model.from_dict(WHOLE.to_dict() | {"effects_refer_to": {"frames": [1.0, 0.5]}})
    with pytest.raises(MufasaError, match="effects_refer_to"):
        Model.from_dict(WHOLE.to_dict() | {"effects_refer_to": {"frame": [0.0, 0.5]}})


def test_parts_of_parts():
    shape = (60, 40, 64)
    part = Extent.of(REGION, shape)
    assert part.within(WHOLE.acquisition) == pytest.approx(np.array([(0, 40), (8, 33), (10, 44)]))
    inner = Extent(frames=(0.2, 0.6))
    assert inner.placed_in(part).seen_from(part).frames == pytest.approx(inner.frames)
    assert Extent().seen_from(Extent()).is_whole and not part.is_whole
