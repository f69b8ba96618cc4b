"""Files that are not what they say: each function makes one in a folder and gives its path."""

from __future__ import annotations

import json
import os
import pickle
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
import zarr

from napari_mufasa import files

SHAPE = (30, 32, 32)


def counts(seed: int = 0) -> np.ndarray[Any, Any]:
    """A movie of noise around a baseline of 200 ADU."""
    return np.random.default_rng(seed).normal(210, 8, SHAPE).round().astype(np.uint16)


def tiff(folder: Path, data: np.ndarray[Any, Any], name: str = "m.tif", **options: Any) -> Path:
    tifffile.imwrite(folder / name, data, photometric=options.pop("photometric", "minisblack"), **options)
    return folder / name


def raw(name: str, content: bytes) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / name).write_bytes(content)
        return folder / name

    return make


def whole_tiff() -> bytes:
    import io

    buffer = io.BytesIO()
    tifffile.imwrite(buffer, counts(), photometric="minisblack", ome=True)
    return buffer.getvalue()


def cut(share: float) -> Callable[[Path], Path]:
    return lambda folder: raw("m.tif", whole_tiff()[: int(share * len(whole_tiff()))])(folder)


def with_tag(code: int, value: int) -> Callable[[Path], Path]:
    """A good TIFF whose first page says something else in one of its tags."""

    def make(folder: Path) -> Path:
        path = tiff(folder, counts())
        with tifffile.TiffFile(path, mode="r+") as file:
            file.pages[0].tags[code].overwrite(value)
        return path

    return make


def damaged_page(folder: Path) -> Path:
    """Compressed, and one page in the middle holds something else: seen only when it is read."""
    path = tiff(folder, counts(), compression="zlib")
    with tifffile.TiffFile(path) as file:
        at, n = file.pages[15].dataoffsets[0], file.pages[15].databytecounts[0]
    with path.open("r+b") as opened:
        opened.seek(at)
        opened.write(bytes(n))
    return path


def ome_elsewhere(folder: Path) -> Path:
    """An OME description that sends its reader to a file outside the folder."""
    xml = (
        '<?xml version="1.0"?><OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06"><Image ID="Image:0">'
        '<Pixels ID="Pixels:0" DimensionOrder="XYZCT" Type="uint16" SizeX="32" SizeY="32" SizeZ="1" SizeC="1" '
        'SizeT="1"><TiffData FirstT="0"><UUID FileName="../../secret.tif">urn:uuid:1</UUID></TiffData></Pixels>'
        "</Image></OME>"
    )
    return tiff(folder, counts()[0], "m.ome.tif", description=xml, metadata=None)


def entity_bomb(folder: Path) -> Path:
    entities = "".join(f'<!ENTITY e{i} "{f"&e{i - 1};" * 10}">' for i in range(1, 12))
    xml = f'<?xml version="1.0"?><!DOCTYPE OME [<!ENTITY e0 "bomb">{entities}]>'
    xml += '<OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06">&e11;</OME>'
    path = tiff(folder, counts()[:1], "m.ome.tif", description=xml, metadata=None)
    path.write_bytes(path.read_bytes()[:-40])  # and cut, so that it must be told
    return path


def zarr_of(data: np.ndarray[Any, Any]) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        zarr.save_array(str(folder / "m.zarr"), data)
        return folder / "m.zarr"

    return make


def ours(folder: Path) -> Path:
    files.write_movie(folder / "m.zarr", [counts()], SHAPE, np.uint16)
    return folder / "m.zarr"


def lost_chunk(folder: Path) -> Path:
    path = ours(folder)
    next(path.glob("c/0/0/0")).unlink()
    return path


def damaged_chunk(folder: Path) -> Path:
    path = ours(folder)
    chunk = path / "c/0/0/0"
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 1
    chunk.write_bytes(content)
    return path


def link_out(folder: Path) -> Path:
    path = ours(folder)
    (path / "c/0/0/0").unlink()
    os.symlink("/etc/hostname", path / "c/0/0/0")
    return path


def described(content: Any, version: int = 3, chunk: bytes = b"") -> Callable[[Path], Path]:
    """A zarr folder with this description."""

    def make(folder: Path) -> Path:
        path = folder / "m.zarr"
        path.mkdir()
        text = content if isinstance(content, str) else json.dumps(content)
        (path / ("zarr.json" if version == 3 else ".zarray")).write_text(text)
        name = "c/0/0/0" if version == 3 else "0.0.0"
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(chunk)
        return path

    return make


def no_chunk(folder: Path) -> Path:
    path = described(version_three())(folder)
    (path / "c/0/0/0").unlink()
    return path


