"""Baseline and read noise of a movie that is lit everywhere: what dark frames would have told."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.calibrate import histogram
from napari_mufasa.calibrate.histogram import Fit, Histogram
from napari_mufasa.calibrate.law import Law
from napari_mufasa.calibrate.value import NORMAL, Value

Array = NDArray[np.float64]
TRIED = 14  # read noises, from 2 % of the most there can be up to it, and none
CLOSER = 5  # more of them about the upper end of the interval
DARKEST = 4  # groups of pixels, of those of like mean


def level_of_no_variance(zeros: Array, other: float) -> tuple[float, float]:
    """Level (ADU) and its error, such that ± `NORMAL` errors are 95 %.

    zeros : (chunk,) pseudo-values of `transfer.line`; other : the level where nothing is taken off for molecules; the
        distance to it is a doubt of its own (`Light.common`)
    """
    from scipy import stats

    zero, n = float(np.mean(zeros)), len(zeros)
    own = float(np.std(zeros, ddof=1) / np.sqrt(n) * stats.t.ppf(0.975, n - 1) / NORMAL)
    return zero, float(np.hypot(own, zero - other))


def read_noise(
    seen: Histogram, law: Law, zero: tuple[float, float], raw_slope: float, most: float
) -> tuple[Value, float, Fit]:
    """Read noise (ADU), the level of no variance that goes with it, and the law's fit to the darkest pixels.

    The interval is that of the likelihood ratio, with the response and the level of no variance (ADU, with its error)
    fitted at every read noise tried: 0 is in it where the data do not tell it from none, and the upper end is what
    they can hide. `most` : the most that it can have (ADU); `raw_slope` : of variance over mean (ADU), infinite where
    the baseline is known: `zero` is then half a count below it.
    """
    from scipy import optimize

    some = slice(DARKEST)
    darkest = Histogram(
        seen.level_adu[some], seen.offsets_adu[some], seen.edges[some], seen.seen[some], seen.n_mean, seen.phases[some]
    )
    level, error = zero
    first = histogram.fit(
        "light", darkest, replace(law, read_noise_adu=max(0.3 * law.adu_per_electron, 1.0)),
        ("adu_per_electron", "read_noise_adu"), level + 0.5, raw_slope,
    )  # fmt: skip
    widened = first.misfit * (seen.n_mean / (seen.n_mean - 1))  # counts about a mean of their own are fewer
    at = np.array([0.0, 0.0])

    def surprise(read: float, point: Array) -> float:
        made = replace(law, read_noise_adu=read, adu_per_electron=law.adu_per_electron * float(np.exp(point[0])))
        beneath = level + 0.5 + error * point[1] + read**2 / raw_slope
        return histogram.surprise(darkest, made, beneath) / widened + float(point[1]) ** 2 / 2

    def least(read: float) -> tuple[float, Array]:
        simplex = at + np.array([[0.0, 0.0], [0.02, 0.0], [0.0, 0.5]])
        options: dict[str, Any] = {"initial_simplex": simplex, "xatol": 1e-3, "fatol": 0.02, "maxiter": 80}
        found = optimize.minimize(lambda point: surprise(read, point), at, method="Nelder-Mead", options=options)
        return float(found.fun), np.asarray(found.x)

    tried = np.concatenate([[0.0], most * np.geomspace(0.02, 1.0, TRIED)])
    heights = np.empty(len(tried))
    points = np.empty((len(tried), 2))
    for i, read in enumerate(tried):
        heights[i], points[i] = least(float(read))
        at = points[i]
    best = int(np.argmin(heights))
    ends = tried[max(best - 1, 0)], tried[min(best + 1, len(tried) - 1)]
    at = points[best]
    closer = optimize.minimize_scalar(
        lambda read: least(float(read))[0], bounds=ends, method="bounded", options={"maxiter": 8}
    )
    value, height = (float(closer.x), float(closer.fun)) if closer.fun < heights[best] else (tried[best], heights[best])
    height, point = min(height, heights[best]), least(value)[1]
    # All noise of the darkest pixels is a wall: the likelihood may be level up to it, and values tried lie far apart.
    for _ in range(CLOSER):
        beyond = np.flatnonzero((tried > value) & (heights > height + NORMAL**2 / 2))
        if not len(beyond):
            break
        i = int(beyond[0])
        middle = float(max(tried[i - 1], value) + tried[i]) / 2
        tried, heights = np.insert(tried, i, middle), np.insert(heights, i, least(middle)[0])
    low, high = _ends(tried, heights - height, value, most)
    level += error * float(point[1])
    start = replace(
        law, read_noise_adu=max(value, 1e-3), adu_per_electron=law.adu_per_electron * float(np.exp(point[0]))
    )
    fit = histogram.fit("light", darkest, start, ("adu_per_electron",), level + 0.5 + value**2 / raw_slope)
    return Value(float(value), max(high - low, 0.0) / (2 * NORMAL), low, high), level, fit


def _ends(tried: Array, fall: Array, value: float, most: float) -> tuple[float, float]:
    """Where the likelihood's fall from its top, at `value`, reaches that of the interval's ends, on either side.

    In between it is followed by its root, which is straight where the likelihood is normal: tried values lie far apart.
    """
    far = np.sqrt(2 * np.maximum(fall, 0.0))
    lower, upper = np.flatnonzero((tried < value) & (far > NORMAL)), np.flatnonzero((tried > value) & (far > NORMAL))
    low, high = 0.0, most
    if len(lower):
        i = int(lower[-1])
        after = (tried[i + 1], far[i + 1]) if tried[i + 1] < value else (value, 0.0)
        low = float(np.interp(-NORMAL, [-far[i], -after[1]], [tried[i], after[0]]))
    if len(upper):
        i = int(upper[0])
        before = (tried[i - 1], far[i - 1]) if tried[i - 1] > value else (value, 0.0)
        high = float(np.interp(NORMAL, [before[1], far[i]], [before[0], tried[i]]))
    return low, high
