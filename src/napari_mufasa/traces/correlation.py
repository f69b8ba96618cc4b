"""How a trace remembers itself: the one autocovariance of traces."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


def lagged(
    deviation: NDArray[np.floating], used: NDArray[np.bool_], lag: int
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Sum of d(t)·d(t + lag) over the frames of each trace that are both used, and how many those are, (trace,)."""
    products, pairs = _pairs(np.where(used, deviation, 0.0), used, lag)
    return products.sum(axis=1), np.count_nonzero(pairs, axis=1)


def autocovariance(
    deviation: NDArray[np.floating], used: NDArray[np.bool_], lags: Sequence[int] | NDArray[np.integer]
) -> NDArray[np.float64]:
    """Mean of d(t)·d(t + lag) over all traces, (lag,): each pair of used frames counts once; nan without any.

    Parameters
    ----------
    deviation : (trace, frame) traces minus what they are thought to fluctuate about
    used : (trace, frame) the frames that count
    """
    kept = np.where(used, deviation, 0.0)
    result = np.full(len(lags), np.nan)
    for i, lag in enumerate(lags):
        products, pairs = _pairs(kept, used, int(lag))
        if n := np.count_nonzero(pairs):
            result[i] = products.sum() / n
    return result


def _pairs(
    kept: NDArray[np.float64], used: NDArray[np.bool_], lag: int
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Products of the frames `lag` apart, (trace, frame − lag), of numbers that are 0 where not used; which count."""
    ahead, behind = slice(lag, None), slice(None, max(used.shape[1] - lag, 0))
    return kept[:, ahead] * kept[:, behind], used[:, ahead] & used[:, behind]
