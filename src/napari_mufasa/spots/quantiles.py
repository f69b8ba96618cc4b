"""Quantiles of numbers: NumPy's, without what it takes to be asked for any kind of them. They are asked for dozens of
times in each simulation of a diagnosis."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray


def quantiles(values: NDArray[np.floating[Any]], shares: Sequence[float]) -> NDArray[np.float64]:
    """(share, …) quantiles along the last axis of values (…, number), as `numpy.quantile` interpolates them."""
    last = values.shape[-1] - 1
    place = last * np.asarray(shares, dtype=np.float64)
    low = place.astype(np.int64)
    high = np.minimum(low + 1, last)
    ordered = np.partition(values, sorted({*low.tolist(), *high.tolist()}), axis=-1)
    at = place - low
    below, above = ordered[..., low], ordered[..., high]
    step = above - below
    between = np.where(at < 0.5, below + step * at, above - step * (1 - at))
    return np.asarray(np.moveaxis(between, -1, 0), dtype=np.float64)
