"""Places of misfit: nothing where the model is right, the right place where it is not."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from napari_mufasa.discover.places import find_places, place_of
from napari_mufasa.effects import effect_from_data
from napari_mufasa.errors import Cancelled
from napari_mufasa.model.extent import Extent
from napari_mufasa.samples import puzzle_model
from napari_mufasa.simulate.movie import simulate, simulate_dark

BELIEVED = puzzle_model().with_values(
    {"acquisition.n_frames": 100, "acquisition.shape_px": (48, 48), "sample.n_molecules": 16}
)


def places(effect=None, seed=3):
    truth = BELIEVED.with_effects(effect_from_data(effect)) if effect else BELIEVED
    return find_places(measured(simulate(truth, seed=seed).movie, simulate_dark(truth, 30, seed)), BELIEVED, (48, 48))


def measured(movie, dark=None, part=None, first_frame=0):
    return SimpleNamespace(movie=movie, dark=dark, model=BELIEVED, part=part or Extent(), first_frame=first_frame)


@pytest.fixture(scope="module")
def of_nothing():
    return places()


def test_where_the_model_is_right_maps_are_noise_of_unit_size(of_nothing):
    # Away from spots, whose brightness is each molecule's own chance. Six movies give the spread: ± 25 %.
    for name in ("pixels", "noise", "memory", "dark"):
        core = np.clip(of_nothing.maps[name], -5, 5)
        assert 0.7 < core.std() < 1.4, name
        assert abs(np.median(core)) < 0.3, name
    assert np.abs(of_nothing.frames).std() < 2
    assert (np.abs(of_nothing.molecules.iloc[:, 2:]) > 4).to_numpy().mean() < 0.05


def test_background_gradient_is_seen_in_the_mean_image(of_nothing):
    found = places({"kind": "background_gradient"})

    # Misfit that varies smoothly over the field: blocks of 12 × 12 pixels differ far beyond their noise.
    def unevenness(z):
        return z.reshape(4, 12, 4, 12).mean(axis=(1, 3)).std()

    assert unevenness(found.maps["light"]) > 3 * unevenness(of_nothing.maps["light"])
    assert place_of("background_map_tilt") == "light"
    assert place_of("level_position_background") == "light" and place_of("level_time_background") == "course"


def test_drift_is_seen_at_the_ends_of_the_movie(of_nothing):
    found = places({"kind": "stage_drift", "distance_px": 4.0})
    size = np.square(found.maps["course"]).mean(axis=(1, 2))
    # Molecules are placed where they are on average: both ends are off, the middle is least.
    assert size[[0, -1]].min() > 1.3 * size[len(size) // 2]
    assert size.max() > 4 * np.square(of_nothing.maps["course"]).mean()
    assert place_of("common_shift_end") == "course"


def test_blinking_is_seen_at_the_molecules(of_nothing):
    found = places({"kind": "triplet_blinking"})
    assert len(found.molecules) == pytest.approx(16, abs=4)
    assert found.molecules["memory"].abs().median() > 3 * of_nothing.molecules["memory"].abs().median()
    assert place_of("autocorrelation_1") == "molecules:memory"
    assert place_of("autocorrelation_20") == "molecules:memory"


def test_hot_pixels_of_the_dark_frames_are_where_they_are():
    dark = simulate_dark(BELIEVED, 30, 3)
    dark[:, 11, 37] += 400
    movie = simulate(BELIEVED, seed=3).movie
    found = find_places(measured(movie, dark), BELIEVED, (48, 48))
    assert np.unravel_index(found.maps["dark"].argmax(), (48, 48)) == (11, 37)
    assert place_of("dark_narrow_bright") == "dark"


def test_a_central_part_knows_where_it_lies():
    movie = simulate(BELIEVED, seed=3).movie
    part = Extent(rows=(50 / 148, 98 / 148), columns=(20 / 88, 68 / 88))
    found = find_places(measured(movie, part=part), BELIEVED, (148, 88))
    assert found.offset_px == (50, 20)
    assert found.molecules["y_px"].between(50, 98).all() and found.molecules["x_px"].between(20, 68).all()
    assert "dark" not in found.maps


def test_frames_are_counted_in_the_layer_s_own(viewer):
    """Four of a layer's frames are left out by the Data step, six more are dark: the brighter one is 4 + 6 + 70."""
    from napari_mufasa.discover.measurement import prepare
    from napari_mufasa.widgets.parts.place_layers import PlaceLayers, map_of, simulated_of

    lit = simulate(BELIEVED, seed=3).movie
    lit[60:80] += 10
    lit[70] += 30
    dark = simulate_dark(BELIEVED, 30, 3)
    looked_at = prepare(np.concatenate([dark[:6], lit]), BELIEVED.in_shape(n_frames=106), dark)
    assert looked_at.first_frame == 6 and len(looked_at.movie) == 100
    found = find_places(looked_at, BELIEVED, (48, 48), 4)
    layer = viewer.add_image(np.zeros((110, 48, 48)), name="movie", scale=(0.5, 1, 1))
    shown = PlaceLayers(viewer)
    assert shown.show_place("single_frame_jump", found, layer).startswith("Frame 80 is farthest off")
    assert viewer.dims.point[0] == 40
    assert simulated_of(found, layer, "simulated").translate[0] == 5
    # The middle of the first of five stretches of twenty frames, of those from 10.
    assert map_of("course", found, layer).translate[0] == pytest.approx((10 + 9.5) * 0.5)
    assert "frames 70 … 89 are farthest off" in shown.show_place("ensemble", found, layer)


def test_cancel_stops_it():
    movie = simulate(BELIEVED, seed=3).movie
    with pytest.raises(Cancelled):
        find_places(measured(movie), BELIEVED, (48, 48), cancel=lambda: True)


def test_layers_of_a_place_follow_the_units_of_the_movie_and_its_frames_beside_more_axes(viewer):
    from napari.layers import Image

    from napari_mufasa.widgets.parts.place_layers import PlaceLayers

    shown, movie = PlaceLayers(viewer), viewer.add_image(np.zeros((9, 4, 4)), name="movie", scale=(0.5, 1, 1))
    for units in (("pixel",) * 3, ("pixel", "um", "um")):
        shown.show("map", Image(np.zeros((1, 4, 4)), units=units), movie)
        assert tuple(str(unit) for unit in shown.get("map").units[1:]) == (
            ("micrometer",) * 2 if "um" in units else ("pixel",) * 2
        )
    viewer.add_image(np.zeros((3, 9, 4, 4)), name="more axes", scale=(1, 0.5, 1, 1))
    viewer.dims.set_point(0, 2)
    shown._go_to(6, movie)
    assert tuple(viewer.dims.point[:2]) == (2, 3)
