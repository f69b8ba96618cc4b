"""Files: what goes in comes out, what is damaged is told in one line, nothing is half-written (docs/files.md)."""

import importlib.util
import json
import re
import warnings

import numpy as np
import pandas as pd
import pytest
import tifffile
import zarr
from tests.files.microscopes import write_micro_manager_stack
from tests.trust.refusal import check_line

from napari_mufasa import Cancelled, Model, MufasaError, files, preset
from napari_mufasa.effects import catalogue

RNG = np.random.default_rng(1)
MOVIE = RNG.integers(0, 65535, (7, 12, 20), dtype=np.uint16)
MODEL = (
    preset("FF")
    .with_values({"acquisition.shape_px": [12, 20], "acquisition.n_frames": 7, "acquisition.pixel_size_nm": 107.5})
    .with_effects(catalogue()["stage_drift"](distance_px=2.5), catalogue()["row_noise"]())
)


def blocks(movie, size=3):
    yield from (movie[i : i + size] for i in range(0, len(movie), size))


def complaint(action, *args):
    with pytest.raises(MufasaError) as caught:
        action(*args)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("name", ["m.ome.tif", "m.tif", "m.tiff", "m.zarr", "with space µ.ome.tif"])
@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_movies_come_back_with_model_and_seed(tmp_path, name, dtype):
    movie = MOVIE.astype(dtype)
    files.write_movie(tmp_path / name, blocks(movie), movie.shape, dtype, model=MODEL, seed=np.int64(42))
    back = files.read_movie(tmp_path / name)
    assert back.data.dtype == dtype
    np.testing.assert_array_equal(np.asarray(back.data), movie)
    np.testing.assert_array_equal(np.asarray(back.data[2:5, 3]), movie[2:5, 3])
    assert (Model.stored_in(back.metadata), back.seed) == (MODEL, 42)
    np.testing.assert_array_equal(files.load(tmp_path / name), movie)
    assert [p.name for p in tmp_path.iterdir()] == [name]


def test_pixel_size_is_in_the_ome_description(tmp_path):
    path = tmp_path / "m.ome.tif"
    files.write_movie(path, [MOVIE], MOVIE.shape, np.uint16, model=MODEL)
    with tifffile.TiffFile(path) as file:
        pixels = tifffile.xml2dict(file.ome_metadata)["OME"]["Image"]["Pixels"]
    assert (pixels["PhysicalSizeX"], pixels["PhysicalSizeXUnit"]) == (pytest.approx(0.1075), "µm")
    assert (pixels["PhysicalSizeY"], pixels["PhysicalSizeYUnit"]) == (pytest.approx(0.1075), "µm")
    assert (pixels["SizeT"], pixels["SizeY"], pixels["SizeX"]) == (7, 12, 20)


def test_a_single_frame_movie_keeps_its_axis(tmp_path):
    for name in ("one.ome.tif", "one.zarr"):
        files.write_movie(tmp_path / name, [MOVIE[:1]], (1, 12, 20), np.uint16, seed=3)
        assert files.load(tmp_path / name).shape == (1, 12, 20)


def test_foreign_files_are_read(tmp_path):
    tifffile.imwrite(tmp_path / "plain.tif", MOVIE)
    tifffile.imwrite(tmp_path / "image.tif", MOVIE[0])
    tifffile.imwrite(tmp_path / "imagej.tif", MOVIE, imagej=True, metadata={"axes": "TYX"})
    tifffile.imwrite(tmp_path / "ones.ome.tif", MOVIE[:, None, None], metadata={"axes": "TCZYX"})
    tifffile.imwrite(tmp_path / "packed.tif", MOVIE, compression="zlib")
    zarr.save_array(str(tmp_path / "plain.zarr"), MOVIE)
    for name in ("plain.tif", "imagej.tif", "ones.ome.tif", "packed.tif", "plain.zarr"):
        movie = files.read_movie(tmp_path / name)
        np.testing.assert_array_equal(np.asarray(movie.data), MOVIE)
        assert Model.stored_in(movie.metadata) is None and movie.seed is None
    assert files.load(tmp_path / "image.tif").shape == (1, 12, 20)


