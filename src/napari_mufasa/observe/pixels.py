"""Statistics of every pixel, in two passes over the movie.

Everything here is plain counting; `summary` turns it into named observables. Pixels carry a label: 0 spots
and their surroundings, 1 … background of a part of the field, so that parts can be summarised apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PixelStatistics:
    """Per pixel (y, x) unless said otherwise; ADU above the baseline, variances in ADU².

    mean, variance, skewness : over all frames
    step_variance (half, y, x) : half the mean squared difference of successive frames, in each half of the movie
    lag1, lag2 : autocovariance over frames
    right, below (y − 1, x − 1) : covariance with the next pixel along x and y
    row_sum (part, frame, y), column_sum (part, frame, x) : sums over the labelled pixels
    steps (part, frame) : sum over them of how far each is from where it was in the frame before
    comb (part, `COMB`) : how often counts have each remainder
    peak, peak_frame : largest value and where in time; second : the next largest, anywhere else in time
    """

    n_frames: int
    mean: Array
    variance: Array
    skewness: Array
    step_variance: Array
    lag1: Array
    lag2: Array
    right: Array
    below: Array
    row_sum: Array
    column_sum: Array
    steps: Array
    comb: NDArray[np.int64]
    peak: Array
    peak_frame: NDArray[np.int64]
    second: Array


def pixel_statistics(
    movie: NDArray[np.uint16], baseline_adu: float, label: NDArray[np.int8], parts: int
) -> PixelStatistics:
    """Two passes over (frame, y, x); `label` is (y, x) with values 0 … parts."""
    n = len(movie)
    from napari_mufasa.observe.kernels import in_space, in_time

    sums, (peak, peak_frame, second) = in_time(movie, float(baseline_adu))
    (s1, s2, s3, l1, l2), step, (right, below) = sums[:5], sums[5:7], sums[7:]
    rows, columns, steps, comb = in_space(movie, float(baseline_adu), np.ascontiguousarray(label), parts)
    mean = s1 / n
    variance = s2 / n - mean**2
    spread = np.maximum(variance, 1e-9)
    third = s3 / n - 3 * mean * s2 / n + 2 * mean**3
    return PixelStatistics(
        n_frames=n,
        mean=mean,
        variance=variance,
        skewness=third / (spread * np.sqrt(spread)),
        step_variance=step / max(n - 1, 1),  # each half holds half of the n − 1 differences
        lag1=_autocovariance(l1, s1, movie, baseline_adu, 1),
        lag2=_autocovariance(l2, s1, movie, baseline_adu, 2),
        right=_inner(right, n) - mean[:-1, :-1] * mean[:-1, 1:],
        below=_inner(below, n) - mean[:-1, :-1] * mean[1:, :-1],
        row_sum=rows,
        column_sum=columns,
        steps=steps,
        comb=comb,
        peak=peak,
        peak_frame=peak_frame.astype(np.int64),
        second=second,
    )


def _autocovariance(products: Array, total: Array, movie: NDArray[np.uint16], baseline_adu: float, lag: int) -> Array:
    """Mean of (v_t − mean)(v_{t−lag} − mean) from the sum of products: edge frames stand in one pair only."""
    n = len(movie)
    if n <= lag:
        return np.zeros_like(total)
    mean = total / n
    edges = (movie[:lag].sum(axis=0) + movie[-lag:].sum(axis=0)) - 2.0 * lag * baseline_adu
    result: Array = (products - mean * (2 * total - edges)) / (n - lag) + mean**2
    return result


def _inner(products: Array, n: int) -> Array:
    return products[:-1, :-1] / n
