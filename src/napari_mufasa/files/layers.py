"""What napari reads and writes: movies on disk as Image layers, their metadata kept; and what such layers hold."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from napari_mufasa.checks import counted
from napari_mufasa.errors import MufasaError
from napari_mufasa.files.formats import FORMATS, is_format
from napari_mufasa.files.instrument import Instrument
from napari_mufasa.files.movies import METADATA_KEY, PHOTONS, read_movie, write_movie
from napari_mufasa.files.opening import complaints

LayerData = tuple[Any, dict[str, Any], str]
MOVIE_SUFFIXES = (".tif", ".tiff", ".zarr", *FORMATS)
BLOCK_FRAMES = 64


# readers ------------------------------------------------------------------------------------------------
def get_reader(path: str | Sequence[str]) -> Callable[[str | Sequence[str]], list[LayerData]] | None:
    """napari's question: can you read this? Files that carry our metadata, formats that napari has no reader for, and
    stacks of Micro-Manager, of whose pixel size and exposure napari's own knows nothing; all others are someone
    else's."""
    if not isinstance(path, (str, os.PathLike)):
        return None
    ours = is_ours(path) or is_micro_manager(path) or (Path(path).is_file() and is_format(Path(path)))
    return read_layers if ours else None


def is_micro_manager(path: str | os.PathLike[str]) -> bool:
    """Whether Micro-Manager wrote this file; looks at its header only."""
    return _header_says(path, lambda tiff: tiff.is_micromanager)


def is_ours(path: str | os.PathLike[str]) -> bool:
    """Whether we wrote this file; looks at its header only."""
    name = str(path).lower().rstrip("/")
    try:
        if name.endswith(".zarr"):
            import json

            file = Path(path) / "zarr.json"
            return file.is_file() and METADATA_KEY in json.loads(file.read_text()).get("attributes", {})
    except Exception:  # unreadable: not ours, whatever is wrong with it
        return False
    return _header_says(path, lambda tiff: tiff.is_ome and METADATA_KEY in (tiff.ome_metadata or ""))


def _header_says(path: str | os.PathLike[str], what: Callable[[Any], bool]) -> bool:
    """Whether the header of a TIFF says `what`; of a file that is none, or cannot be read, it does not."""
    if not str(path).lower().endswith((".tif", ".tiff")):
        return False
    try:
        import tifffile

        with complaints(), tifffile.TiffFile(path) as tiff:
            return bool(what(tiff))
    except Exception:  # whatever is wrong with it
        return False


def read_layers(path: str | Sequence[str]) -> list[LayerData]:
    """A movie, lazily; the model of one that we wrote is in ``metadata["napari_mufasa"]``."""
    return [movie_layer(path if isinstance(path, (str, os.PathLike)) else path[0])]


def movie_layer(path: str | os.PathLike[str]) -> LayerData:
    """Any movie (frame, y, x) as an Image layer; contrast from a few frames, so that it stays lazy. What the recording
    software wrote of the instrument is in ``metadata["napari_mufasa"]["instrument"]``."""
    movie = read_movie(path)
    data = movie.data
    options: dict[str, Any] = {
        "name": _stem(path),
        "axis_labels": ("frame", "y", "x"),
        "contrast_limits": contrast(data),
    }
    written = movie.instrument.known()
    if movie.metadata.get("model") or movie.metadata.get("role"):
        options["metadata"] = {METADATA_KEY: movie.metadata}
    elif written:
        options["metadata"] = {METADATA_KEY: {"instrument": written}}
    if movie.pixel_size_nm is not None:
        options |= movie_space(movie.pixel_size_nm)
    return data, options, "image"


# writers ------------------------------------------------------------------------------------------------
def write_image(path: str, data: Any, attributes: dict[str, Any]) -> list[str]:
    """An Image layer as OME-TIFF or zarr, with its model; streamed in blocks of frames."""
    try:
        stack = _stack(data, bool(attributes.get("multiscale")), bool(attributes.get("rgb")))
    except ValueError as error:
        raise MufasaError(f"layer has {error}; save it in another format") from None
    stored = attributes.get("metadata", {}).get(METADATA_KEY) or {}
    blocks = (np.asarray(stack[start : start + BLOCK_FRAMES]) for start in range(0, len(stack), BLOCK_FRAMES))
    size_um = pixel_size_um(attributes["scale"], attributes["units"]) if attributes.get("units") else None
    write_movie(
        path, blocks, tuple(stack.shape), stack.dtype, model=stored.get("model"), seed=stored.get("seed"),
        pixel_size_nm=size_um * 1000 if size_um else None, role=stored.get("role"),
    )  # fmt: skip
    return [path]