class Boom:
    """What runs when it is unpickled."""

    def __reduce__(self) -> Any:
        return os.mkdir, ("UNPICKLED",)


def version_two(**changes: Any) -> dict[str, Any]:
    plain = {
        "zarr_format": 2, "shape": [2, 4, 4], "chunks": [2, 4, 4], "dtype": "<u2", "compressor": None,
        "fill_value": 0, "order": "C", "filters": None,
    }  # fmt: skip
    return plain | changes


def version_three(**changes: Any) -> dict[str, Any]:
    plain = {
        "zarr_format": 3, "node_type": "array", "shape": [2, 4, 4], "data_type": "uint16",
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [2, 4, 4]}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}}, "fill_value": 0,
        "codecs": [{"name": "bytes", "configuration": {"endian": "little"}}], "attributes": {},
    }  # fmt: skip
    return plain | changes


PICKLE = pickle.dumps(Boom())


def object_array(folder: Path) -> Path:
    np.save(folder / "m.npy", np.array([Boom()], dtype=object), allow_pickle=True)
    return folder / "m.npy"


def object_archive(folder: Path) -> Path:
    np.savez(folder / "m.npz", a=np.array([Boom()], dtype=object))
    return folder / "m.npz"


def empty_folder(folder: Path) -> Path:
    (folder / "m.zarr").mkdir()
    return folder / "m.zarr"


def pipe(folder: Path) -> Path:
    os.mkfifo(folder / "m.tif")
    return folder / "m.tif"


PNG = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sIIBBBBB", 13, b"IHDR", 32, 32, 8, 0, 0, 0, 0) + bytes(40)
BIG = counts()

#: name → (how to make it, a word of what is told)
MOVIES: dict[str, tuple[Callable[[Path], Path], str]] = {
    "missing": (lambda folder: folder / "missing.tif", "no file"),
    "empty file": (raw("m.tif", b""), "not a readable"),
    "text as tif": (raw("m.tif", b"no picture"), "not a readable"),
    "png as tif": (raw("m.tif", PNG), "not a readable"),
    "header only": (raw("m.tif", b"II*\0\x08\0\0\0\0\0\0\0\0\0"), "m.tif"),
    "a folder": (lambda folder: folder, "without a zarr array"),
    "a pipe": (pipe, "neither file nor folder"),
    "name with a newline": (lambda folder: folder / "a\nb.tif", "no file"),
    "name with an escape": (lambda folder: folder / "a\x1b[31mb.tif", "no file"),
    "cut at 1 %": (cut(0.01), "m.tif"),
    "cut at a half": (cut(0.5), "m.tif"),
    "cut at 99 %": (cut(0.99), "m.tif"),
    "damaged page": (damaged_page, "damaged"),
    "absurd width": (with_tag(256, 2**31), "m.tif"),
    "absurd height": (with_tag(257, 2**30), "m.tif"),
    "unknown compression": (with_tag(259, 61000), "m.tif"),
    "colour": (lambda f: tiff(f, np.zeros((5, 32, 32, 3), np.uint8), photometric="rgb"), "colour"),
    "one colour image": (lambda f: tiff(f, np.zeros((32, 32, 3), np.uint8), photometric="rgb"), "colour"),
    "channels": (lambda f: tiff(f, np.stack([BIG, BIG], 1), ome=True, metadata={"axes": "TCYX"}), "2 channels"),
    "five axes": (
        lambda f: tiff(f, np.stack([np.stack([BIG, BIG], 1)] * 2, 1), ome=True, metadata={"axes": "TCZYX"}),
        "2 channels, 2 planes",
    ),
    "complex": (lambda f: tiff(f, BIG.astype(np.complex64)), "complex"),
    "nan": (lambda f: tiff(f, np.where(BIG > 230, np.nan, BIG).astype(np.float32)), "finite"),
    "infinite": (lambda f: tiff(f, np.where(BIG > 230, np.inf, BIG).astype(np.float32)), "finite"),
    "negative": (lambda f: tiff(f, BIG.astype(np.int32) - 1000), "raw counts"),
    "other files": (ome_elsewhere, "refers to a file elsewhere"),
    "entity bomb": (entity_bomb, "m.ome.tif"),
    "object array": (object_array, "not a readable"),
    "object archive": (object_archive, "not a readable"),
    "zarr file": (raw("m.zarr", b"PK\x03\x04" + bytes(60)), "not a zarr folder"),
    "zarr of nothing": (empty_folder, "without a zarr array"),
    "zarr, broken JSON": (described("{"), "not a readable"),
    "zarr, JSON of a list": (described([1, 2]), "not a readable"),
    "zarr, nested JSON": (described("[" * 100_000), "nested too deep"),
    "zarr of objects": (described(version_two(dtype="|O", filters=[{"id": "pickle"}]), 2, PICKLE), "pickle"),
    "zarr by pickle": (described(version_two(compressor={"id": "pickle"}), 2, PICKLE), "pickle"),
    "zarr 3 by pickle": (
        described(version_three(codecs=[{"name": "numcodecs.pickle", "configuration": {}}]), 3, PICKLE), "pickle",
    ),
    "zarr, absurd chunk": (
        described(version_three(
            shape=[10**6, 10**6, 10**6],
            chunk_grid={"name": "regular", "configuration": {"chunk_shape": [10**6, 10**6, 10**6]}},
        ), 3, b"\0"), "of memory",
    ),
    "zarr, cut chunk": (described(version_three(), 3, b"\1\2"), "damaged"),
    "zarr, no chunk": (no_chunk, "missing"),
    "zarr, lost chunk": (lost_chunk, "missing"),
    "zarr, flipped bit": (damaged_chunk, "damaged"),
    "zarr, link out": (link_out, "leads out of it"),
    "zarr, a line": (zarr_of(np.arange(5)), "(frame, y, x)"),
    "zarr, four axes": (zarr_of(np.stack([BIG, BIG], 1)), "4 axes"),
    "zarr, yes and no": (zarr_of(BIG > 210), "bool"),
}  # fmt: skip

