"""Codes that the converter prefers or misses, and where it ends."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

PERIOD = 32
SURE = 1e-6  # chance of uneven codes where they are even
LEAST = 0.01  # relative rms below which nobody would see it
PILED_UP, LEAST_COUNTS = 3, 50  # times more counts at the top than at a code below it: saturation


def code_widths(stacks: Sequence[Any]) -> tuple[float, ...]:
    """Widths of the codes modulo `PERIOD`, of mean 1, from counts spread over more than a period; () where they are
    even, or cannot be told."""
    from scipy import stats

    found = np.zeros(PERIOD)
    for stack in stacks:
        if np.std(stack) < PERIOD:
            return ()
        found += np.bincount(np.asarray(stack, np.int64).ravel() % PERIOD, minlength=PERIOD)
    even = found.sum() / PERIOD
    rms = float(np.std(found / even))
    if stats.chi2.sf(np.sum((found - even) ** 2) / even, PERIOD - 1) > SURE or rms < LEAST:
        return ()
    return tuple(round(float(width), 4) for width in found / even)


def saturation_adu(stacks: Sequence[Any]) -> float | None:
    """The count at which values pile up; None where the movie does not reach it."""
    top = float(max(np.max(stack) for stack in stacks))
    at = sum(int(np.sum(stack >= top)) for stack in stacks)
    near = sum(int(np.sum((stack >= top - 16) & (stack < top))) for stack in stacks)
    return top if at > LEAST_COUNTS and at > PILED_UP * near / 16 else None
