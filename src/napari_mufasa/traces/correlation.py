"""How a trace remembers itself: the one autocovariance of traces."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


def lagged(
    deviation: NDArray[np.floating], used: NDArray[np.bool_], lag: int
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Sum of d(t)·d(t + lag) over the frames of each trace that are both used, and how many those are, (trace,)."""
    kept = np.where(used, deviation, 0.0)
    ahead, behind = slice(lag, None), slice(None, used.shape[1] - lag)
    products = np.einsum("mt,mt->m", kept[:, ahead], kept[:, behind])
    return products, np.count_nonzero(used[:, ahead] & used[:, behind], axis=1)


def autocovariance(
    deviation: NDArray[np.floating], used: NDArray[np.bool_], lags: Sequence[int] | NDArray[np.integer]
) -> NDArray[np.float64]:
    """Mean of d(t)·d(t + lag) over all traces, (lag,): each pair of used frames counts once; nan without any.

    Parameters
    ----------
    deviation : (trace, frame) traces minus what they are thought to fluctuate about
    used : (trace, frame) the frames that count
    """
    result = np.full(len(lags), np.nan)
    for i, lag in enumerate(lags):
        products, pairs = lagged(deviation, used, int(lag))
        if pairs.sum() > 0:
            result[i] = products.sum() / pairs.sum()
    return result
