"""Photon transfer: variance in time against mean, pixel by pixel, and the line through them."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.calibrate.dark import counts
from napari_mufasa.calibrate.value import Value
from napari_mufasa.errors import Cancelled, MufasaError

CHUNKS = 10  # parts of the movie whose spread gives the uncertainties
CHUNK_BYTES = 2**27  # of each at most, as float32
BINS = 30


def photon_transfer(
    movie: Any, first: int, progress: Callable[[int, int], None] | None, cancel: Callable[[], bool] | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and variance of every pixel in every chunk of the movie, each (chunk, pixel)."""
    edges = np.linspace(first, movie.shape[0], CHUNKS + 1).astype(int)
    if edges[1] - edges[0] < 4:
        edges = np.array([first, movie.shape[0]])
    means, variances = [], []
    for i, (start, stop) in enumerate(itertools.pairwise(edges)):
        if cancel is not None and cancel():
            raise Cancelled
        most = max(4, CHUNK_BYTES // (4 * movie.shape[1] * movie.shape[2]))
        stack = counts(movie[start : min(stop, start + most)], "the movie's frames").astype(np.float32)
        if len(stack) < 4:
            continue
        # Second differences take a steady change of light out as well: var = mean(d²)/6.
        second = stack[2:] - 2 * stack[1:-1] + stack[:-2]
        means.append(stack.mean(axis=0, dtype=np.float64).ravel())
        variances.append((second**2).mean(axis=0, dtype=np.float64).ravel() / 6)
        if progress is not None:
            progress(i + 1, len(edges) - 1)
    if not means:
        raise MufasaError("fewer than 4 lit frames: record more frames under light")
    return np.array(means), np.array(variances)


def steady_pixels(means: NDArray[np.float64], variances: NDArray[np.float64]) -> NDArray[np.bool_]:
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
        steady[members] = np.abs(variance[members] - middle) <= 3 * spread
    return steady


def bins_of(mean: NDArray[np.float64]) -> list[NDArray[np.int64]]:
    """Pixels grouped by their mean."""
    return np.array_split(np.argsort(mean), min(BINS, max(1, len(mean) // 20)))


def curve(
    signal: NDArray[np.float64], variance: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean signal and mean variance of each bin."""
    bins = bins_of(signal)
    return np.array([signal[b].mean() for b in bins]), np.array([variance[b].mean() for b in bins])


def slope_through_origin(signal: NDArray[np.float64], variance: NDArray[np.float64]) -> float:
    """Slope through the origin: the median over bins of variance over signal."""
    x, y = curve(signal, variance)
    lit = x > 0.2 * np.percentile(x, 90)
    return float(np.median(y[lit] / x[lit])) if lit.any() else float("nan")


def line(
    means: NDArray[np.float64], variances: NDArray[np.float64], n_frames: int, read_noise: float, notes: list[str]
) -> tuple[Value, NDArray[np.float64]]:
    """Baseline and slope from a robust line of variance against mean, chunk by chunk."""
    from scipy.stats import theilslopes

    fits = []
    # Pixels are grouped by their mean over the whole movie: grouped by the noise of a part of it, the noise
    # itself would look like light.
    overall = means.mean(axis=0)
    own_noise = np.sqrt(variances.mean() / n_frames)
    bins = bins_of(overall) if np.std(overall) > 2 * own_noise else []
    for m, v in zip(means, variances, strict=True):
        x, y = np.array([m[b].mean() for b in bins]), np.array([v[b].mean() for b in bins])
        if len(x) == 0:
            break
        keep = x <= np.percentile(x, 90)  # the brightest bins hold the molecules, which blink
        if keep.sum() < 5 or np.ptp(x[keep]) < 0.02 * abs(x[keep].mean()):
            continue
        slope, intercept = theilslopes(y[keep], x[keep])[:2]
        fits.append((float(slope), -(float(intercept) - read_noise**2) / float(slope) if slope else float("nan")))
    if not fits:
        raise MufasaError(
            "without dark frames the light must differ between pixels, and here it does not: "
            "record dark frames (shutter closed), or give baseline_adu (--baseline-adu)"
        )
    slopes, baselines = np.array(fits).T
    notes.append("baseline extrapolated to zero variance: dark frames would be far more certain")
    return Value(float(np.median(baselines)) + 0.5, float(np.std(baselines) / np.sqrt(len(baselines)))), slopes