# what layers hold ---------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Measurement:
    """What was recorded: `movie` and `dark` (frame, y, x) as stored in the layers, possibly lazy; `name` for titles.

    `unit` is "adu" for what a camera recorded, "photons" for a movie that was denoised. `first_frame` is the layer's
    frame that `movie` begins with, an even one: dark frames before it are cut off.
    """

    movie: Any
    dark: Any
    name: str
    unit: Literal["adu", "photons"] = "adu"
    first_frame: int = 0

    def recorded(self) -> Measurement:
        """Itself; raises `MufasaError` when it is not what a camera recorded."""
        if self.unit != "adu":
            raise MufasaError(f"{self.name} holds photons, not camera counts: choose the recorded movie in step Data")
        return self


def measurement_of(movie: Any, dark: Any = None, dark_frames: int = 0) -> Measurement:
    """What layers hold as a measurement; raises `MufasaError` that says what to choose.

    dark : a layer of dark frames; dark_frames : or how many frames of the movie are dark, at its beginning; of an odd
        number the frame after them is left out, too
    """
    if movie is None:
        raise MufasaError("no movie chosen: open one, or File > Open Sample > MUFASA, then choose it in step Data")
    stack, frames, first = stack_of(movie), None, 0
    if dark is not None:
        frames = stack_of(dark)
    elif dark_frames:
        first = dark_frames
        if first + first % 2 >= len(stack):
            raise MufasaError(
                f"of {movie.name} {counted(first, 'frame')} at the start should be dark, but it has {len(stack)}: give "
                "fewer dark frames"
            )
        frames = stack[:first]
        first += first % 2  # an even frame: the baseline of odd ones may differ
        stack = stack[first:]
    unit: Literal["adu", "photons"] = "photons" if stored(movie, "role") == PHOTONS else "adu"
    return Measurement(stack, frames, movie.name, unit, first)


def stack_of(layer: Any) -> Any:
    """The layer's data as (frame, y, x), never copied; raises `MufasaError` when it is no movie."""
    try:
        return _stack(layer.data, getattr(layer, "multiscale", False), getattr(layer, "rgb", False))
    except ValueError as error:
        raise MufasaError(f"layer {layer.name} has {error}; choose another layer") from None


def _stack(data: Any, multiscale: bool, rgb: bool) -> Any:
    data = data[0] if multiscale else data
    if rgb:
        raise ValueError("colours (RGB): a movie is grey, (frame, y, x)")
    if data.ndim not in (2, 3):
        raise ValueError(f"shape {tuple(data.shape)}: a movie is (frame, y, x)")
    return data if data.ndim == 3 else data[np.newaxis]


def stored(layer: Any, key: str) -> Any:
    """What the layer's metadata say of us: `model`, `seed`, `role` ("dark frames", "photons" …), `dark_layer`,
    `instrument`."""
    ours = layer.metadata.get(METADATA_KEY) if layer is not None else None
    return ours.get(key) if isinstance(ours, dict) else None


def instrument_of(layer: Any) -> Instrument:
    """What the recording software wrote of the instrument, as far as the layer's metadata hold it."""
    return Instrument(**(stored(layer, "instrument") or {}))


def pixel_size_um(scale: Sequence[float], units: Sequence[Any]) -> float | None:
    """The pixel size in µm that a layer states, if it states one."""
    factor = {"micrometer": 1.0, "um": 1.0, "µm": 1.0, "nanometer": 1e-3, "nm": 1e-3}.get(str(units[-1]))
    return float(scale[-1]) * factor if factor is not None else None


def movie_space(pixel_size_nm: float) -> dict[str, Any]:
    """Scale and units of a (frame, y, x) layer: pixels in µm, the frame axis in frames."""
    size_um = pixel_size_nm / 1000
    return {"scale": (1.0, size_um, size_um), "units": ("pixel", "um", "um"), "axis_labels": ("frame", "y", "x")}


def contrast(movie: Any) -> tuple[float, float]:
    """Contrast limits from eight frames spread over the movie, so that a lazy one stays lazy; of finite values only."""
    chosen = np.unique(np.linspace(0, len(movie) - 1, 8).astype(int))
    frames = np.stack([np.asarray(movie[int(t)], dtype=np.float32) for t in chosen])
    frames = frames[np.isfinite(frames)]
    if not frames.size:
        return 0.0, 1.0
    low, high = (float(v) for v in np.percentile(frames, (1, 99.9)))
    # Coarse digitisation may leave a handful of levels: then the largest count is white.
    return low, high if high - low > 4 else max(float(frames.max()), low + 1e-3)


def _stem(path: str | os.PathLike[str]) -> str:
    name = Path(path).name
    for suffix in (".ome.tiff", ".ome.tif", *MOVIE_SUFFIXES):
        if name.lower().endswith(suffix):
            return name[: -len(suffix)]
    return name