def test_frames_are_streamed(tmp_path):
    """A block is asked for only when the last one is written: memory is one block."""
    for name in ("m.zarr", "m.ome.tif"):
        given = []

        def stream(given=given):
            for i in range(7):
                given.append(i)
                yield np.full((1, 12, 20), i, np.uint16)

        files.write_movie(tmp_path / name, stream(), (7, 12, 20), np.uint16)
        assert given == list(range(7))
        assert files.load(tmp_path / name)[:, 0, 0].tolist() == list(range(7))


def test_a_stored_model_that_cannot_be_restored_leaves_the_movie_readable(tmp_path):
    files.write_movie(tmp_path / "m.zarr", [MOVIE], MOVIE.shape, np.uint16, model=MODEL, seed=5)
    array = zarr.open_array(str(tmp_path / "m.zarr"), mode="r+")
    stored = array.attrs[files.METADATA_KEY]
    stored["model"]["effects"][0]["kind"] = "effect_of_a_package_not_installed"
    array.attrs[files.METADATA_KEY] = stored
    movie = files.read_movie(tmp_path / "m.zarr")
    with pytest.warns(UserWarning, match="effect_of_a_package_not_installed"):
        assert Model.stored_in(movie.metadata) is None
    assert movie.seed == 5 and movie.data.shape == MOVIE.shape


def test_missing(tmp_path):
    assert "no file" in complaint(files.read_movie, tmp_path / "nowhere.tif")


@pytest.mark.parametrize("content", [b"", b"not a tiff at all", b"II*\x00\x08\x00\x00\x00\x00\x00\x00\x00\x00\x00"])
def test_garbage_is_told_in_one_line(tmp_path, content):
    path = tmp_path / "bad.tif"
    path.write_bytes(content)
    assert "bad.tif" in complaint(files.read_movie, path)


@pytest.mark.parametrize("share", [0.02, 0.3, 0.6, 0.95])
@pytest.mark.parametrize("ome", [True, False])
def test_truncated_files_are_told(tmp_path, share, ome):
    path = tmp_path / ("bad.ome.tif" if ome else "bad.tif")
    if ome:
        files.write_movie(path, [MOVIE], MOVIE.shape, np.uint16, model=MODEL)
    else:
        tifffile.imwrite(path, MOVIE)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    assert "bad" in complaint(files.load, path)


FRAMES = RNG.poisson(300, (40, 48, 48)).astype(np.uint16)


def write_pages(path, **options):
    """A TIFF that says nothing of how many pages it has."""
    with tifffile.TiffWriter(path) as file:
        for frame in FRAMES:
            file.write(frame, photometric="minisblack", metadata=None, contiguous=False, **options)


PACKED = {
    "shaped.tif": lambda path: tifffile.imwrite(path, FRAMES, photometric="minisblack", compression="zlib"),
    "imagej.tif": lambda path: tifffile.imwrite(path, FRAMES, imagej=True, compression="zlib"),
    "pages.tif": lambda path: write_pages(path, compression="zlib"),
    "big.tif": lambda path: tifffile.imwrite(path, FRAMES, bigtiff=True, compression="zlib"),
    "m.ome.tif": lambda path: tifffile.imwrite(path, FRAMES, compression="zlib", metadata={"axes": "TYX"}),
    "unpacked.tif": write_pages,
}


