"""Files in and out: movies, traces, tables; written whole or not at all. Plain data: nothing here knows a model."""

from napari_mufasa.files.movies import METADATA_KEY, PHOTONS, Movie, is_zarr, load, read_movie, write_movie
from napari_mufasa.files.whole import (
    PathLike,
    filling,
    read_json,
    replacing,
    signature,
    write_bytes,
    write_json,
    write_table,
    write_text,
)

__all__ = [
    "METADATA_KEY", "PHOTONS", "Movie", "PathLike", "filling", "is_zarr", "load", "read_json", "read_movie",
    "replacing", "signature", "write_bytes", "write_json", "write_movie", "write_table", "write_text",
]  # fmt: skip
