"""A field full of spots: all of them are found, and no pattern of a sensor is taken for such a field."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial import KDTree
from tests.blind import generator

import napari_mufasa as nm
from napari_mufasa.camera.frames import Frames
from napari_mufasa.observe import observe
from napari_mufasa.spots.crowding import Between, spread_without_spots
from napari_mufasa.spots.filters import lower_spread, spot_filter
from napari_mufasa.spots.find import find_spots
from napari_mufasa.traces import extract_traces

SIGMA, SIDE = 1.3, 128


@cache
def movie_of(camera, n, *effects):
    """An independent movie of n molecules, 5 px apart where there is room: what was believed, and where they are."""
    case = generator.make(generator.base_model(camera), seed=900, n_molecules=n, effects=list(effects))
    return case.movie, nm.Model.from_dict(case.believed), np.array(case.truth["positions_px"])


def field(n, seed, noise=0.02):
    """A filtered image of n spots of height 1 at random places, and of the noise alone."""
    rng = np.random.default_rng(seed)
    spots = np.zeros((SIDE, SIDE))
    np.add.at(spots, tuple(rng.integers(0, SIDE, (2, n))), 2 * np.pi * (SIGMA**2 + 1 / 12))
    uneven = rng.normal(0, noise, (SIDE, SIDE))
    spots = ndimage.gaussian_filter(spots, np.sqrt(SIGMA**2 + 1 / 12)) + uneven
    return (spot_filter(np.float32(image)[None], SIGMA)[0] for image in (spots, uneven))


@pytest.mark.parametrize(("camera", "n", "least"), [("emccd", 200, 0.97), ("emccd", 300, 0.65), ("cmos", 200, 0.97)])
def test_spots_are_found_where_hardly_a_pixel_is_free_of_them(camera, n, least):
    # The lower half of the image tells their light, not what is uneven between them: by it 24 of 250 were found.
    movie, model, places = movie_of(camera, n)
    found = find_spots(Frames(movie, model.camera), model.sigma_px)
    distance, whose = KDTree(places).query(found.positions_px[found.is_spot])
    assert len(set(whose[distance < 1.5])) >= least * n
    assert np.mean(distance < 1.5) > 0.95


def test_traces_of_a_crowded_field_are_those_of_single_molecules():
    alone, crowded = (kept_of(*movie_of("emccd", n)) for n in (50, 250))
    # Where few spots were found none of their neighbours were: 9 of 9 kept had one within reach, 25 % too bright.
    assert len(crowded) >= 100 and np.mean(crowded["neighbour_px"] < 3.5 * 1.27) < 0.08
    # One that is taken for two is twice as bright: where 4 % are it makes 4 %.
    assert crowded["brightness"].mean() == pytest.approx(alone["brightness"].mean(), rel=0.045)


def kept_of(movie, model, places):
    """Molecules kept, beside how far from them the second molecule is."""
    found = extract_traces(movie, model.camera, psf_sigma_px=model.sigma_px).molecules
    kept = found[found["kept"]]
    return kept.assign(neighbour_px=KDTree(places).query(kept[["y_px", "x_px"]], k=2)[0][:, 1])


def test_where_spots_are_few_the_lower_half_of_the_image_tells():
    movie, model, _ = movie_of("emccd", 50, ("pixel_gain_variation", 1.0))
    evidence = find_spots(Frames(movie, model.camera), model.sigma_px).evidence
    assert evidence.spread == lower_spread(evidence.image)


@pytest.mark.parametrize("n", [300, 600, 1000])
def test_spots_that_are_taken_out_leave_what_is_uneven_between_them(n):
    spots, uneven = field(n, seed=n)
    assert lower_spread(spots) > 5 * lower_spread(uneven)
    assert spread_without_spots(spots, SIGMA) < 0.4 * lower_spread(spots)


@pytest.mark.parametrize("grain_px", [0.0, 0.7, 1.3, 2.0, 4.0])
def test_a_pattern_without_spots_is_not_a_crowded_field(grain_px):
    # It is as uneven downwards as upwards; and many a maximum is far above the noise.
    pattern = ndimage.gaussian_filter(np.random.default_rng(7).normal(size=(SIDE, SIDE)), grain_px)
    image = spot_filter(np.float32(pattern / pattern.std())[None], SIGMA)[0]
    noise = np.full_like(image, lower_spread(image) / 50)
    between = Between.of(image, noise, SIGMA)
    assert between.crowded == 0 and between.spread(image) == lower_spread(image)


@pytest.mark.parametrize("period_px", [4.0, 5.0, 6.0, 8.0])
@pytest.mark.parametrize("kind", ["fringes", "egg crate", "mesh"])
def test_a_regular_pattern_is_not_a_crowded_field(kind, period_px):
    # CLEAN takes much of it out: what tells is that it is no more uneven upwards than downwards.
    y, x = np.mgrid[:SIDE, :SIDE]
    waves = np.sin(2 * np.pi * np.stack([0.9 * x + 0.4 * y, x + 0.3, y + 0.1]) / period_px)
    pattern = {"fringes": waves[0], "egg crate": waves[1] * waves[2], "mesh": (waves[1:] > 0.8).any(axis=0)}[kind]
    light = 100 * (1 + 0.05 * pattern)
    movie = np.random.default_rng(5).poisson(light, (200, SIDE, SIDE)).astype(np.uint16)
    camera = nm.Model.from_dict(generator.base_model("cmos")).camera
    camera = camera.model_copy(update={"electrons_per_adu": 1.0, "baseline_adu": 0.0})
    found = find_spots(Frames(movie, camera), SIGMA)
    assert found.evidence.spread == lower_spread(found.evidence.image)
    assert found.is_spot.sum() <= 3


def test_a_large_field_is_judged_by_its_middle():
    spots, uneven = field(600, seed=3)
    tiles = np.tile(spots, (6, 6)), np.tile(uneven, (6, 6))  # 768 × 768
    noise = np.full_like(tiles[0], lower_spread(uneven))
    whole, part = Between.of(tiles[0], noise, SIGMA), Between.of(spots, noise[:SIDE, :SIDE], SIGMA)
    # The middle of 512 px holds 16 of the 128 px tiles, their borders not those of a field alone.
    assert whole.crowded == pytest.approx(part.crowded, abs=0.1) and part.crowded > 0.8
    assert whole.of_mean < 0.5 * lower_spread(tiles[0])
    assert whole.spread(tiles[0]) == pytest.approx(whole.of_mean)


def test_more_molecules_show_more_spots_until_they_merge():
    # A diagnosis reads the number of molecules off them.
    model = nm.Model.from_dict(generator.base_model("emccd"))
    found = [observe(movie_of("emccd", n)[0], model).spots for n in (50, 100, 150, 200, 250)]
    assert (np.diff([len(spots.positions_px) for spots in found]) > 20).all()