@pytest.mark.parametrize("name", list(PACKED))
@pytest.mark.parametrize("filling", [0, 255, None])
def test_a_movie_that_is_damaged_in_the_middle_is_told_wherever_it_is(tmp_path, name, filling):
    path = tmp_path / name
    PACKED[name](path)
    np.testing.assert_array_equal(files.load(path), FRAMES)
    whole = path.read_bytes()
    for at in np.linspace(0.1, 0.97, 12):
        start, damaged = int(at * len(whole)), bytearray(whole)
        n = min(6000, len(whole) - start)  # more than a page and its head, wherever they begin
        damaged[start : start + n] = RNG.bytes(n) if filling is None else bytes([filling]) * n
        path.write_bytes(damaged)
        check_line(complaint(files.load, path), name)


@pytest.mark.parametrize("name", ["pages.tif", "shaped.tif", "imagej.tif"])
def test_a_few_bytes_behind_the_pages_are_no_damage(tmp_path, name):
    path = tmp_path / name
    tifffile.imwrite(
        path, np.zeros_like(FRAMES), compression="zlib", metadata=None
    )  # pages of fewer bytes than a sector
    path.write_bytes(path.read_bytes() + bytes(512))
    assert files.load(path).shape == FRAMES.shape
    PACKED[name](path)
    path.write_bytes(path.read_bytes() + bytes(512))
    np.testing.assert_array_equal(files.load(path), FRAMES)


def test_a_movie_with_a_broken_chain_of_pages_says_what_was_announced(tmp_path):
    path = tmp_path / "m.tif"
    PACKED["shaped.tif"](path)
    with tifffile.TiffFile(path) as file:
        head = file.pages[21].offset
    with path.open("r+b") as file:
        file.seek(head)
        file.write(bytes(200))
    told = complaint(files.read_movie, path)
    check_line(told, "announces 40 frames, its 22 pages hold fewer: damaged; copy it anew or export it anew")


def test_a_page_of_another_shape_between_the_frames_is_told_and_a_second_image_is_not_read(tmp_path):
    path = tmp_path / "m.tif"
    for lone in (1, 40):
        with tifffile.TiffWriter(path) as file:
            for i in range(41):
                frame = FRAMES[0, :10] if i == lone else FRAMES[i - (i > lone)]
                file.write(frame, photometric="minisblack", metadata=None, contiguous=False)
        if lone < 40:
            check_line(complaint(files.read_movie, path), f"page {lone + 1} of 41 is no frame like the others: damaged")
    with pytest.warns(UserWarning, match="holds 2 series of images: the first"):
        np.testing.assert_array_equal(files.load(path), FRAMES)


def test_a_large_stack_of_imagej_that_is_cut_short_is_told(tmp_path):
    path = tmp_path / "m.tif"
    tifffile.imwrite(path, FRAMES, imagej=True, metadata={"axes": "TYX"})
    with tifffile.TiffFile(path) as file:  # above 4 GB ImageJ writes one head for all frames
        behind = file.pages.first.offset + 2 + 12 * len(file.pages.first.tags)
    with path.open("r+b") as file:
        file.seek(behind)
        file.write(bytes(4))
    np.testing.assert_array_equal(files.load(path), FRAMES)
    path.write_bytes(path.read_bytes()[:120_000])
    check_line(complaint(files.load, path), "behind the 1 frames that can be read: damaged; copy it anew")


def test_a_stack_of_imagej_that_another_program_shortened_is_read(tmp_path):
    path = tmp_path / "m.tif"
    with tifffile.TiffWriter(path) as file:
        for i, frame in enumerate(FRAMES):
            told = "ImageJ=1.53t\nimages=100\nframes=100\n" if i == 0 else None
            file.write(frame, photometric="minisblack", metadata=None, contiguous=False, description=told)
    with pytest.warns(UserWarning, match="announces 100 frames, 40 are there, which are read"):
        np.testing.assert_array_equal(files.load(path), FRAMES)


def test_damaged_zarr_is_told(tmp_path):
    (tmp_path / "empty.zarr").mkdir()
    assert "empty.zarr" in complaint(files.read_movie, tmp_path / "empty.zarr")
    files.write_movie(tmp_path / "m.zarr", [MOVIE], MOVIE.shape, np.uint16)
    (tmp_path / "m.zarr" / "zarr.json").write_text("{")
    assert "m.zarr" in complaint(files.read_movie, tmp_path / "m.zarr")


