"""What napari reads and writes: movies on disk as Image layers, their metadata kept."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from napari_mufasa.errors import MufasaError
from napari_mufasa.files.movies import METADATA_KEY, read_movie, write_movie

LayerData = tuple[Any, dict[str, Any], str]
MOVIE_SUFFIXES = (".tif", ".tiff", ".zarr")
BLOCK_FRAMES = 64


# readers ------------------------------------------------------------------------------------------------
def get_reader(path: str | Sequence[str]) -> Callable[[str | Sequence[str]], list[LayerData]] | None:
    """napari's question: can you read this? Only files that carry our metadata; all others are someone else's."""
    if not isinstance(path, (str, os.PathLike)):
        return None
    return read_layers if is_ours(path) else None


def is_ours(path: str | os.PathLike[str]) -> bool:
    """Whether we wrote this file; looks at its header only."""
    name = str(path).lower().rstrip("/")
    try:
        if name.endswith(".zarr"):
            import json

            file = Path(path) / "zarr.json"
            return file.is_file() and METADATA_KEY in json.loads(file.read_text()).get("attributes", {})
        if name.endswith((".tif", ".tiff")):
            import tifffile

            with tifffile.TiffFile(path) as tiff:
                return bool(tiff.is_ome and METADATA_KEY in (tiff.ome_metadata or ""))
    except (OSError, ValueError, AttributeError):  # unreadable: not ours
        return False
    return False


def read_layers(path: str | Sequence[str]) -> list[LayerData]:
    """A movie we wrote, lazily, its model in ``metadata["napari_mufasa"]``."""
    return [movie_layer(path if isinstance(path, (str, os.PathLike)) else path[0])]


def movie_layer(path: str | os.PathLike[str]) -> LayerData:
    """Any TIFF or zarr movie (frame, y, x) as an Image layer; contrast from one frame, so that it stays lazy."""
    movie = read_movie(path)
    data = movie.data
    options: dict[str, Any] = {
        "name": _stem(path),
        "axis_labels": ("frame", "y", "x"),
        "contrast_limits": contrast(data),
    }
    if movie.metadata.get("model"):
        options["metadata"] = {METADATA_KEY: movie.metadata}
        if movie.pixel_size_nm is not None:
            options |= movie_space(movie.pixel_size_nm)
    return data, options, "image"


# writers ------------------------------------------------------------------------------------------------
def write_image(path: str, data: Any, attributes: dict[str, Any]) -> list[str]:
    """An Image layer as OME-TIFF or zarr, with its model; streamed in blocks of frames."""
    data = data[0] if attributes.get("multiscale") else data
    stack = data if data.ndim == 3 else data[np.newaxis] if data.ndim == 2 else None
    if stack is None or attributes.get("rgb"):
        raise MufasaError(f"layer has shape {tuple(data.shape)}: a movie is (frame, y, x); save it in another format")
    stored = attributes.get("metadata", {}).get(METADATA_KEY) or {}
    blocks = (np.asarray(stack[start : start + BLOCK_FRAMES]) for start in range(0, len(stack), BLOCK_FRAMES))
    units = [str(unit) for unit in attributes.get("units", ())] or ["pixel"]
    size_um = float(attributes["scale"][-1]) if units[-1] in ("micrometer", "um", "µm") else None
    write_movie(
        path, blocks, tuple(stack.shape), stack.dtype, model=stored.get("model"), seed=stored.get("seed"),
        pixel_size_nm=size_um * 1000 if size_um else None,
    )  # fmt: skip
    return [path]


def movie_space(pixel_size_nm: float) -> dict[str, Any]:
    """Scale and units of a (frame, y, x) layer: pixels in µm, the frame axis in frames."""
    size_um = pixel_size_nm / 1000
    return {"scale": (1.0, size_um, size_um), "units": ("pixel", "um", "um"), "axis_labels": ("frame", "y", "x")}


def contrast(movie: Any) -> tuple[float, float]:
    """Contrast limits from eight frames spread over the movie, so that a lazy one stays lazy."""
    chosen = np.unique(np.linspace(0, len(movie) - 1, 8).astype(int))
    frames = np.stack([np.asarray(movie[int(t)], dtype=np.float32) for t in chosen])
    low, high = (float(v) for v in np.percentile(frames, (1, 99.9)))
    # Coarse digitisation may leave a handful of levels: then the largest count is white.
    return low, high if high - low > 4 else max(float(frames.max()), low + 1e-3)


def _stem(path: str | os.PathLike[str]) -> str:
    name = Path(path).name
    for suffix in (".ome.tiff", ".ome.tif", *MOVIE_SUFFIXES):
        if name.lower().endswith(suffix):
            return name[: -len(suffix)]
    return name
