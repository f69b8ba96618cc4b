"""Movies on disk: TIFF, OME-TIFF and zarr, streamed in and out, with what we know of them in their metadata."""

from __future__ import annotations

import contextlib
import json
import logging
import uuid
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.errors import MufasaError
from napari_mufasa.files.whole import PathLike, replacing

METADATA_KEY = "napari_mufasa"


@dataclass(frozen=True)
class Movie:
    """A movie on disk: `data` is a lazy dask array (frame, y, x); `metadata` what we wrote beside it, if we did:
    "model" as plain data (see `Model.stored_in`) and "seed"."""

    data: Any
    path: Path
    metadata: dict[str, Any] = field(default_factory=dict)

    @property
    def seed(self) -> int | None:
        return self.metadata.get("seed")

    @property
    def pixel_size_nm(self) -> float | None:
        """The pixel size of the model that travelled with the movie, if one did."""
        return _pixel_size_nm(self.metadata.get("model"))


def _pixel_size_nm(model: Mapping[str, Any] | None) -> float | None:
    with contextlib.suppress(TypeError, KeyError, ValueError):  # someone else's metadata
        return float((model or {})["acquisition"]["pixel_size_nm"])
    return None


class Describes(Protocol):
    """What describes a movie in plain data: a `Model`."""

    def to_dict(self) -> dict[str, Any]: ...


def is_zarr(path: PathLike) -> bool:
    return Path(path).suffix == ".zarr"


def read_movie(path: PathLike) -> Movie:
    """A movie from TIFF, OME-TIFF or zarr, lazily; a single 2-D image becomes one frame.

    Raises `MufasaError` when the file is missing, truncated, empty, not numeric or not (frame, y, x).
    """
    path = Path(path)
    if not path.exists():
        raise MufasaError(f"no file {path}: give a TIFF, OME-TIFF or zarr movie")
    try:
        data, metadata = _open_zarr(path) if is_zarr(path) or path.is_dir() else _open_tiff(path)
    except MufasaError:
        raise
    except Exception as error:
        raise MufasaError(f"{path} is not a readable TIFF or zarr movie ({error}): export it anew") from None
    if data.ndim == 2:
        data = data[None]
    if data.ndim != 3 or 0 in data.shape:
        raise MufasaError(f"{path} has shape {data.shape}: needs one non-empty stack (frame, y, x)")
    if data.dtype.kind not in "uif":
        raise MufasaError(f"{path} holds {data.dtype}: needs real numbers")
    return Movie(data, path, metadata)


def load(path: PathLike) -> NDArray[Any]:
    """A whole movie in memory, (frame, y, x)."""
    movie = read_movie(path)
    try:
        return np.asarray(movie.data)
    except Exception as error:
        raise MufasaError(f"{path} is damaged ({error}): copy or export it anew") from None


def write_movie(
    path: PathLike,
    frames: Iterable[NDArray[Any]],
    shape: tuple[int, int, int],
    dtype: Any,
    *,
    model: Describes | Mapping[str, Any] | None = None,
    seed: int | None = None,
    pixel_size_nm: float | None = None,
) -> None:
    """Stream blocks of frames (frame, y, x) into OME-TIFF or zarr, by the suffix; memory is one block.

    The whole model and the seed travel in the metadata and come back with `read_movie`.
    """
    described = model if isinstance(model, Mapping) or model is None else model.to_dict()
    metadata: dict[str, Any] = {"model": described, "seed": None if seed is None else int(seed)}
    if pixel_size_nm is None:
        pixel_size_nm = _pixel_size_nm(described)
    if not (is_zarr(path) or str(path).lower().endswith((".tif", ".tiff"))):
        raise MufasaError(f"cannot write a movie to {path}: use .ome.tif, .tif or .zarr")
    with replacing(path) as temporary:
        blocks = _counted(frames, shape)
        if is_zarr(path):
            _write_zarr(temporary, blocks, shape, dtype, metadata)
        else:
            _write_tiff(temporary, blocks, shape, dtype, metadata, pixel_size_nm)


def _counted(blocks: Iterable[NDArray[Any]], shape: tuple[int, int, int]) -> Iterator[NDArray[Any]]:
    """The blocks as they come; raises when they are not the frames that were announced."""
    n = 0
    for block in blocks:
        n += len(block)
        if block.ndim != 3 or tuple(block.shape[1:]) != tuple(shape[1:]) or n > shape[0]:
            raise MufasaError(f"a block of shape {block.shape} (frames up to {n}) does not fit a movie of {shape}")
        yield block
    if n != shape[0]:
        raise MufasaError(f"{n} frames came for a movie of {shape[0]}: nothing was written")


