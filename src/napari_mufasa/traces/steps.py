"""Steps in a trace: change points with a stated false-alarm rate (docs/traces.md).

Circular binary segmentation (Olshen et al. 2004): in a trace the stretch is looked for whose mean differs most from
that of the rest, so that a short dark interval is found as well as one step; it is cut out where the difference is
beyond chance, then each part is looked at in the same way. The statistic is the difference of the two means in units
of its standard error, and the largest over all stretches is compared with its distribution without any step.
Electron-multiplied noise is skewed, and has short bright stretches by itself: a flash, brighter than what is beside it
and short, is compared with gamma noise of the skewness that the trace shows, at the same false-alarm rate. It has two
frames or more (one alone may be a single hit), and one of two stands out of the single hits, too.
Own loops, because every trace of every simulation of a diagnosis passes them: by `python -m benchmarks.steps` they
find single steps and dark intervals as often as `ruptures`' exact search in half of its time, and split 1 % of
traces of noise where that splits 3 to 5 %; among steps every 25 frames they find 0.87 where it finds 0.92.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy import integrate, optimize
from scipy.special import ndtr

MIN_SEGMENT = 3  # frames; means of fewer are not near-normal in electron-multiplied noise
FLASH = 10  # frames; shorter stretches brighter than those beside them are judged by the skewed noise, which has such


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
    from napari_mufasa.traces.kernels import first_frames

    traces = np.ascontiguousarray(traces, dtype=np.float64)
    n = traces.shape[1]
    # A segment is judged by the limits of its own length, so that few frames are not over-split.
    lengths, stretches, splits = _limits(n, false_alarm_rate, min_segment)
    result = []
    for trace in traces:
        starts = first_frames(trace - trace.mean(), lengths, stretches, splits, min_segment, FLASH)
        sums = np.add.reduceat(trace, starts)
        result.append(Steps(starts, sums / np.diff(np.append(starts, n)), n))
    return result


@cache
def _limits(n_frames: int, false_alarm_rate: float, min_segment: int) -> tuple[NDArray[np.float64], ...]:
    """Lengths of segments, and the deviates that a stretch and a single step must reach in them."""
    lengths = np.unique(np.geomspace(2 * min_segment, max(n_frames, 2 * min_segment + 1), 40).astype(np.int64))
    stretches = [stretch_limit(int(k), false_alarm_rate, min_segment) for k in lengths]
    splits = [step_limit(int(k), false_alarm_rate, min_segment) for k in lengths]
    return lengths.astype(np.float64), np.array(stretches), np.array(splits)


@cache
def stretch_limit(n_frames: int, false_alarm_rate: float, min_segment: int = MIN_SEGMENT) -> float:
    """The deviate that the most different stretch of n frames of pure noise exceeds with this probability.

    Siegmund's approximation for a stretch of t₀ = min_segment/n or more against the rest: the chance to exceed b is
    ½·b³·φ(b)·∫ ν²(b/√(n·t(1 − t)))/(t(1 − t))² dt over t₀ … ½, and no less than that of a single comparison.
    """
    t = np.geomspace(min(min_segment / n_frames, 0.5), 0.5, 300)
    share = t * (1 - t)

    def excess(b: float) -> float:
        x = b / np.sqrt(n_frames * share)
        overshoot = (2 / x) * (ndtr(x / 2) - 0.5) / (x / 2 * ndtr(x / 2) + np.exp(-(x**2) / 8) / np.sqrt(2 * np.pi))
        area = integrate.trapezoid((overshoot / share) ** 2, t)
        density = np.exp(-(b**2) / 2) / np.sqrt(2 * np.pi)
        return float(max(0.5 * b**3 * density * area, 2 * ndtr(-b)) - false_alarm_rate)

    # Below 1.5 the approximation (of a tail) no longer falls with b.
    return float(optimize.brentq(excess, 1.5, 12.0)) if excess(1.5) > 0 else 1.5


@cache
def step_limit(n_frames: int, false_alarm_rate: float, min_segment: int = MIN_SEGMENT) -> float:
    """The deviate that the most different two parts of n frames of pure noise exceed with this probability.

    The statistic is a standardised Brownian bridge; its maximum over t₀ ≤ k/n ≤ 1 − t₀ exceeds b with
    probability φ(b)·[(b − 1/b)·2 ln((1 − t₀)/t₀) + 4/b] (Siegmund's approximation), capped by the
    Bonferroni bound over the possible splits, which is the sharper one for short traces.
    """
    t0 = min(min_segment / n_frames, 0.499)
    splits = max(1, n_frames - 2 * min_segment + 1)

    def excess(b: float) -> float:
        bridge = np.exp(-(b**2) / 2) / np.sqrt(2 * np.pi) * ((b - 1 / b) * 2 * np.log((1 - t0) / t0) + 4 / b)
        return float(min(bridge, splits * 2 * ndtr(-b)) - false_alarm_rate)

    # Below 1.5 the approximation (of a tail) no longer falls with b.
    return float(optimize.brentq(excess, 1.5, 12.0)) if excess(1.5) > 0 else 1.5
