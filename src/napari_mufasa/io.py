"""Files in and out: movies (TIFF, OME-TIFF, zarr) with their model, tables, text (SPEC.md §10).

Everything is written to a temporary name and renamed, so that a file either is whole or is not there.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import shutil
import uuid
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.errors import MufasaError

if TYPE_CHECKING:
    import pandas as pd

    from napari_mufasa.model import Model

PathLike = str | os.PathLike[str]
METADATA_KEY = "napari_mufasa"


@dataclass(frozen=True)
class Movie:
    """A movie on disk: `data` is a lazy dask array (frame, y, x); `model` and `seed` when we wrote it."""

    data: Any
    path: Path
    model: Model | None = None
    seed: int | None = None


@contextlib.contextmanager
def replacing(path: PathLike) -> Iterator[Path]:
    """A temporary path beside `path`, renamed to it at the end; removed when anything fails."""
    target = Path(path)
    if not target.parent.is_dir():
        raise MufasaError(f"no folder {target.parent}: make it first or choose another output path")
    if target.is_dir() and not _is_zarr_folder(target):
        raise MufasaError(f"{target} is a folder: choose a file name for the output")
    temporary = target.with_name(f".{os.getpid()}-{target.name}")
    try:
        yield temporary
        if target.is_dir():
            shutil.rmtree(target)
        os.replace(temporary, target)
    finally:
        if temporary.is_dir():
            shutil.rmtree(temporary)
        else:
            temporary.unlink(missing_ok=True)


def _is_zarr_folder(path: Path) -> bool:
    return any((path / name).is_file() for name in ("zarr.json", ".zarray", ".zgroup"))


def write_text(path: PathLike, text: str) -> None:
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: PathLike, data: Any) -> None:
    """JSON without NaN: a number that is not known is null."""
    write_text(path, json.dumps(_plain(data), indent=1, allow_nan=False) + "\n")


def write_table(path: PathLike, table: pd.DataFrame) -> None:
    with replacing(path) as temporary:
        table.to_csv(temporary, index=False)


def read_json(path: PathLike) -> Any:
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise MufasaError(f"{path} is not readable JSON ({error})") from None


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
    model, seed = _restore(metadata)
    return Movie(data, path, model, seed)


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
    model: Model | None = None,
    seed: int | None = None,
    pixel_size_nm: float | None = None,
) -> None:
    """Stream blocks of frames (frame, y, x) into OME-TIFF or zarr, by the suffix; memory is one block.

    The whole model and the seed travel in the metadata and come back with `read_movie`.
    """
    metadata = {"model": model.to_dict() if model else None, "seed": None if seed is None else int(seed)}
    if pixel_size_nm is None and model is not None:
        pixel_size_nm = model.acquisition.pixel_size_nm
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


def _restore(metadata: dict[str, Any]) -> tuple[Model | None, int | None]:
    from napari_mufasa.model import Model

    model, seed = metadata.get("model"), metadata.get("seed")
    if not model:
        return None, seed
    try:
        return Model.from_dict(model), seed
    except MufasaError as error:  # the movie is still good, perhaps an effect's package is not installed
        warnings.warn(f"the model stored with the movie cannot be restored ({error})", stacklevel=3)
        return None, seed


def _plain(value: Any) -> Any:
    """Numpy to plain Python; not-a-number and infinity to null."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [_plain(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