def _write_zarr(
    path: Path, blocks: Iterable[NDArray[Any]], shape: tuple[int, int, int], dtype: Any, metadata: dict[str, Any]
) -> None:
    import zarr

    per_chunk = max(1, min(shape[0], 2**22 // (shape[1] * shape[2] * np.dtype(dtype).itemsize) or 1))
    array = zarr.create_array(store=str(path), shape=shape, chunks=(per_chunk, *shape[1:]), dtype=dtype)
    array.attrs[METADATA_KEY] = metadata
    start = 0
    for block in blocks:
        array[start : start + len(block)] = block
        start += len(block)


def _write_tiff(
    path: Path, blocks: Iterable[NDArray[Any]], shape: tuple[int, int, int], dtype: Any,
    metadata: dict[str, Any], pixel_size_nm: float | None,
) -> None:  # fmt: skip
    import tifffile

    described: dict[str, Any] = {"axes": "TYX", "Description": json.dumps({METADATA_KEY: metadata})}
    if metadata["model"] is not None and metadata["seed"] is not None:
        # OME wants an identifier: a simulated movie is what its model and seed are, to the last byte.
        identity = json.dumps([metadata, list(shape), str(np.dtype(dtype))], sort_keys=True)
        described["UUID"] = f"urn:uuid:{uuid.uuid5(uuid.NAMESPACE_OID, identity)}"
    if pixel_size_nm is not None:
        size_um = pixel_size_nm / 1000
        described |= {"PhysicalSizeX": size_um, "PhysicalSizeXUnit": "µm"}
        described |= {"PhysicalSizeY": size_um, "PhysicalSizeYUnit": "µm"}
    large = int(np.prod(shape)) * np.dtype(dtype).itemsize > 2**31
    with tifffile.TiffWriter(path, ome=True, bigtiff=large) as writer:
        pages = (frame for block in blocks for frame in np.asarray(block, dtype=dtype))
        writer.write(pages, shape=shape, dtype=dtype, photometric="minisblack", metadata=described)


def _open_zarr(path: Path) -> tuple[Any, dict[str, Any]]:
    import dask.array as da
    import zarr

    array = zarr.open_array(str(path), mode="r")
    metadata: Any = dict(array.attrs).get(METADATA_KEY)
    return da.from_zarr(array), metadata or {}  # type: ignore[no-untyped-call]


def _open_tiff(path: Path) -> tuple[Any, dict[str, Any]]:
    import dask.array as da
    import tifffile
    import zarr

    with _complaints("tifffile") as complaints, tifffile.TiffFile(path) as file:
        n_pages = len(file.pages)
        if complaints:
            raise MufasaError(f"{path} is truncated or damaged ({complaints[0]}): copy or export it anew")
        if not file.series:
            raise MufasaError(f"{path} holds no image")
        series = file.series[0]
        metadata = _tiff_metadata(file)
        shape, dtype = series.shape, series.dtype
        if "S" in series.axes:
            raise MufasaError(f"{path} is a colour image {shape}: needs one grey stack (frame, y, x)")
        last = file.pages[n_pages - 1]
        if last.dataoffsets and last.dataoffsets[-1] + last.databytecounts[-1] > path.stat().st_size:
            raise MufasaError(f"{path} is truncated: copy it anew")
    if len(shape) > 3:  # drop axes of length one (channel, z)
        shape = tuple(n for n in shape if n > 1)
    store = tifffile.imread(path, aszarr=True)
    array = zarr.open(store, mode="r")
    if isinstance(array, zarr.Group):
        array = array["0"]
    data = da.from_zarr(array)  # type: ignore[no-untyped-call]
    return (data if data.shape == shape else data.reshape(shape)).astype(dtype), metadata


@contextlib.contextmanager
def _complaints(logger_name: str) -> Iterator[list[str]]:
    """Messages that a library logs instead of raising."""
    found: list[str] = []
    handler = logging.Handler(logging.ERROR)
    handler.emit = lambda record: found.append(record.getMessage())  # type: ignore[method-assign]
    logger = logging.getLogger(logger_name)
    passes_on, logger.propagate = logger.propagate, False
    logger.addHandler(handler)
    try:
        yield found
    finally:
        logger.removeHandler(handler)
        logger.propagate = passes_on


def _tiff_metadata(file: Any) -> dict[str, Any]:
    """What `_write_tiff` left in the OME description."""
    import xml.etree.ElementTree as ElementTree

    if not file.is_ome:
        return {}
    with contextlib.suppress(ElementTree.ParseError, ValueError, TypeError):
        for element in ElementTree.fromstring(file.ome_metadata).iter():
            if element.tag.endswith("}Description") and element.text and METADATA_KEY in element.text:
                found = json.loads(element.text)[METADATA_KEY]
                return found if isinstance(found, dict) else {}
    return {}
