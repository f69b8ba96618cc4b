"""Movies on disk: TIFF, OME-TIFF and zarr, streamed in and out, with what we know of them in their metadata."""

from __future__ import annotations

import contextlib
import json
import uuid
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from napari_mufasa import checks
from napari_mufasa.errors import MufasaError
from napari_mufasa.files import formats, growing
from napari_mufasa.files.instrument import Instrument, read_instrument
from napari_mufasa.files.opening import Guarded, check_whole, check_zarr, complaints, frames_there, no_other_files
from napari_mufasa.files.whole import PathLike, replacing
from napari_mufasa.provenance import Describes, made_by

METADATA_KEY = "napari_mufasa"
PHOTONS = "photons"  # the role of a movie that was denoised
IN_OME = {"int64": np.int32, "uint64": np.uint32, "float16": np.float32}  # what OME has in place of what it has not
MOST_PACKED = 100_000  # no image is packed to less than this part of it, each page of a TIFF having its own head


@dataclass(frozen=True)
class Movie:
    """A movie on disk: `data` is a lazy dask array (frame, y, x); `metadata` what we wrote beside it, if we did:
    "model" as plain data (see `Model.stored_in`), "seed", and "role" and "unit" of what no camera recorded."""

    data: Any
    path: Path
    metadata: dict[str, Any] = field(default_factory=dict)

    @property
    def seed(self) -> int | None:
        return self.metadata.get("seed")

    @property
    def unit(self) -> Literal["adu", "photons"]:
        """What its numbers are: "photons" of a movie that was denoised, counts of a camera else."""
        return "photons" if self.metadata.get("role") == PHOTONS else "adu"

    def recorded(self) -> Movie:
        """Itself; raises `MufasaError` when it is not what a camera recorded."""
        if self.unit != "adu":
            raise MufasaError(f"{self.path} holds photons, not camera counts: give the movie that it was denoised from")
        return self

    @cached_property
    def instrument(self) -> Instrument:
        """What the recording software wrote."""
        return read_instrument(self.path)

    @property
    def pixel_size_nm(self) -> float | None:
        """The pixel size of the model that travelled with the movie, or what the recording software wrote."""
        own = _pixel_size_nm(self.metadata.get("model"))
        return self.instrument.pixel_size_nm if own is None else own


def _pixel_size_nm(model: Mapping[str, Any] | None) -> float | None:
    with contextlib.suppress(TypeError, KeyError, ValueError):  # someone else's metadata
        return float((model or {})["acquisition"]["pixel_size_nm"])
    return None


def is_zarr(path: PathLike) -> bool:
    return Path(path).suffix == ".zarr"


def read_movie(path: PathLike) -> Movie:
    """A movie from TIFF, OME-TIFF, zarr or one of `formats.FORMATS`, lazily; a single 2-D image becomes one frame.

    Raises `MufasaError` when the file is missing, truncated, empty, not numeric or not (frame, y, x), and for anything
    in it that would open other files or run code. Blocks that turn out to be damaged raise it when they are read.
    """
    path = Path(path)
    if not path.exists():
        raise MufasaError(f"no file {path}: give a TIFF, OME-TIFF or zarr movie")
    if not (path.is_file() or path.is_dir()):
        raise MufasaError(f"{path} is neither file nor folder: give a TIFF, OME-TIFF or zarr movie")
    try:
        frames, metadata = _opened(path)
    except MufasaError:
        raise
    except RecursionError:
        raise MufasaError(f"{path} is not a readable movie (nested too deep): export it anew") from None
    except Exception as error:
        raise MufasaError(f"{path} is not a readable movie ({error}): export it anew") from None
    data = checks.stack(frames, str(path), single=True)
    return Movie(data, path, metadata)


def _opened(path: Path) -> tuple[Any, dict[str, Any]]:
    if is_zarr(path) or path.is_dir():
        return _open_zarr(path)
    if formats.is_format(path):
        return _lazy(formats.opened(path).frames, path), {}
    return _open_tiff(path)


