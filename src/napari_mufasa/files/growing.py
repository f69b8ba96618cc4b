"""Movies on their way to the disk, block by block; those that a killed run leaves behind are gone on with."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.errors import MufasaError
from napari_mufasa.files.whole import plain, remove, replacing, write_text
from napari_mufasa.provenance import version

Block = tuple[int, NDArray[Any]]  # first frame, frames (frame, y, x)
Blocks = Callable[[int], Iterator[Block]]  # the blocks from a frame on; the first may begin before it
CHUNK_BYTES = 2**22


def create(path: Path, shape: tuple[int, int, int], dtype: Any) -> Any:
    """A new zarr array (frame, y, x) of whole frames; each chunk knows its checksum, and each is written, so that a
    chunk that is damaged or not there is seen."""
    import zarr
    from zarr.codecs import ZstdCodec

    return zarr.create_array(
        store=str(path), shape=shape, chunks=(chunk_frames(shape, dtype), *shape[1:]), dtype=dtype,
        compressors=[ZstdCodec(level=0, checksum=True)], config={"write_empty_chunks": True},
    )  # fmt: skip


def chunk_frames(shape: tuple[int, int, int], dtype: Any) -> int:
    return max(1, min(shape[0], CHUNK_BYTES // (shape[1] * shape[2] * np.dtype(dtype).itemsize) or 1))


def counted(blocks: Iterable[NDArray[Any]], shape: tuple[int, int, int]) -> Iterator[NDArray[Any]]:
    """The blocks as they come; raises when they are not the frames that were announced."""
    n = 0
    for block in blocks:
        n += len(block)
        _check_fits(block, n, shape)
        yield block
    _check_all_came(n, shape)


def _check_fits(block: NDArray[Any], end: int, shape: tuple[int, int, int]) -> None:
    if block.ndim != 3 or tuple(block.shape[1:]) != tuple(shape[1:]) or end > shape[0]:
        raise MufasaError(
            f"a block of shape {block.shape} (frames up to {end}) does not fit a movie of {shape}: "
            "give the frames that were announced"
        )


def _check_all_came(n: int, shape: tuple[int, int, int]) -> None:
    if n != shape[0]:
        raise MufasaError(f"{n} frames came for a movie of {shape[0]}: give as many; nothing was written")


def partial(out: Path) -> Path:
    """Where a movie in the making lies."""
    return out.with_name(f".{out.name}.partial")


def forget(out: Path) -> None:
    """Remove what a run that was killed left of a movie."""
    remove(partial(out))


class Growing:
    """A movie in the making: a hidden folder beside the output with the array, what it is of, and how far it came.

    Frames before `done` are whole: the number is written after them, and only where a chunk ends.
    """

    def __init__(self, out: Path, shape: tuple[int, int, int], dtype: Any, identity: Mapping[str, Any]) -> None:
        self.folder = partial(out)
        self.path = self.folder / "movie.zarr"
        self.shape = shape
        self._chunk = chunk_frames(shape, dtype)
        described = {**identity, "version": version(), "shape": shape, "dtype": str(np.dtype(dtype))}
        told = json.dumps(plain(described), sort_keys=True)
        self.done = 0
        if not self._goes_on(told):
            remove(self.folder)
            self.folder.mkdir()
            self.array = create(self.path, shape, dtype)
            write_text(self.folder / "done", "0")
            write_text(self.folder / "identity.json", told)  # last: with it the folder can be gone on with

    def _goes_on(self, told: str) -> bool:
        """Take up what is there; False where it is of other work, or cannot be read."""
        import zarr

        try:
            if (self.folder / "identity.json").read_text() != told:
                return False
            for unfinished in self.path.rglob("*.partial"):  # chunks that were being written
                unfinished.unlink()
            self.array = zarr.open_array(str(self.path), mode="r+", config={"write_empty_chunks": True})
            self.done = int((self.folder / "done").read_text())
        except Exception:  # whatever is wrong with it: the work is done anew
            return False
        return True

    def fill(self, blocks: Blocks) -> None:
        """Write what is missing."""
        if self.done == self.shape[0]:
            return
        end = self.done
        for start, block in blocks(self.done):
            end = start + len(block)
            _check_fits(block, end, self.shape)
            first = max(start, self.done)
            if end <= first:
                continue
            self.array[first:end] = block[first - start :]
            whole = end if end == self.shape[0] else end // self._chunk * self._chunk
            if whole > self.done:
                self.done = whole
                write_text(self.folder / "done", str(whole))
        _check_all_came(end, self.shape)

    def frames(self) -> Iterator[NDArray[Any]]:
        """The movie, chunk by chunk."""
        for start in range(0, self.shape[0], self._chunk):
            yield np.asarray(self.array[start : start + self._chunk])

    def become(self, out: Path) -> None:
        """The array itself becomes the output."""
        with replacing(out) as temporary:
            os.replace(self.path, temporary)

    def remove(self) -> None:
        remove(self.folder)
