"""Statistics of every pixel, in two passes over the movie.

Everything here is plain counting; `summary` turns it into named observables. Pixels carry a label: 0 spots
and their surroundings, 1 … background of a part of the field, so that parts can be summarised apart.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
NONE_YET = -1e300
COMB = 8  # counts are also looked at modulo this, to see coarse or merged digits


@dataclass(frozen=True)
class PixelStatistics:
    """Per pixel (y, x) unless said otherwise; ADU above the baseline, variances in ADU².

    mean, variance, skewness : over all frames
    step_variance (half, y, x) : half the mean squared difference of successive frames, in each half of the movie
    lag1, lag2 : autocovariance over frames
    right, below (y − 1, x − 1) : covariance with the next pixel along x and y
    row_sum (part, frame, y), column_sum (part, frame, x) : sums over the labelled pixels
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
    comb: NDArray[np.int64]
    peak: Array
    peak_frame: NDArray[np.int64]
    second: Array


def block_means(movie: NDArray[Any], n_blocks: int) -> NDArray[np.float32]:
    """(block, y, x) means over successive, nearly equal blocks of frames."""
    edges = np.linspace(0, len(movie), n_blocks + 1).round().astype(int)
    return np.stack([movie[a:b].mean(axis=0, dtype=np.float32) for a, b in itertools.pairwise(edges)])


def pixel_statistics(
    movie: NDArray[np.uint16], baseline_adu: float, label: NDArray[np.int8], parts: int
) -> PixelStatistics:
    """Two passes over (frame, y, x); `label` is (y, x) with values 0 … parts."""
    n = len(movie)
    in_time, in_space = _kernels()
    s1, s2, s3, step, l1, l2, right, below, peak, peak_frame, second = in_time(movie, float(baseline_adu))
    rows, columns, comb = in_space(movie, float(baseline_adu), np.ascontiguousarray(label), parts)
    mean = s1 / n
    variance = s2 / n - mean**2
    third = s3 / n - 3 * mean * s2 / n + 2 * mean**3
    return PixelStatistics(
        n_frames=n,
        mean=mean,
        variance=variance,
        skewness=third / np.maximum(variance, 1e-9) ** 1.5,
        step_variance=step / max(n - 1, 1),  # each half holds half of the n − 1 differences
        lag1=_autocovariance(l1, s1, movie, baseline_adu, 1),
        lag2=_autocovariance(l2, s1, movie, baseline_adu, 2),
        right=_inner(right, n) - mean[:-1, :-1] * mean[:-1, 1:],
        below=_inner(below, n) - mean[:-1, :-1] * mean[1:, :-1],
        row_sum=rows,
        column_sum=columns,
        comb=comb,
        peak=peak,
        peak_frame=peak_frame,
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


@cache
def _kernels() -> tuple[Any, Any]:
    import numba

    @numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
    def rank(now, t, peak, at, second):  # type: ignore[no-untyped-def]
        """Take frame t of a row into its largest values and the next largest; neither next to the other in time."""
        for x in range(now.size):
            v, top = now[x], peak[x]
            apart = t - at[x] > 1.0
            overtaken = top if apart or at[x] == 0.0 else NONE_YET
            beside = v if apart else NONE_YET
            second[x] = max(second[x], overtaken if v > top else beside)
            peak[x] = max(top, v)
            at[x] = t if v > top else at[x]

    @numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
    def in_time(movie, baseline):  # type: ignore[no-untyped-def]
        """Row by row through all frames, so that a row's sums stay close to the processor."""
        n, height, width = movie.shape
        shape = (height, width)
        s1, s2, s3 = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        step, l1, l2 = np.zeros((2, height, width)), np.zeros(shape), np.zeros(shape)
        right, below = np.zeros(shape), np.zeros(shape)
        peak, second = np.full(shape, NONE_YET), np.full(shape, NONE_YET)
        peak_frame = np.zeros(shape)
        now, before, earlier, next_row = np.zeros(width), np.zeros(width), np.zeros(width), np.zeros(width)
        for y in range(height):
            before[:], earlier[:] = 0.0, 0.0
            for t in range(n):
                # Without branches, so that these loops become vector instructions.
                for x in range(width):
                    now[x] = movie[t, y, x] - baseline
                for x in range(width):
                    v = now[x]
                    s1[y, x] += v
                    s2[y, x] += v * v
                    s3[y, x] += v * v * v
                for x in range(width):
                    v = now[x]
                    l1[y, x] += v * before[x]
                    l2[y, x] += v * earlier[x]
                for x in range(width - 1):
                    right[y, x] += now[x] * now[x + 1]
                if y + 1 < height:
                    for x in range(width):
                        next_row[x] = movie[t, y + 1, x] - baseline
                    for x in range(width):
                        below[y, x] += now[x] * next_row[x]
                if t > 0:
                    half = 2 * t // n
                    for x in range(width):
                        difference = now[x] - before[x]
                        step[half, y, x] += difference * difference
                rank(now, float(t), peak[y], peak_frame[y], second[y])
                now, before, earlier = earlier, now, before
        return s1, s2, s3, step, l1, l2, right, below, peak, peak_frame.astype(np.int64), second

    @numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
    def in_space(movie, baseline, label, parts):  # type: ignore[no-untyped-def]
        """Frame by frame: sums over rows and columns of each part, and its digits."""
        n, height, width = movie.shape
        rows, columns = np.zeros((parts + 1, n, height)), np.zeros((parts + 1, n, width))
        comb = np.zeros((4, parts + 1, COMB), dtype=np.int64)  # neighbours count apart: none waits for another
        mine = np.zeros((parts + 1, height, width))
        for part in range(parts + 1):
            mine[part] = label == part
        value = np.empty(width)
        for t in range(n):
            for y in range(height):
                for x in range(width):
                    value[x] = movie[t, y, x] - baseline
                for part in range(parts + 1):
                    total = 0.0
                    for x in range(width):
                        v = mine[part, y, x] * value[x]
                        columns[part, t, x] += v
                        total += v
                    rows[part, t, y] = total
                for x in range(width):
                    comb[x & 3, label[y, x], movie[t, y, x] % COMB] += 1
        return rows, columns, comb.sum(axis=0)

    return in_time, in_space
