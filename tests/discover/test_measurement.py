"""Movies that begin before the light comes on: what is dark is no movie."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

import napari_mufasa as nm
from napari_mufasa.discover.measurement import LEAST_DARK, prepare
from napari_mufasa.effects import effect_class
from napari_mufasa.files.layers import measurement_of

SMALL = {"acquisition.shape_px": (48, 48), "acquisition.n_frames": 60, "sample.n_molecules": 10}


def model() -> nm.Model:
    return nm.preset("FF").with_values(SMALL)


def begun_dark(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    dark, lit = nm.simulate_dark(model(), 30, seed=2)[:n], nm.simulate(model(), seed=1).movie
    return np.concatenate([dark, lit]), dark, lit


def test_frames_before_the_light_comes_on_are_dark_frames():
    whole, dark, lit = begun_dark(30)
    found = prepare(whole, model())
    np.testing.assert_array_equal(found.movie, lit)
    np.testing.assert_array_equal(found.dark, dark)
    assert found.model.acquisition.n_frames == len(lit)
    assert found.notes == ("The first 30 frames are dark: they are taken as dark frames, the others as the movie.",)


def test_unlit_ends_are_left_out_where_dark_frames_are_given_too():
    whole, dark, lit = begun_dark(30)
    found = prepare(whole, model(), dark)
    np.testing.assert_array_equal(found.movie, lit)
    np.testing.assert_array_equal(found.dark, dark)
    assert found.notes == ("The first 30 frames are dark: they are left out.",)
    ended = prepare(np.concatenate([lit, dark]), model(), dark)
    np.testing.assert_array_equal(ended.movie, lit)
    assert ended.whole == lit.shape == ended.movie.shape and ended.model.acquisition.n_frames == len(lit)
    assert ended.notes == ("The last 30 frames are dark: they are left out.",)


def test_a_long_movie_whose_light_goes_off_ends_there():
    """Its model simulated lit light in the dark frames that nobody looked at."""
    rng = np.random.default_rng(1)
    lit, dark = (rng.normal(level, 20, (n, 24, 24)).round().astype(np.uint16) for level, n in ((900, 400), (500, 300)))
    found = prepare(np.concatenate([lit, dark]), model(), dark)
    assert found.whole == (400, 24, 24) and found.model.acquisition.n_frames == 400
    later = prepare(np.concatenate([dark[:20], lit, lit]), model(), dark)
    assert later.whole == (800, 24, 24) and len(later.movie) == 580


def test_what_is_left_of_a_movie_begins_with_an_even_frame():
    """Even and odd frames may have baselines of their own, and a model speaks of the whole movie's."""
    whole, dark, lit = begun_dark(29)
    for found in (prepare(whole, model()), prepare(whole, model(), dark)):
        np.testing.assert_array_equal(found.movie, lit[1:])
        assert found.notes[0].startswith("The first 29 frames are dark")
    many = np.concatenate([nm.simulate_dark(model(), 71, seed=2), lit])
    np.testing.assert_array_equal(prepare(many, model()).dark, many[12:71])
    layer = SimpleNamespace(data=whole, metadata={}, name="movie")
    cut = measurement_of(layer, dark_frames=29)
    np.testing.assert_array_equal(cut.movie, lit[1:])
    np.testing.assert_array_equal(cut.dark, dark)
    assert cut.first_frame == 30


def test_light_that_falls_to_a_fifth_is_not_gone_by_the_dark_frames():
    falls = effect_class("laser_drift")(change=-0.8, form="step", step_at=0.6)
    fallen = model().with_effects(falls).with_values({"optics.background_photons_per_px": 60.0})
    movie = nm.simulate(fallen, seed=1).movie
    assert prepare(movie, model(), nm.simulate_dark(model(), 30, seed=2)).movie.shape == movie.shape


@pytest.mark.parametrize("given", [True, False])
@pytest.mark.parametrize("change", [-0.4, -0.5])
def test_frames_before_the_light_are_dark_though_the_laser_falls_later(change, given):
    """The fall, which is none of the light's end, made the dark frames light, too."""
    falls = effect_class("laser_drift")(change=change, form="step", step_at=0.6)
    fallen = model().with_effects(falls).with_values({"optics.background_photons_per_px": 60.0})
    dark, lit = nm.simulate_dark(model(), 30, seed=2), nm.simulate(fallen, seed=1).movie
    found = prepare(np.concatenate([dark, lit]), model(), dark if given else None)
    np.testing.assert_array_equal(found.movie, lit)
    np.testing.assert_array_equal(found.dark, dark)


def test_an_end_that_is_lit_by_the_level_believed_makes_no_dark_frames_lit():
    """At either end a sudden change, one of a part of the field only."""
    dark, lit = nm.simulate_dark(model(), 30, seed=2), nm.simulate(model(), seed=1).movie
    part = lit[:30].copy()
    part[:, :40] = dark[:, :40]
    found = prepare(np.concatenate([part, lit, dark]), model(), dark)
    assert len(found.movie) == 30 + len(lit) and found.notes == ("The last 30 frames are dark: they are left out.",)


def test_a_few_dark_frames_before_the_light_do_not_serve_as_dark_frames():
    few = begun_dark(LEAST_DARK - 1)[0]
    assert prepare(few, model()).dark is None


def test_light_that_grows_is_no_light_that_comes_on():
    """A laser that rises to 2.5 times its power, all of a sudden, is an effect to be found."""
    step = effect_class("laser_drift")(change=1.5, form="step", step_at=0.4)
    risen = model().with_effects(step).with_values({"optics.background_photons_per_px": 20.0})
    movie = nm.simulate(risen, seed=1).movie
    assert prepare(movie, model()).dark is None


def test_a_part_of_the_field_that_lights_up_is_no_light_that_comes_on():
    whole, *_ = begun_dark(30)
    whole[:, :40] = nm.simulate_dark(model(), len(whole), seed=3)[:, :40]
    assert prepare(whole, model()).dark is None
