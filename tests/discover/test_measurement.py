"""Movies that begin before the light comes on: what is dark is no movie."""

from __future__ import annotations

import numpy as np

import napari_mufasa as nm
from napari_mufasa.discover.measurement import LEAST_DARK, prepare
from napari_mufasa.effects import effect_class

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
    assert found.notes == ("Frames 0 to 29 are dark: they are taken as dark frames, the others as the movie.",)


def test_dark_frames_that_are_given_and_a_few_that_are_not_leave_the_movie_as_it_is():
    whole, dark, _ = begun_dark(30)
    np.testing.assert_array_equal(prepare(whole, model(), dark).movie, whole)
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