def write_two_files(folder):
    """A movie of eight frames as microscopes split it: two OME-TIFFs that name one another."""
    names = ("a.ome.tif", "b.ome.tif")
    told = "".join(
        f'<TiffData IFD="0" FirstT="{4 * i}" PlaneCount="4"><UUID FileName="{name}">urn:uuid:{name}</UUID></TiffData>'
        for i, name in enumerate(names)
    )
    for i, name in enumerate(names):
        xml = (
            '<?xml version="1.0"?><OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06" '
            f'UUID="urn:uuid:{name}"><Image ID="Image:0"><Pixels ID="Pixels:0" DimensionOrder="XYZCT" Type="uint16" '
            f'SizeX="20" SizeY="12" SizeZ="1" SizeC="1" SizeT="8">{told}</Pixels></Image></OME>'
        )
        tifffile.imwrite(
            folder / name, TWO[4 * i : 4 * i + 4], description=xml, metadata=None, photometric="minisblack"
        )


TWO = np.concatenate([MOVIE, MOVIE[:1]])


def test_a_movie_in_two_files_is_whole_or_told(tmp_path):
    write_two_files(tmp_path)
    np.testing.assert_array_equal(files.load(tmp_path / "a.ome.tif"), TWO)
    (tmp_path / "b.ome.tif").rename(tmp_path / "elsewhere")
    check_line(complaint(files.read_movie, tmp_path / "a.ome.tif"), "refers to b.ome.tif, which is not there: copy")
    (tmp_path / "b.ome.tif").write_bytes((tmp_path / "elsewhere").read_bytes()[:100])
    check_line(complaint(files.read_movie, tmp_path / "a.ome.tif"), "announces 8 frames, 4 can be read")


def test_a_recording_of_micro_manager_that_was_stopped_early_is_read_as_far_as_it_goes(tmp_path):
    first, second = tmp_path / "movie_MMStack.ome.tif", tmp_path / "movie_MMStack_1.ome.tif"
    write_micro_manager_stack(first, TWO, announced=8)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.testing.assert_array_equal(files.load(first), TWO)
    assert files.read_movie(first).pixel_size_nm == pytest.approx(107.5)
    write_micro_manager_stack(first, TWO[:5], announced=20)
    with pytest.warns(UserWarning, match="announces 20 frames, 5 are there, which are read"):
        np.testing.assert_array_equal(files.load(first), TWO[:5])
    write_micro_manager_stack(second, TWO[5:], announced=20, first=5)  # in the second of two files
    with pytest.warns(UserWarning, match="announces 20 frames, 8 are there, which are read"):
        movie = files.read_movie(first)
    assert movie.data.shape == TWO.shape
    np.testing.assert_array_equal(movie.data, TWO)
    write_micro_manager_stack(second, TWO[6:], announced=20, first=6)  # one in between is gone
    check_line(complaint(files.read_movie, first), "announces 20 frames, 7 can be read: copy all files")


def test_a_file_that_was_renamed_needs_no_other(tmp_path):
    files.write_movie(tmp_path / "m.ome.tif", [MOVIE], MOVIE.shape, np.uint16)
    with tifffile.TiffFile(tmp_path / "m.ome.tif") as file:
        own = re.search('UUID="([^"]*)"', file.ome_metadata)[1]
    told = f'<TiffData IFD="0" PlaneCount="7"><UUID FileName="before.ome.tif">{own}</UUID></TiffData>'
    xml = re.sub("<TiffData.*?</TiffData>|<TiffData[^>]*/>", told, file.ome_metadata, count=1)
    assert told in xml
    tifffile.imwrite(
        tmp_path / "after.ome.tif", MOVIE, description=xml.encode(), metadata=None, photometric="minisblack"
    )
    np.testing.assert_array_equal(files.load(tmp_path / "after.ome.tif"), MOVIE)


