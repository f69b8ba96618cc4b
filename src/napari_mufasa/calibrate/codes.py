"""Codes that the converter prefers or misses, and where it ends."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

PERIOD = 32
SURE = 1e-6  # chance of uneven codes where they are even
LEAST = 0.01  # relative rms below which nobody would see it
PILED_UP, LEAST_COUNTS = 3, 50  # times more counts at the top than at a code below it: saturation
LEAST_PIXELS = 4  # that show it
ROOM_SD = 5.0  # below the top, for a pixel to be free of it


def code_widths(stacks: Iterable[Any]) -> tuple[float, ...]:
    """Widths of the codes modulo `PERIOD`, of mean 1, from those stacks whose counts spread over more than a period;
    () where they are even, or cannot be told.

    Codes are the same in every period, counts are not: those of a dark or even background pile up within a few codes,
    whatever spots add far above them. Such a pile differs more between odd and even periods than between codes.
    """
    from scipy import stats

    periods = np.zeros((2, PERIOD))
    for stack in stacks:
        if np.std(stack) < PERIOD:  # as those of dark frames are
            continue
        codes = np.asarray(stack, np.int64).ravel() % (2 * PERIOD)
        periods += np.bincount(codes, minlength=2 * PERIOD).reshape(2, PERIOD)
    found = periods.sum(axis=0)
    if not found.any():
        return ()
    even = found.sum() / PERIOD
    rms = float(np.std(found / even))
    if rms < np.sqrt(np.mean((periods[0] - periods[1]) ** 2)) / even:
        return ()
    if stats.chi2.sf(np.sum((found - even) ** 2) / even, PERIOD - 1) > SURE or rms < LEAST:
        return ()
    return tuple(round(float(width), 4) for width in found / even)


def saturation_adu(chunks: Sequence[NDArray[Any]], pixels: NDArray[np.bool_]) -> float | None:
    """The count at which values pile up in several of the `pixels` (y, x) of chunks (frame, y, x); None where they do
    not: a single pixel may be stuck anywhere."""
    top = float(max(np.max(chunk, axis=0)[pixels].max() for chunk in chunks))
    at = sum(np.sum(chunk >= top, axis=0)[pixels] for chunk in chunks)
    near = sum(int(np.sum((chunk >= top - 16) & (chunk < top), axis=0)[pixels].sum()) for chunk in chunks)
    piled = np.sum(at) > max(LEAST_COUNTS, PILED_UP * near / 16) and np.count_nonzero(at) >= LEAST_PIXELS
    return top if piled else None


def saturated_pixels(chunks: Sequence[NDArray[np.float32]], full: float) -> NDArray[np.bool_]:
    """(y, x) True where counts reach `full`, or would in few of many frames: what is cut off has no variance."""
    reached = np.any([(chunk >= full).any(axis=0) for chunk in chunks], axis=0)
    near = [chunk.mean(axis=0) + ROOM_SD * chunk.std(axis=0) >= full for chunk in chunks]
    return np.asarray(reached | np.any(near, axis=0))
