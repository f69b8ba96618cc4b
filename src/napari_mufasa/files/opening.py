"""Opening what strangers wrote: nothing is unpickled, no other file is opened, damage is told in one line."""

from __future__ import annotations

import contextlib
import html
import json
import logging
import os
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa import checks
from napari_mufasa.errors import MufasaError

#: Filters and compressors of zarr arrays that only turn bytes into numbers.
CODECS = {
    "adler32", "astype", "bitround", "blosc", "bytes", "bz2", "crc32", "crc32c", "delta", "fixedscaleoffset",
    "fletcher32", "gzip", "jenkins_lookup3", "lz4", "lzma", "packbits", "quantize", "sharding_indexed", "shuffle",
    "transpose", "zlib", "zstd",
}  # fmt: skip
MOST_META_BYTES = 2**28
MOST_BLOCK_BYTES = 2**28
PADDING = 1024  # bytes behind a file's pages that mean nothing, as of a disk's last sector


class Guarded:
    """An array on disk whose reading fails in one line. Axes of length one before the last two are dropped."""

    def __init__(self, array: Any, path: Path) -> None:
        self._array, self._path = array, path
        self._kept = tuple(n > 1 or axis >= array.ndim - 2 for axis, n in enumerate(array.shape))
        if array.ndim <= 3:
            self._kept = (True,) * array.ndim
        self.shape = tuple(n for n, kept in zip(array.shape, self._kept, strict=True) if kept)
        self.chunks = tuple(n for n, kept in zip(array.chunks, self._kept, strict=True) if kept)
        self.dtype, self.ndim = array.dtype, len(self.shape)
        checks.affordable(
            int(np.prod([float(n) for n in array.chunks])) * array.dtype.itemsize, f"one chunk of {path}",
            "export it in smaller chunks",
        )  # fmt: skip

    def whole_frames(self) -> tuple[int, ...]:
        """Blocks to read: whole frames, as many as stored together; as stored where that would be much."""
        frames = (*self.chunks[:-2], *self.shape[-2:])
        return frames if float(np.prod(frames)) * self.dtype.itemsize <= MOST_BLOCK_BYTES else self.chunks

    def __getitem__(self, index: tuple[Any, ...]) -> NDArray[Any]:
        given = iter(index)
        whole = tuple(next(given) if kept else 0 for kept in self._kept)
        try:
            return np.asarray(self._array[whole])
        except Exception as error:
            raise MufasaError(f"{self._path} {_why_unread(error)}") from None


def _why_unread(error: Exception) -> str:
    """What an error while reading means, and what to do: a decoder that is not installed is no damage."""
    if "imagecodecs" in str(error) or isinstance(error, ImportError):
        packing = re.search(r"(?:COMPRESSION|PREDICTOR)\.(\w+)", str(error))
        how = f"by {packing[1]}" if packing else "in a way"
        return f"is packed {how}, which needs imagecodecs: pip install imagecodecs, or export it uncompressed"
    return f"is damaged ({error}): copy or export it anew"


def check_zarr(path: Path) -> None:
    """Raise for a zarr folder whose description asks for other codecs than `CODECS` (one of them unpickles), or with
    links that lead out of it."""
    if path.is_file():
        raise MufasaError(f"{path} is a file, not a zarr folder: unpack it first, or give a TIFF")
    found = [path / name for name in ("zarr.json", ".zarray") if (path / name).is_file()]
    if not found:
        raise MufasaError(f"{path} is a folder without a zarr array: give a TIFF, or the array's own folder")
    for file in found:
        if file.stat().st_size > MOST_META_BYTES:
            raise MufasaError(
                f"{file} is larger than {checks.size(MOST_META_BYTES)}: this is no description of a movie"
            )
        for codec in _codecs(json.loads(file.read_text(encoding="utf-8"))):
            if codec.removeprefix("numcodecs.") not in CODECS:
                raise MufasaError(f"{path} is packed by {codec!r}, which is not opened: export it with zstd or gzip")
    inside = path.resolve()
    for folder, names, files in os.walk(path):
        for name in (*names, *files):
            each = Path(folder, name)
            if each.is_symlink() and inside not in each.resolve().parents:
                raise MufasaError(f"{path} holds a link that leads out of it ({name}): copy it with its data")


def _codecs(description: Any) -> list[str]:
    """The names of all codecs of a zarr array, those inside others, too."""
    if isinstance(description, list):
        return [name for part in description for name in _codecs(part)]
    if not isinstance(description, dict):
        return []
    found = []
    for key in ("codecs", "index_codecs", "filters", "compressor"):
        parts = description.get(key) or []
        for part in parts if isinstance(parts, list) else [parts]:
            if isinstance(part, dict):
                found += [str(part.get("name") or part.get("id")), *_codecs(part.get("configuration"))]
            else:
                found.append(str(part))
    return found


def no_other_files(ome_xml: str, path: Path) -> None:
    """Raise for an OME description that sends its reader to files outside its folder."""
    for name in _file_names(ome_xml):
        if re.search(r"[/\\]|^\.\.", name):
            raise MufasaError(f"{path} refers to a file elsewhere ({name}): export the movie as one file")


