"""Photon transfer: variance in time against mean, pixel by pixel, and the line through them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.calibrate.value import NORMAL, Value
from napari_mufasa.errors import MufasaError

Array = NDArray[np.float64]
BINS = 30
LARGE_PX = 1000  # pixels of a frame whose mean takes no noise of single ones along
QUIET_PX = 15  # window of the background that spots are told from
QUIET_SD = 3.0
LEVELS = 8  # of the background, each with a spread of its own
RUN = 8  # frames whose mean shows slow changes
LEAST_RUNS = 5
COURSE_SD = 4.0
LEAST_RANGE = 0.005  # rms of the light over its level, below which pixels' own sensitivity looks the same
STEADY_SD = 6.0  # sample variances are skewed: a closer cut would take more from above than from below


def second_differences(chunk: NDArray[np.float32]) -> NDArray[np.float32]:
    """(frame − 2, y, x): they take a steady change of light out as well as the pixels' patterns; var = mean(d²)/6.

    What all pixels of a large frame have in common (an alternating baseline, a flickering lamp) is taken off, too.
    """
    found = chunk[2:] - 2 * chunk[1:-1] + chunk[:-2]
    if found[0].size >= LARGE_PX:
        found -= found.mean(axis=(1, 2), keepdims=True)
    return np.asarray(found, np.float32)


def photon_transfer(chunks: Sequence[NDArray[np.float32]]) -> tuple[Array, Array]:
    """Mean and variance of every pixel in every chunk, each (chunk, y, x)."""
    means = [chunk.mean(axis=0, dtype=np.float64) for chunk in chunks]
    variances = [(second_differences(chunk) ** 2).mean(axis=0, dtype=np.float64) / 6 for chunk in chunks]
    return np.array(means), np.array(variances)


def steady_pixels(means: Array, variances: Array) -> NDArray[np.bool_]:
    """(pixel,) True where the variance over the whole movie is like that of pixels with the same mean.

    Blinking, bleaching and moving molecules add variance of their own. They are flagged on the whole movie,
    where the variance of a pixel is well known, so that the parts of the movie can then be averaged plainly:
    a median over pixels with few frames each would be too low, the sample variance being skewed.
    """
    mean, variance = means.mean(axis=0), variances.mean(axis=0)
    if len(mean) < 40:
        return np.ones(len(mean), dtype=bool)
    steady = np.zeros(len(mean), dtype=bool)
    for members in bins_of(mean):
        middle = np.median(variance[members])
        spread = 1.4826 * np.median(np.abs(variance[members] - middle))
        steady[members] = np.abs(variance[members] - middle) <= STEADY_SD * spread
    return steady


def quiet_pixels(mean: Array) -> NDArray[np.bool_]:
    """(y, x) True where no spot stands above its surroundings, nor beside."""
    from scipy import ndimage

    if min(mean.shape) < 2 * QUIET_PX:
        return np.ones(mean.shape, dtype=bool)
    level = ndimage.median_filter(mean, QUIET_PX, mode="nearest")
    above = mean - level
    # Brighter parts of the field are noisier: what is much in the dark is nothing there. Neighbours tell noise from
    # what is broader.
    rough = np.abs(np.diff(mean, axis=0, append=mean[-2:-1])) / np.sqrt(2)
    spread = np.empty_like(mean)
    for members in np.array_split(np.argsort(level, axis=None), LEVELS):
        spread.flat[members] = 1.4826 * np.median(rough.flat[members])
    # A spot is broad: single pixels that stick out by chance or by pattern are no spots.
    spots = ndimage.uniform_filter(above, 3) > QUIET_SD / 2 * spread
    return np.asarray(~ndimage.binary_dilation(spots, iterations=2))


def constant_pixels(chunks: Sequence[NDArray[np.float32]], variance: Array) -> NDArray[np.bool_]:
    """(y, x) True where the light has the course of the whole field: no molecule came by or went out.

    Means of `RUN` frames are compared with what noise of `variance` (y, x) leaves of them beside that course.
    """
    from scipy import ndimage

    runs = [chunk[: len(chunk) // RUN * RUN] for chunk in chunks]
    runs = [run.reshape(-1, RUN, *run.shape[1:]).mean(axis=1, dtype=np.float64) for run in runs if len(run)]
    means = np.concatenate(runs) if runs else np.empty((0, *variance.shape))
    if len(means) < LEAST_RUNS:
        return np.ones(variance.shape, dtype=bool)
    course = np.median(means, axis=(1, 2))
    course -= course.mean()
    about = means - means.mean(axis=0)
    if np.any(course):
        about -= course[:, None, None] * (np.einsum("f,fyx->yx", course, about) / np.sum(course**2))
    beyond = np.mean(about**2, axis=0) * RUN / np.maximum(variance, 1e-9)
    beyond = ndimage.uniform_filter(beyond, 3, mode="nearest")
    middle = float(np.median(beyond))
    return np.asarray(beyond < middle + COURSE_SD * 1.4826 * float(np.median(np.abs(beyond - middle))))


def bins_of(mean: Array) -> list[NDArray[np.int64]]:
    """Pixels grouped by their mean."""
    return np.array_split(np.argsort(mean), min(BINS, max(1, len(mean) // 20)))


def curve(signal: Array, variance: Array) -> tuple[Array, Array]:
    """Mean signal and mean variance of each bin."""
    bins = bins_of(signal)
    return np.array([signal[b].mean() for b in bins]), np.array([variance[b].mean() for b in bins])


def slopes_through_origin(signals: Array, variances: Array) -> list[float]:
    """Of each chunk (chunk, pixel) variance over signal of the lit pixels together: a ratio of sums has no bias by the
    noise of single pixels, nor has their choice, which is by what the *other* chunks say of their light."""
    found, together = [], signals.sum(axis=0)
    for signal, variance in zip(signals, variances, strict=True):
        light = together - signal if len(signals) > 1 else np.ones_like(signal)
        lit = light > 0.2 * np.percentile(light, 90)
        total = float(signal[lit].sum())
        found.append(float(variance[lit].sum()) / total if total > 0 else float("nan"))
    return found


def mean_of(slopes: Sequence[float], relative_doubt: float, counts_each: int) -> Value:
    """The mean of the chunks' slopes with its 95 % interval; `relative_doubt`: what all of them share; `counts_each`:
    how many counts a chunk has, which tells its error where there is but one."""
    from scipy import stats

    found = np.array([s for s in slopes if np.isfinite(s)])
    if len(found) == 0 or np.median(found) <= 0:
        raise MufasaError(
            "the variance does not grow with the signal: the movie is dark, saturated or already processed; "
            "give raw frames under light"
        )
    value = float(found.mean())
    # A variance of n second differences has 2 · 1.94 / n of its square, half as much again for the counts' long tail.
    own = value * np.sqrt(2 * 1.94 * 1.5 / counts_each)
    own = float(found.std(ddof=1) / np.sqrt(len(found))) if len(found) > 1 else own
    reach = float(stats.t.ppf(0.975, len(found) - 1)) if len(found) > 1 else NORMAL
    shared = abs(value) * relative_doubt
    sd, far = float(np.hypot(own, shared)), float(np.hypot(reach * own, NORMAL * shared))
    return Value(value, sd, value - far, value + far)


def line(means: Array, variances: Array) -> tuple[Array, Array]:
    """Slope, and the level (ADU) at which a line of variance against mean has no variance, each as (chunk,) jackknife
    pseudo-values: their mean is the estimate, their spread over √chunks its error (pixels as for `photon_transfer`,
    flattened).

    The noise of a pixel's mean and that of its variance go together as third to second moment: behind an EM register
    that is a line of slope 3 g where the light's is 2 g. Pixels are therefore set apart by what the *other* chunks say
    of their light (an instrumental variable): no noise of their own is in it to bend or to flatten the line.
    """
    n = len(means)
    if n < 2:
        raise MufasaError("too few lit frames to tell the baseline without dark frames: record more, or dark frames")
    sums = np.array([_about_line(means, variances, k) for k in range(n)])
    grown = sums[:, 0]
    real = np.sqrt(max(grown.sum() / sums[:, 2].sum(), 0.0))  # rms of the pixels' true light about its mean
    level = sums[:, 3].sum() / sums[:, 2].sum()
    if grown.mean() < 5 * grown.std(ddof=1) / np.sqrt(n) or real < LEAST_RANGE * abs(level) or sums[:, 1].sum() <= 0:
        raise MufasaError(
            "without dark frames the light must differ between pixels, and here it does not: "
            "record dark frames (shutter closed), or give the dark level (baseline_adu)"
        )
    whole = _line_of(sums.sum(axis=0))
    without = np.array([_line_of(sums.sum(axis=0) - one) for one in sums])
    slopes, levels = (n * np.array(whole) - (n - 1) * without).T
    return slopes, levels


def _about_line(means: Array, variances: Array, k: int) -> Array:
    """Weighted sums over pixels in chunk k: light · mean, light · variance, 1, mean, variance; light: by the others."""
    light, level = (np.delete(a, k, axis=0).mean(axis=0) for a in (means, variances))
    weights = np.empty(len(light))
    for members in bins_of(light):
        weights[members] = 1 / max(level[members].mean(), 1e-9) ** 2  # a variance is known to a share of itself
    light = light - np.average(light, weights=weights)
    return np.array(
        [np.sum(weights * a) for a in (light * means[k], light * variances[k], 1.0, means[k], variances[k])]
    )


def _line_of(sums: Array) -> tuple[float, float]:
    slope = float(sums[1] / sums[0])
    return slope, float((sums[3] - sums[4] / slope) / sums[2])
