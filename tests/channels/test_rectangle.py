"""One channel of a movie (docs/two_channels.md)."""

from __future__ import annotations

import dask.array as da
import numpy as np
import pytest
import zarr

import napari_mufasa as nm
from napari_mufasa.channels.rectangle import Rectangle, around, check_apart, rectangle
from napari_mufasa.errors import MufasaError


@pytest.mark.parametrize(
    ("where", "wanted"),
    [
        ("left", (0, 40, 0, 30)), ("right", (0, 40, 31, 61)), ("top", (0, 20, 0, 61)), ("bottom", (20, 40, 0, 61)),
        ("3:30, 10:61", (3, 30, 10, 61)), (" Left ", (0, 40, 0, 30)),
    ],
)  # fmt: skip
def test_a_rectangle_is_named_or_given(where, wanted):
    found = rectangle(where, (40, 61))
    assert found == Rectangle(*wanted) and rectangle(str(found), (40, 61)) == found


@pytest.mark.parametrize(
    ("where", "word"),
    [
        ("middle", "left, right"), ("0:9", "Y0:Y1"), ("0:41,0:20", "leaves the frames"), ("9:3,0:20", "narrower"),
        ("0:40,0:4", "narrower"), ("-1:20,0:20", "Y0:Y1"), (None, "left, right"), (5, "left, right"),
        (Rectangle(-1, 20, 0, 20), "narrower"),
    ],
)  # fmt: skip
def test_bad_input_is_named(where, word):
    with pytest.raises(MufasaError, match=word):
        rectangle(where, (40, 61))


@pytest.mark.parametrize("kind", ["numpy", "dask", "zarr"])
def test_a_part_is_what_slicing_gives_and_nothing_is_read(kind, tmp_path):
    movie = np.random.default_rng(0).integers(0, 500, (5, 40, 61), dtype=np.uint16)
    whole = {
        "numpy": lambda: movie,
        "dask": lambda: da.from_array(movie, chunks=(1, 40, 61)),
        "zarr": lambda: zarr.create_array(tmp_path / "m.zarr", data=movie, chunks=(2, 40, 61)),
    }[kind]()
    part = Rectangle(3, 30, 10, 50).crop(whole)
    assert kind != "zarr" or part.chunks[0] == (2, 2, 1)  # what is asked of it reads no more than it must
    assert part.shape == (5, 27, 40) and (kind == "numpy" or isinstance(part, da.Array))
    assert kind != "numpy" or np.shares_memory(part, movie)
    np.testing.assert_array_equal(np.asarray(part), movie[:, 3:30, 10:50])
    with pytest.raises(MufasaError, match="leaves the frames"):
        Rectangle(0, 41, 0, 20).crop(whole)


def test_maps_of_the_camera_are_cut_with_the_frames():
    offset = np.arange(40 * 61.0).reshape(40, 61)
    model = nm.preset("FF").with_values({"acquisition.shape_px": (40, 61), "camera.offset_map_adu": offset})
    part = Rectangle(3, 30, 10, 50).model(model, (40, 61))
    assert part.acquisition.shape_px == (27, 40)
    np.testing.assert_array_equal(part.camera.offset_map_adu, offset[3:30, 10:50])
    # A model of another field keeps its own.
    other = nm.preset("FF").with_values({"acquisition.shape_px": (50, 50)})
    assert Rectangle(3, 30, 10, 50).model(other, (40, 61)) == other


def test_a_drawn_shape_holds_the_pixels_whose_centres_it_encloses():
    corners = np.array([[0, 2.6, 9.5], [0, 2.6, 50.2], [0, 30.4, 50.2], [0, 30.4, 9.5]])  # (frame, y, x)
    assert around(corners, (40, 61)) == Rectangle(3, 31, 10, 51)
    assert around(corners + np.array([0, 20, 0]), (40, 61)) == Rectangle(
        23, 40, 10, 51
    )  # beyond the frames there is nothing
    with pytest.raises(MufasaError, match="draw it larger"):
        around(corners + np.array([0, 35, 0]), (40, 61))


def test_channels_must_not_share_pixels():
    check_apart(Rectangle(0, 40, 0, 30), Rectangle(0, 40, 30, 61))
    with pytest.raises(MufasaError, match="share pixels"):
        check_apart(Rectangle(0, 40, 0, 31), Rectangle(0, 40, 30, 61))