def load(path: PathLike, *, recorded: bool = False) -> NDArray[Any]:
    """A whole movie in memory, (frame, y, x); `recorded`: raises `MufasaError` for one that holds photons."""
    movie = read_movie(path).recorded() if recorded else read_movie(path)
    checks.affordable(movie.data.nbytes, f"{path} as a whole", "crop it, or give fewer frames")
    return np.asarray(movie.data)


def write_movie(
    path: PathLike,
    frames: Iterable[NDArray[Any]] | growing.Blocks,
    shape: tuple[int, int, int],
    dtype: Any,
    *,
    model: Describes | Mapping[str, Any] | None = None,
    seed: int | None = None,
    pixel_size_nm: float | None = None,
    role: str | None = None,
    resume: Mapping[str, Any] | None = None,
) -> None:
    """Stream blocks of frames (frame, y, x) into OME-TIFF or zarr, by the suffix; memory is one block.

    The whole model, the seed, the program's version and the command travel in the metadata and come back with
    `read_movie`.

    Parameters
    ----------
    frames : the blocks in order; or, as it must be to resume, a function that gives (first frame, block) in order from
        a frame on
    role : what the movie is, where no camera recorded it: `PHOTONS` of a denoised one, per pixel and frame
    resume : what the movie is made from, as plain data: blocks that are finished are kept when the work ends early, for
        as long as what it is made from is the same. None: nothing is kept
    """
    path = Path(path)
    described = model if isinstance(model, Mapping) or model is None else model.to_dict()
    metadata: dict[str, Any] = {"model": described, "seed": None if seed is None else int(seed), **made_by()}
    if role is not None:
        metadata["role"] = role
    if role == PHOTONS:
        metadata["unit"] = "photons per pixel and frame"
    if pixel_size_nm is None:
        pixel_size_nm = _pixel_size_nm(described)
    if not (is_zarr(path) or str(path).lower().endswith((".tif", ".tiff"))):
        raise MufasaError(f"cannot write a movie to {path}: use .ome.tif, .tif or .zarr")
    if resume is not None and callable(frames):
        movie = growing.Growing(path, shape, dtype, resume)
        movie.fill(frames)
        if is_zarr(path):
            movie.array.attrs[METADATA_KEY] = metadata
            movie.become(path)
        else:
            with replacing(path) as temporary:
                _write_tiff(temporary, movie.frames(), shape, dtype, metadata, pixel_size_nm)
        movie.remove()
        return
    growing.forget(path)  # a run that starts anew
    stream = (block for _, block in frames(0)) if callable(frames) else frames
    with replacing(path) as temporary:
        blocks = growing.counted(stream, shape)
        if is_zarr(path):
            _write_zarr(temporary, blocks, shape, dtype, metadata)
        else:
            _write_tiff(temporary, blocks, shape, dtype, metadata, pixel_size_nm)


def _write_zarr(
    path: Path, blocks: Iterable[NDArray[Any]], shape: tuple[int, int, int], dtype: Any, metadata: dict[str, Any]
) -> None:
    array = growing.create(path, shape, dtype)
    start = 0
    for block in blocks:
        array[start : start + len(block)] = block
        start += len(block)
    array.attrs[METADATA_KEY] = metadata


def _write_tiff(
    path: Path, blocks: Iterable[NDArray[Any]], shape: tuple[int, int, int], dtype: Any,
    metadata: dict[str, Any], pixel_size_nm: float | None,
) -> None:  # fmt: skip
    import tifffile

    dtype = np.dtype(IN_OME.get(np.dtype(dtype).name, dtype))
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
        pages = (frame for block in blocks for frame in _stored_as(dtype, np.asarray(block)))
        writer.write(pages, shape=shape, dtype=dtype, photometric="minisblack", metadata=described)


def _stored_as(dtype: np.dtype[Any], block: NDArray[Any]) -> NDArray[Any]:
    """The same numbers as another type; raises where whole numbers do not fit it."""
    if block.size and np.dtype(dtype).kind in "iu" and block.dtype.kind in "iu":
        lowest, highest, room = int(block.min()), int(block.max()), np.iinfo(dtype)
        if lowest < room.min or highest > room.max:
            value = lowest if lowest < room.min else highest
            raise MufasaError(f"{value} does not fit {dtype}, as TIFF would store it: save as .zarr, or use float32")
    return np.asarray(block, dtype=dtype)


