"""The light of a real movie, as it is read off, against the beam's profile that was recorded apart."""

from pathlib import Path

import numpy as np
import pytest
from tests.real_data import real_data

from napari_mufasa import files
from napari_mufasa.chance.streams import Streams
from napari_mufasa.discover.measurement import prepare
from napari_mufasa.discover.movie_bench import MovieBench
from napari_mufasa.effects import effect_class
from napari_mufasa.model.model import Model
from napari_mufasa.simulate.scene import build_scene

BELIEVED = Path(__file__).parents[2] / "docs" / "models" / "polymerase_ixon888.json"
OFFSET_ADU = 433


@pytest.mark.realdata
def test_uneven_light_seen_in_a_part_of_the_field_is_that_of_the_beam_in_all_of_it():
    model = Model.from_json(BELIEVED)
    movie, dark = (files.load(real_data(f"polymerase_ixon888_{name}.tif")) for name in ("emccd", "dark"))
    beam = np.squeeze(files.load(real_data("polymerase_ixon888_beam.tif"))).astype(float) - OFFSET_ADU
    bench = MovieBench(prepare(movie, model, dark), seed=1)
    assert not bench.measurement.part.is_whole
    light = effect_class("illumination_profile")(form="as_seen", **bench.read_off("illumination_profile"))
    whole = bench.restored(bench.start.with_effects(light), model)
    scene = build_scene(whole, np.zeros((0, 2)), Streams(1))
    profile = scene.light_at(*scene.pixel_coordinates())
    assert profile.shape == beam.shape
    assert np.corrcoef(profile.ravel(), beam.ravel())[0, 1] > 0.98
    # How dim the edge is, is fitted by simulations; the shape is not. (Stretched over the field, it is 19 % off.)
    depth, level = np.polyfit(profile.ravel(), beam.ravel(), 1)
    ratio = (level + depth * profile) / beam
    assert np.abs(ratio[:, 64:] - 1).max() < 0.15