@contextlib.contextmanager
def complaints() -> Iterator[list[str]]:
    """The errors that tifffile logs instead of raising; what else it logs is not for users."""
    found: list[str] = []

    def note(record: logging.LogRecord) -> None:
        if record.levelno >= logging.ERROR:
            found.append(record.getMessage())

    handler = logging.Handler()
    handler.emit = note  # type: ignore[method-assign]
    logger = logging.getLogger("tifffile")
    passes_on, logger.propagate = logger.propagate, False
    logger.addHandler(handler)
    try:
        yield found
    finally:
        logger.removeHandler(handler)
        logger.propagate = passes_on


def frames_there(file: Any, path: Path) -> int | None:
    """How many frames of a TIFF's first series can be read; None: all. A recording of Micro-Manager that was stopped
    early is read as far as it goes, with a warning. Raises for any other that announces frames which no file holds:
    they would be read as zeros."""
    series, ome_xml = file.series[0], file.ome_metadata or ""
    if series.kind not in ("ome", "mmstack"):  # all others are what is there
        return None
    there = [page is not None for page in series]
    n = sum(there)
    if series.kind == "mmstack" and n and all(there[:n]):
        announced = max(len(there), int(file.micromanager_metadata["Summary"].get("Frames", 0)))
        if announced > n:
            why = "the recording was stopped early, or a further file of it is missing"
            warnings.warn(f"{path} announces {announced} frames, {n} are there, which are read: {why}", stacklevel=4)
        return n if n < len(there) else None
    if all(there):
        return None
    for name in _file_names(ome_xml):
        if not (path.parent / name).exists():
            raise MufasaError(f"{path} refers to {name}, which is not there: copy it beside this file")
    raise MufasaError(
        f"{path} announces {len(there)} frames, {n} can be read: copy all files of the movie anew, or export "
        "it as one file"
    )


def check_whole(file: Any, path: Path) -> None:
    """Raise for a TIFF of which fewer frames are read than it announces or holds: its chain of pages is broken.

    A stack of ImageJ that another program has shortened is whole, though it announces what it was: it is read with a
    warning."""
    series = file.series[0]
    if file.is_micromanager or series.kind == "ome":  # `frames_there` knows
        return
    anew = "damaged; copy it anew or export it anew"
    page = file.pages.first
    there = int(np.prod(series.shape)) // max(int(np.prod(page.shape)), 1)
    by_imagej = _imagej_planes(file)
    announced = max(_shaped_planes(file), _ome_planes(file.ome_metadata or ""))
    if there < announced:
        raise MufasaError(f"{path} announces {announced} frames, its {len(file.pages)} pages hold fewer: {anew}")
    if series.kind not in ("generic", "uniform"):  # of all others the description says what the file holds
        return
    pages = [one for one in series if one is not None]
    odd = [i for i, one in enumerate(file.pages) if not one.shape] if series.kind == "generic" else []
    between = sorted(set(range(pages[0].index, pages[-1].index)) - {one.index for one in pages})
    if len(between) < there / 2:  # more of them are images of another kind, as of one to each frame
        odd += between
    if odd:
        raise MufasaError(f"{path}: page {odd[0] + 1} of {len(file.pages)} is no frame like the others: {anew}")
    behind = path.stat().st_size - _end_of_pages(file)
    if behind >= max(PADDING, *(sum(one.databytecounts) for one in pages)):
        raise MufasaError(f"{path} holds {checks.size(behind)} behind the {there} frames that can be read: {anew}")
    if there < by_imagej:
        warnings.warn(f"{path} announces {by_imagej} frames, {there} are there, which are read", stacklevel=4)


def _shaped_planes(file: Any) -> int:
    told: Any = file.shaped_metadata or ({},)
    return int(np.prod(told[0].get("shape", 0))) // max(int(np.prod(file.pages.first.shape)), 1)


def _ome_planes(ome_xml: str) -> int:
    pixels = re.search(r"<(?:\w+:)?Pixels\b[^>]*>", ome_xml)
    return int(np.prod([int(n) for n in re.findall(r"\bSize[TZC]=[\"'](\d+)", pixels[0])])) if pixels else 0


def _imagej_planes(file: Any) -> int:
    told = file.imagej_metadata or {}
    return int(np.prod([int(told.get(axis, 1)) for axis in ("frames", "slices", "channels")]))


def _end_of_pages(file: Any) -> int:
    """The byte behind the pages of a TIFF, their numbers and their descriptions."""
    n = len(file.pages)
    last = file.pages.get(n - 1, aspage=True)
    ends = [file.pages.next_page_offset + file.tiff.offsetsize]
    ends += [tag.valueoffset + tag.valuebytecount for page in (file.pages.first, last) for tag in page.tags]
    for page in (page for series in file.series for page in series if page is not None):
        ends += [start + length for start, length in zip(page.dataoffsets, page.databytecounts, strict=True)]
    return int(max(ends))


def _file_names(ome_xml: str) -> list[str]:
    return [html.unescape(name) for name in re.findall(r"FileName\s*=\s*[\"']([^\"']*)[\"']", ome_xml)]