def _lazy(array: Any, path: Path) -> Any:
    """A dask array that is read block by block; what is damaged says so."""
    import dask.array as da

    guarded = Guarded(array, path)
    return da.from_array(guarded, chunks=guarded.whole_frames(), asarray=False, meta=np.empty(0, array.dtype))  # type: ignore[no-untyped-call]


def _open_zarr(path: Path) -> tuple[Any, dict[str, Any]]:
    import zarr

    check_zarr(path)
    array = zarr.open_array(str(path), mode="r")
    metadata: Any = dict(array.attrs).get(METADATA_KEY)
    metadata = metadata if isinstance(metadata, dict) else {}
    there, whole = array.nchunks_initialized, array.nchunks
    if whole and (there == 0 or ("version" in metadata and there < whole)):
        raise MufasaError(f"{path} is damaged ({whole - there} of {whole} chunks are missing): copy or export it anew")
    return _lazy(array, path), metadata


def _open_tiff(path: Path) -> tuple[Any, dict[str, Any]]:
    import tifffile
    import zarr

    with complaints() as told, tifffile.TiffFile(path) as file:
        n_pages = len(file.pages)
        if told:
            raise MufasaError(f"{path} is truncated or damaged ({told[0]}): copy or export it anew")
        if file.is_ome:
            no_other_files(file.ome_metadata or "", path)
        if not file.series:
            raise MufasaError(f"{path} holds no image: export it anew")
        series = file.series[0]
        if len(file.series) > 1:
            others = f"{len(file.series)} series of images"
            warnings.warn(f"{path} holds {others}: the first, {series.axes} {series.shape}, is read", stacklevel=3)
        metadata = _tiff_metadata(file)
        _check_axes(series, path)
        if series.nbytes > MOST_PACKED * path.stat().st_size:
            size, claimed = checks.size(path.stat().st_size), checks.size(series.nbytes)
            raise MufasaError(f"{path} claims {claimed} of pixels in {size} of file: damaged; copy or export it anew")
        frames = frames_there(file, path)
        check_whole(file, path)
        last = file.pages[n_pages - 1]
        if last.dataoffsets and last.dataoffsets[-1] + last.databytecounts[-1] > path.stat().st_size:
            raise MufasaError(f"{path} is truncated: copy it anew")
    with complaints():
        array = zarr.open(tifffile.imread(path, aszarr=True), mode="r")
    if isinstance(array, zarr.Group):
        array = array["0"]
    return _lazy(array, path)[:frames], metadata


def _check_axes(series: Any, path: Path) -> None:
    """Raise for colours, channels, planes: a movie has frames, rows and columns alone."""
    named = [(axis, n) for axis, n in zip(series.axes, series.shape, strict=True) if n > 1 or axis in "YX"]
    if any(axis == "S" for axis, _ in named):
        raise MufasaError(f"{path} is a colour image {series.shape}: needs one grey stack (frame, y, x)")
    order = "".join(axis for axis, _ in named)
    if {"Y", "X"} <= set(order) and not order.endswith("YX"):
        raise MufasaError(f"{path} has its axes in the order {series.axes}: save it as (frame, y, x), axes TYX")
    if len(named) > 3:
        words = {
            "C": "channels",
            "Z": "planes (z)",
            "T": "frames",
            "Q": "positions",
            "P": "positions",
            "R": "positions",
        }
        counts = ", ".join(f"{n} {words.get(axis, f'along {axis}')}" for axis, n in named[:-2])
        raise MufasaError(
            f"{path} has axes {series.axes} {tuple(series.shape)}, {counts}: needs one stack (frame, y, x); "
            "save one channel and plane as its own file"
        )
    if any(axis == "C" for axis, _ in named):
        count = dict(named)["C"]
        warnings.warn(f"{path} has {count} channels and no other frames: they are taken as frames", stacklevel=4)


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