@pytest.mark.parametrize("code", [5, 7])
@pytest.mark.skipif(importlib.util.find_spec("imagecodecs") is not None, reason="they can be read here")
def test_a_packing_that_cannot_be_read_here_is_no_damage(tmp_path, code):
    tifffile.imwrite(tmp_path / "m.tif", MOVIE, compression="zlib", photometric="minisblack")
    with tifffile.TiffFile(tmp_path / "m.tif", mode="r+") as file:
        for page in file.pages:
            page.tags[259].overwrite(code)
    told = complaint(files.load, tmp_path / "m.tif")
    check_line(told, f"packed by {'LZW' if code == 5 else 'JPEG'}, which needs imagecodecs: pip install imagecodecs")
    assert "damaged" not in told


@pytest.mark.parametrize("name", ["m.ome.tif", "m.tif"])
@pytest.mark.parametrize(
    ("given", "kept"), [(np.int64, np.int32), (np.uint64, np.uint32), (np.float16, np.float32)]
)  # fmt: skip
def test_numbers_that_ome_has_no_type_for_are_kept_in_another(tmp_path, name, given, kept):
    from napari_mufasa.files import layers

    movie = (MOVIE // 64).astype(given)
    layers.write_image(str(tmp_path / name), movie, {"scale": (1, 1, 1)})
    back = files.load(tmp_path / name)
    assert back.dtype == kept
    np.testing.assert_array_equal(back, movie)


@pytest.mark.parametrize("value", [2**40, -(2**40)])
def test_whole_numbers_that_fit_none_are_told(tmp_path, value):
    movie = MOVIE.astype(np.int64)
    movie[5, 3, 3] = value
    told = complaint(files.write_movie, tmp_path / "m.ome.tif", blocks(movie), movie.shape, movie.dtype)
    check_line(told, f"{value} does not fit int32")
    assert list(tmp_path.iterdir()) == []
    files.write_movie(tmp_path / "m.zarr", blocks(movie), movie.shape, movie.dtype)
    np.testing.assert_array_equal(files.load(tmp_path / "m.zarr"), movie)


def test_wrong_shapes_are_told(tmp_path):
    tifffile.imwrite(tmp_path / "rgb.tif", RNG.integers(0, 255, (16, 18, 3), dtype=np.uint8), photometric="rgb")
    tifffile.imwrite(tmp_path / "rgbs.tif", RNG.integers(0, 255, (5, 16, 18, 3), dtype=np.uint8), photometric="rgb")
    tifffile.imwrite(tmp_path / "tc.ome.tif", np.stack([MOVIE] * 3, axis=1), metadata={"axes": "TCYX"})
    tifffile.imwrite(tmp_path / "yxt.tif", np.moveaxis(MOVIE, 0, -1), metadata={"axes": "YXT"})
    zarr.save_array(str(tmp_path / "line.zarr"), np.arange(5))
    zarr.save_array(str(tmp_path / "none.zarr"), np.zeros((0, 4, 4)))
    zarr.save_array(str(tmp_path / "complex.zarr"), np.ones((2, 4, 4), complex))
    for name in ("rgb.tif", "rgbs.tif"):
        assert "colour" in complaint(files.read_movie, tmp_path / name)
    for name in ("tc.ome.tif", "yxt.tif", "line.zarr", "none.zarr"):
        assert "(frame, y, x)" in complaint(files.read_movie, tmp_path / name)
    assert "real numbers" in complaint(files.read_movie, tmp_path / "complex.zarr")


@pytest.mark.parametrize("name", ["m.ome.tif", "m.zarr"])
@pytest.mark.parametrize("failure", [Cancelled, RuntimeError])
def test_nothing_is_half_written(tmp_path, name, failure):
    def stream():
        yield MOVIE[:3]
        raise failure("in the middle")

    def write(frames):
        files.write_movie(tmp_path / name, frames, MOVIE.shape, np.uint16)

    with pytest.raises(failure):
        write(stream())
    assert list(tmp_path.iterdir()) == []
    write([MOVIE])
    with pytest.raises(failure):  # and an older file stays whole
        write(stream())
    np.testing.assert_array_equal(files.load(tmp_path / name), MOVIE)
    assert [p.name for p in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("name", ["m.ome.tif", "m.zarr"])
@pytest.mark.parametrize("frames", [MOVIE[:5], np.concatenate([MOVIE, MOVIE]), MOVIE[:, :5]])
def test_other_frames_than_announced_are_refused(tmp_path, name, frames):
    complaint(lambda: files.write_movie(tmp_path / name, blocks(frames), MOVIE.shape, np.uint16))
    assert list(tmp_path.iterdir()) == []


def test_where_nothing_can_be_written(tmp_path):
    def write(path):
        files.write_movie(path, [MOVIE], MOVIE.shape, np.uint16)

    assert "no folder" in complaint(write, tmp_path / "nowhere" / "m.tif")
    assert ".ome.tif" in complaint(write, tmp_path / "m.avi")
    folder = tmp_path / "data.zarr"
    folder.mkdir()
    (folder / "precious.txt").write_text("keep")
    assert "is a folder" in complaint(write, folder)
    assert "is a folder" in complaint(files.write_text, folder, "text")
    assert (folder / "precious.txt").read_text() == "keep"


def test_a_zarr_movie_is_replaced_by_a_new_one(tmp_path):
    for value in (1, 2):
        files.write_movie(tmp_path / "m.zarr", [np.full_like(MOVIE, value)], MOVIE.shape, np.uint16)
    assert np.all(files.load(tmp_path / "m.zarr") == 2)


def test_json_has_no_nan(tmp_path):
    data = {"a": np.float64("nan"), "b": [np.int32(3), float("inf")], 5: np.array([1.5, 2.0]), "c": np.bool_(True)}
    files.write_json(tmp_path / "r.json", data)
    assert json.loads((tmp_path / "r.json").read_text()) == {"a": None, "b": [3, None], "5": [1.5, 2.0], "c": True}
    assert files.read_json(tmp_path / "r.json")["c"] is True
    with pytest.raises(MufasaError, match="no file"):
        files.read_json(tmp_path / "nowhere.json")


def test_json_that_cannot_be_written_leaves_the_old_file(tmp_path):
    files.write_json(tmp_path / "r.json", {"a": 1})
    with pytest.raises(TypeError):
        files.write_json(tmp_path / "r.json", {"a": object()})
    assert files.read_json(tmp_path / "r.json") == {"a": 1}


def test_tables_come_back(tmp_path):
    table = pd.DataFrame({"molecule": [0, 1], "y_px": [1.5, 2.25], "reason": ["", "touching a neighbour"]})
    files.write_table(tmp_path / "t.csv", table)
    pd.testing.assert_frame_equal(pd.read_csv(tmp_path / "t.csv", keep_default_na=False), table)


@pytest.mark.parametrize("name", ["p.ome.tif", "p.zarr"])
def test_photons_stay_photons_in_files_and_layers(tmp_path, name):
    from napari_mufasa.files import layers

    photons = MOVIE.astype(np.float32)
    files.write_movie(tmp_path / name, [photons], MOVIE.shape, np.float32, role=files.PHOTONS)
    assert files.read_movie(tmp_path / name).unit == "photons"
    with pytest.raises(MufasaError, match="holds photons, not camera counts"):
        files.load(tmp_path / name, recorded=True)
    ((data, options, _),) = layers.read_layers(str(tmp_path / name))
    layers.write_image(str(tmp_path / f"again.{name}"), data, options | {"scale": (1, 1, 1)})
    assert files.read_movie(tmp_path / f"again.{name}").metadata["role"] == "photons"
