"""Results to look at: larger than memory, and what denoising took away."""

from __future__ import annotations

import tempfile
from typing import Any

import numpy as np

#: Results larger than this are written to a temporary zarr store and read from there.
IN_MEMORY_BYTES = 2**30


def store_for(shape: tuple[int, ...]) -> Any:
    """A zarr array in a temporary folder for results that are better not held in memory; None for the others."""
    if 4 * int(np.prod(shape, dtype=np.int64)) <= IN_MEMORY_BYTES:
        return None
    import zarr

    folder = tempfile.mkdtemp(prefix="mufasa-denoised-")
    chunks = (min(16, shape[0]), *shape[1:])
    return zarr.open(folder, mode="w", shape=shape, chunks=chunks, dtype="f4")


def lazily(result: Any) -> Any:
    """Stored results as dask, so that the viewer reads the frame it shows."""
    if isinstance(result, np.ndarray):
        return result
    import dask.array

    da: Any = dask.array  # its functions carry no types

    return da.from_array(result, chunks=(1, *result.shape[1:]))


def taken_away(movie: Any, camera: Any, photons: Any) -> Any:
    """Recorded frames as photons less the denoised ones, frame by frame when looked at."""
    import dask.array

    da: Any = dask.array  # its functions carry no types

    from napari_mufasa import camera as cam

    one_frame = (1, *photons.shape[1:])
    counts, after = da.asarray(movie).rechunk(one_frame), da.asarray(photons).rechunk(one_frame)

    def difference(recorded: Any, denoised: Any, block_id: tuple[int, ...]) -> Any:
        electrons = cam.photoelectrons(recorded, camera, block_id[0])  # of its own number: baselines may alternate
        return np.asarray(cam.photons(electrons, camera) - denoised, np.float32)

    return da.map_blocks(difference, counts, after, dtype=np.float32)
