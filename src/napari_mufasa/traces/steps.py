"""Steps in a trace: change points with a stated false-alarm rate (SPEC.md §6).

Binary segmentation: a trace is split where the mean changes most significantly, then its parts. The
statistic of a split after frame k is the difference of the two means in units of its standard error, and
the largest over k is compared with the distribution that the maximum has without any step.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

MIN_SEGMENT = 3  # frames; means of fewer are not near-normal in electron-multiplied noise


@dataclass(frozen=True)
class Steps:
    """Segments of one trace. starts : (segment,) first frame; levels : (segment,) mean."""

    starts: NDArray[np.int64]
    levels: NDArray[np.float64]
    n_frames: int

    @property
    def lengths(self) -> NDArray[np.int64]:
        """(segment,) frames of each segment."""
        return np.diff(np.append(self.starts, self.n_frames))

    @property
    def idealised(self) -> NDArray[np.float64]:
        """(frame,) the level of each frame's segment."""
        return np.repeat(self.levels, self.lengths)


def find_steps(trace: NDArray[np.floating], false_alarm_rate: float = 0.01, min_segment: int = MIN_SEGMENT) -> Steps:
    """Split a trace (frame,) at its significant changes of mean.

    `false_alarm_rate` is the probability that a trace without any step is split at all.
    """
    return idealise(np.asarray(trace)[None], false_alarm_rate, min_segment)[0]


def idealise(
    traces: NDArray[np.floating], false_alarm_rate: float = 0.01, min_segment: int = MIN_SEGMENT
) -> list[Steps]:
    """`find_steps` of every trace (trace, frame)."""
    traces = np.ascontiguousarray(traces, dtype=np.float64)
    n = traces.shape[1]
    # A sub-segment is judged by the critical value of its own length, so that few frames are not over-split.
    lengths = np.unique(np.geomspace(2 * min_segment, max(n, 2 * min_segment + 1), 40).astype(np.int64))
    limits = np.array([critical_value(int(k), false_alarm_rate, min_segment) for k in lengths])
    result = []
    for trace in traces:
        starts = _kernel()(trace, lengths.astype(np.float64), limits, min_segment)
        bounds = np.append(starts, n)
        sums = np.add.reduceat(trace, starts) if n else np.empty(0)
        result.append(Steps(starts, sums / np.diff(bounds), n))
    return result


@cache
def critical_value(n_frames: int, false_alarm_rate: float, min_segment: int = MIN_SEGMENT) -> float:
    """The value that the largest split statistic of n frames of pure noise exceeds with this probability.

    The statistic is a standardised Brownian bridge; its maximum over t₀ ≤ k/n ≤ 1 − t₀ exceeds b with
    probability φ(b)·[(b − 1/b)·2 ln((1 − t₀)/t₀) + 4/b] (Siegmund's approximation), capped by the
    Bonferroni bound over the possible splits, which is the sharper one for short traces.
    """
    from scipy.stats import norm

    t0 = min(min_segment / n_frames, 0.499)
    splits = max(1, n_frames - 2 * min_segment + 1)

    def excess(b: float) -> float:
        bridge = norm.pdf(b) * ((b - 1 / b) * 2 * np.log((1 - t0) / t0) + 4 / b)
        return float(min(bridge, splits * 2 * norm.sf(b)) - false_alarm_rate)

    # Below 1.5 the approximation (of a tail) no longer falls with b.
    return float(optimize.brentq(excess, 1.5, 12.0)) if excess(1.5) > 0 else 1.5


@cache
def _kernel() -> Any:
    import numba

    @numba.njit(cache=True, nogil=True)
    def kernel(trace, lengths, limits, min_segment):  # type: ignore[no-untyped-def]
        n = trace.size
        starts = [0]
        todo = [(0, n)]
        while len(todo) > 0:
            a, b = todo.pop()
            m = b - a
            if m < 2 * min_segment:
                continue
            total, squares = 0.0, 0.0
            for i in range(a, b):
                total += trace[i]
                squares += trace[i] * trace[i]
            best, where = 0.0, -1
            left, left_squares = 0.0, 0.0
            for i in range(a, b - min_segment):
                left += trace[i]
                left_squares += trace[i] * trace[i]
                k = i - a + 1
                if k < min_segment:
                    continue
                mean_l, mean_r = left / k, (total - left) / (m - k)
                within = squares - k * mean_l * mean_l - (m - k) * mean_r * mean_r
                if within <= 0.0:
                    within = 1e-12 * (abs(squares) + 1e-300)
                gap = mean_l - mean_r
                value = gap * gap * k * (m - k) / m / (within / (m - 2))
                if value > best:
                    best, where = value, i + 1
            # Student's heavier tails at few degrees of freedom, turned into a normal deviate.
            df = m - 2.0
            deviate = np.sqrt(df * np.log1p(best / df)) * (1.0 - 0.75 / df) if df > 1 else 0.0
            if where > 0 and deviate > np.interp(float(m), lengths, limits):
                starts.append(where)
                todo.append((a, where))
                todo.append((where, b))
        found = np.array(starts)
        found.sort()
        return found

    return kernel