#: movies that are read, but show nothing or too much: name → (how to make it, a word of what is told)
DARK_MOVIES: dict[str, tuple[Callable[[Path], Path], str]] = {
    "constant": (lambda f: tiff(f, np.full(SHAPE, 300, np.uint16)), "nothing was recorded"),
    "saturated": (lambda f: tiff(f, np.full(SHAPE, 65535, np.uint16)), "saturated"),
    "still": (lambda f: tiff(f, np.repeat(BIG[:1], 30, 0)), "all frames of the movie are equal"),
    "flickering": (
        lambda f: tiff(f, np.broadcast_to(np.arange(200, 230, dtype=np.uint16)[:, None, None], SHAPE).copy()),
        "all pixels of a frame are equal",
    ),
}

MODELS: dict[str, tuple[Callable[[Path], Path], str]] = {
    "missing": (lambda folder: folder / "missing.json", "no file"),
    "a folder": (lambda folder: folder, "no file"),
    "empty": (raw("model.json", b""), "not readable JSON"),
    "broken": (raw("model.json", b'{"protocol": '), "not readable JSON"),
    "a list": (raw("model.json", b"[1, 2]"), "holds a list"),
    "null": (raw("model.json", b"null"), "not a model"),
    "binary": (raw("model.json", bytes(range(128, 256))), "not readable JSON"),
    "nested": (raw("model.json", b"[" * 200_000), "nested too deep"),
    "huge integer": (raw("model.json", b'{"protocol": ' + b"9" * 5000 + b"}"), "not readable JSON"),
    "a TIFF": (lambda folder: tiff(folder, BIG, "model.json"), "not readable JSON"),
}

TRACES: dict[str, tuple[Callable[[Path], Path], str]] = {
    "missing": (lambda folder: folder / "t.csv", "no file"),
    "unknown suffix": (raw("t.doc", b""), "use one of"),
    "a folder": (lambda folder: folder, "no file"),
    "empty": (raw("t.csv", b""), "readable"),
    "no columns": (raw("t.csv", b"a,b\n1,2\n"), "columns"),
    "no row": (raw("t.csv", b"molecule,frame,photons\n"), "no trace"),
    "unequal": (raw("t.csv", b"molecule,frame,photons\n0,0,1\n0,1,2\n1,0,3\n"), "same number"),
    "words": (raw("t.csv", b"molecule,frame,photons\n0,0,bright\n"), "readable"),
    "nan": (raw("t.csv", b"molecule,frame,photons\n0,0,nan\n"), "finite"),
    "binary csv": (raw("t.csv", bytes(range(256))), "readable"),
    "no HDF5": (raw("t.h5", b"no hdf5"), "readable"),
    "object HDF5": (lambda f: _hdf5(f, np.array([[b"a", b"b"]])), "readable"),
    "short .traces": (raw("t.traces", b"abc"), "too short"),
    "absurd .traces": (raw("t.traces", struct.pack("<ih", 2**31 - 1, 32766)), "damaged"),
    "movie as traces": (lambda f: tiff(f, BIG, "t.tif"), "is it a movie"),
}  # fmt: skip


def _hdf5(folder: Path, data: Any) -> Path:
    import h5py

    with h5py.File(folder / "t.h5", "w") as file:
        file["traces"] = data
    return folder / "t.h5"
