"""Counts as they are read for a measurement of the camera, and which of them are dark."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.errors import Cancelled, MufasaError

CHUNKS = 10  # parts of the movie whose spread gives uncertainties
CHUNK_FRAMES = 16  # in each at least
CHUNK_BYTES = 2**25  # of each at most, as float32
READ_BYTES = 2**25  # at a time, where all frames are read
END_FRAMES = 500  # at either end of a movie, among which dark ones are looked for …
LEAST_END = 3  # … so many of them, and of lit ones beside them …
BESIDE = 8  # … which are lit one and all, so many of the next; of those farther on half
DIM = 0.1  # of the light, that frames before or after it may hold and be dark, where the dark level is known
MOST_PX = 2**20  # of the field, in its middle, that are looked at one by one
DARK_SHARE = 0.05  # of the field that must lie in shadow to be used
DARK_BLOCK_PX = 8
DARK_CONTRAST = 8.0  # lit over shadow, in spreads of the shadow's blocks


def counts(data: Any, what: str) -> NDArray[Any]:
    """Raw counts; raises `MufasaError` for what no camera records."""
    found: NDArray[Any] = np.asarray(data)
    if found.dtype.kind not in "uif" or not np.isfinite(found).all() or (found.size and found.min() < 0):
        raise MufasaError(f"{what} hold values that are negative or no numbers: give the raw counts (ADU)")
    return found


def window(shape: tuple[int, ...], most: int | None = None) -> tuple[slice, slice]:
    """The middle of a field (y, x), of so many pixels at `most` (None: `MOST_PX`), as square as the field allows."""
    (height, width), most = shape, most or MOST_PX
    rows = min(height, max(int(most**0.5), most // max(width, 1)))
    columns = min(width, most // max(rows, 1))
    top, left = (height - rows) // 2, (width - columns) // 2
    return slice(top, top + rows), slice(left, left + columns)


def lit_chunks(
    movie: Any, first: int, progress: Callable[[int, int], None] | None, cancel: Callable[[], bool] | None
) -> list[NDArray[np.float32]]:
    """Up to `CHUNKS` runs of frames (frame, y, x) spread over the movie from frame `first` on, within its `window`;
    they take `CHUNKS` · `CHUNK_BYTES`."""
    rows, columns = window(movie.shape[1:])
    n_chunks = min(CHUNKS, max(1, (movie.shape[0] - first) // CHUNK_FRAMES))
    edges = np.linspace(first, movie.shape[0], n_chunks + 1).astype(int)
    most = max(8, CHUNK_BYTES // (4 * (rows.stop - rows.start) * (columns.stop - columns.start)))
    found = []
    for i, (start, stop) in enumerate(itertools.pairwise(edges)):
        if cancel is not None and cancel():
            raise Cancelled
        chunk = counts(movie[start : min(stop, start + most), rows, columns], "the movie's frames").astype(np.float32)
        if len(chunk) >= 4:
            found.append(chunk)
        if progress is not None:
            progress(i + 1, len(edges) - 1)
    if not found:
        raise MufasaError("fewer than 4 lit frames: record more frames under light")
    return found


def some_frames(stack: Any, n: int, first: int = 0, part: tuple[slice, ...] = ()) -> NDArray[Any]:
    """At most n frames (frame, y, x), or a part of each, spread over those of a stack from `first` on."""
    chosen = np.unique(np.linspace(first, stack.shape[0] - 1, n).astype(int))
    return np.stack([np.asarray(stack[(int(t), *part)]) for t in chosen])


def blocks(shape: tuple[int, ...], start: int, stop: int, cancel: Callable[[], bool] | None = None) -> Iterator[slice]:
    """The frames start … stop of a stack as runs that are read at a time: `READ_BYTES` each, as float64."""
    step = max(1, READ_BYTES // max(8 * int(np.prod(shape[1:])), 1))
    for first in range(start, stop, step):
        if cancel is not None and cancel():
            raise Cancelled
        yield slice(first, min(first + step, stop))


def lit_frames(movie: Any, cancel: Callable[[], bool] | None = None) -> tuple[int, int]:
    """First frame under light, and that after the last one: what lies before a sudden, lasting rise of the mean, and
    after such a fall, is dark; (0, number of frames) where there is none. Looks at both ends, `END_FRAMES` of each, and
    judges each by itself; of two, one that holds light (`DIM`) by the level of the other is lit."""
    n = int(movie.shape[0])
    step = max(1, int(np.sqrt(movie.shape[1] * movie.shape[2] / 4096)))
    ends = [(0, n)] if n <= 2 * END_FRAMES else [(0, END_FRAMES), (n - END_FRAMES, n)]
    looked = (
        np.asarray(movie[some])[:, ::step, ::step] for part in ends for some in blocks(movie.shape, *part, cancel)
    )
    level = np.concatenate([block.mean(axis=(1, 2), dtype=np.float64) for block in looked])
    begin, end = level[:END_FRAMES], level[::-1][:END_FRAMES]
    first, last = _unlit(begin), _unlit(end)
    if first and last:
        dark = [float(np.mean(part[:unlit])) for part, unlit in ((begin, first), (end, last))]
        light = [float(np.median(_lasting(part[unlit:]))) - min(dark) for part, unlit in ((begin, first), (end, last))]
        dim = [own - min(dark) > DIM * beside for own, beside in zip(dark, light, strict=True)]
        first, last = 0 if dim[0] else first, 0 if dim[1] else last
    return first, n - last


def _unlit(level: NDArray[np.float64]) -> int:
    """How many of the first frames, by the mean of each, lie before a sudden rise that lasts."""
    jumps = np.diff(level)
    if len(level) < 8 or jumps.max() <= 0:
        return 0
    # Light that goes on in steps, or goes out for a frame, rises more than once: the first of the large ones counts.
    for at in np.flatnonzero(jumps > jumps.max() / 4) + 1:
        before, lit = level[:at], _lasting(level[at:])
        if min(len(before), len(lit)) < LEAST_END:
            continue
        # The first lit frame may be lit in part; the dark ones are alike and all below the next lit ones.
        if before.max() + 10 * max(float(np.std(before)), 1e-9) < min(lit[:BESIDE].min(), np.median(lit)):
            return int(at)
    return 0


def _lasting(level: NDArray[np.float64]) -> NDArray[np.float64]:
    """What begins lit, up to its deepest fall after `BESIDE` frames; it may fade from the first on."""
    falls = np.diff(level[BESIDE - 1 :])
    return level[: BESIDE + int(np.argmin(falls))] if len(falls) else level


def shadow(chunks: list[NDArray[np.float32]]) -> NDArray[np.bool_] | None:
    """(y, x) True where a part of the chip, from an edge on, gets no light: level, and far below the rest. None: no
    such part. A dim, even background looks the same here: whoever uses it must look at its histogram too."""
    from scipy import ndimage
    from skimage import filters

    mean = np.mean([chunk.mean(axis=0) for chunk in chunks], axis=0)
    b = DARK_BLOCK_PX
    if min(mean.shape) < 4 * b:
        return None
    blocks = mean[: mean.shape[0] // b * b, : mean.shape[1] // b * b]
    blocks = np.median(blocks.reshape(len(blocks) // b, b, -1, b), axis=(1, 3))
    otsu: Any = filters.threshold_otsu  # its functions carry no types
    low = blocks < otsu(blocks)
    names, _ = ndimage.label(low)
    sizes = np.bincount(names.ravel())[1:]
    if len(sizes) == 0:
        return None
    largest = names == 1 + int(np.argmax(sizes))
    inner = ndimage.binary_erosion(largest, border_value=1)  # the block beside the light is half lit
    if inner.mean() < DARK_SHARE or not (inner[0].all() or inner[-1].all() or inner[:, 0].all() or inner[:, -1].all()):
        return None
    for _ in range(8):  # a dim rim on one side must not count as dark: its level and spread are those of the lower half
        level, below = np.percentile(blocks[inner], [50, 15.87])
        spread = float(level - below) + 1e-3 * float(level)
        inner &= blocks < level + 2.5 * spread
    if inner.mean() < DARK_SHARE or float(np.median(blocks[~largest])) - level < DARK_CONTRAST * spread:
        return None
    found = np.zeros(mean.shape, dtype=bool)
    found[: inner.shape[0] * b, : inner.shape[1] * b] = np.kron(inner, np.ones((b, b), dtype=bool))
    return found
