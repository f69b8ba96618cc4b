"""Where molecules are: a matched filter over several times, a threshold, local maxima (SPEC.md §6).

A molecule may be lit all the time, late, or for a few frames. Each pixel's evidence is the largest
signal-to-noise ratio of a spot-shaped signal over three time scales: short blocks, five short blocks, the
whole movie. The noise of each scale is measured from differences of successive blocks, so that structure
that does not move in time (uneven light, fixed patterns) is not mistaken for noise.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from napari_mufasa.camera.frames import Frames, Stack
from napari_mufasa.errors import MufasaError

Threshold = Literal["sigma", "percentile", "otsu", "triangle"]
Image = NDArray[np.float32]
SHORT_BLOCKS = 200  # at most this many short blocks per movie: bounds the time detection takes
MIDDLE = 5  # short blocks in a middle block
BACKGROUND_WIDTH = 2.0  # the filter's negative lobe is this much wider than its centre


def spot_filter(images: Stack, sigma_px: float) -> Stack:
    """Zero-mean matched filter of a Gaussian spot over the last two axes: narrow minus wide blur."""
    axes = (images.ndim - 2, images.ndim - 1)
    narrow = ndimage.gaussian_filter(images, sigma_px, axes=axes, truncate=3.0)
    wide = ndimage.gaussian_filter(images, BACKGROUND_WIDTH * sigma_px, axes=axes, truncate=2.5)
    result: Stack = narrow - wide
    return result


def border_noise(shape_px: tuple[int, int], sigma_px: float) -> Image:
    """(y, x) noise sd of the filter relative to the middle of the field: larger where it reflects at the border.

    The filter is a difference of two separable ones, so the variance of filtered white noise is a sum of
    products of one-dimensional sums of squared weights.
    """
    products = []
    for n in shape_px:
        one = np.eye(n)
        narrow = ndimage.gaussian_filter1d(one, sigma_px, axis=0, truncate=3.0)
        wide = ndimage.gaussian_filter1d(one, BACKGROUND_WIDTH * sigma_px, axis=0, truncate=2.5)
        products.append([(a * b).sum(axis=1) for a, b in ((narrow, narrow), (narrow, wide), (wide, wide))])
    (yn, ym, yw), (xn, xm, xw) = products
    variance = np.outer(yn, xn) - 2 * np.outer(ym, xm) + np.outer(yw, xw)
    relative = variance / variance[shape_px[0] // 2, shape_px[1] // 2]
    return np.asarray(np.sqrt(relative), dtype=np.float32)


def significance(
    frames: Frames,
    sigma_px: float,
    *,
    block: int | None = None,
    drift_px: NDArray[np.float64] | None = None,
    report: Callable[[int], None] | None = None,
    cancel: Callable[[], bool] | None = None,
) -> tuple[Image, Image, Image]:
    """Evidence of a spot at each pixel, in noise sd, and the filtered images of the first and last fifth, each (y, x).

    `block` frames make a short block (None: at most `SHORT_BLOCKS` of them). `drift_px` (frame, 2) is undone.
    """
    shape = frames.shape[1:]
    block = block or max(1, -(-frames.n_frames // SHORT_BLOCKS))
    total, steps = np.zeros(shape, np.float64), np.zeros(shape, np.float64)
    early, late = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    shortest, middle = np.full(shape, -np.inf, np.float32), np.full(shape, -np.inf, np.float32)
    recent: list[Image] = []
    before: Image | None = None
    n_blocks = 0
    for start, stack in frames.blocks(block, report, cancel):
        usable = len(stack) // block * block
        if usable == 0:
            continue
        means = stack[:usable].reshape(-1, block, *shape).mean(axis=1)
        if drift_px is not None:
            for i in range(len(means)):
                shift = drift_px[start + i * block : start + (i + 1) * block].mean(axis=0)
                means[i] = ndimage.shift(means[i], -shift, order=1, mode="nearest")
        for i, image in enumerate(spot_filter(means, sigma_px)):
            total += image
            if start + i * block < frames.n_frames / 5:
                early += image
            elif start + (i + 1) * block > frames.n_frames * 4 / 5:
                late += image
            np.maximum(shortest, image, out=shortest)
            if before is not None:
                steps += (image - before) ** 2
            before = image
            recent = [*recent, image][-MIDDLE:]
            if len(recent) == MIDDLE:
                np.maximum(middle, sum(recent) / np.float32(MIDDLE), out=middle)
            n_blocks += 1
    whole = (total / n_blocks).astype(np.float32)
    if n_blocks < 3:  # too short for differences in time: noise from the spread in space
        noise = np.full(shape, _lower_spread(whole), np.float32)
        return (whole / np.maximum(noise, 1e-12)).astype(np.float32), early, late
    noise = np.sqrt(_smooth_floor(steps / (2 * (n_blocks - 1)))).astype(np.float32)
    noise *= border_noise((shape[0], shape[1]), sigma_px)
    # Static structure that is no molecule (uneven light, fixed pattern) limits the long average.
    whole_noise = np.maximum(noise / np.sqrt(n_blocks), np.float32(_lower_spread(whole)))
    scales = [(shortest, noise), (whole, whole_noise)]
    if n_blocks >= MIDDLE:
        scales.insert(1, (middle, noise / np.float32(np.sqrt(MIDDLE))))
    best = np.maximum.reduce([image / np.maximum(sd, 1e-12) for image, sd in scales])
    return best.astype(np.float32), early, late


def candidates(
    image: Image, sigma_px: float, *, method: Threshold = "sigma", value: float | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Local maxima of a significance image above a threshold.

    method : "sigma": `value` (6) noise sd, and as many robust sd above the image's own background, so that
        heavy-tailed noise (electron multiplication) raises no false candidates; "percentile": `value` (98)
        of the pixels lie below; "otsu", "triangle": from the histogram.

    Returns positions (candidate, 2), significance (candidate,), and the threshold used.
    """
    from skimage.feature import peak_local_max

    level = threshold_level(image, method, value)
    distance = max(1, round(sigma_px))
    peaks = peak_local_max(  # type: ignore[no-untyped-call]
        image, min_distance=distance, threshold_abs=level, exclude_border=False
    )
    if len(peaks) == 0:
        return np.empty((0, 2)), np.empty(0), level
    return peaks + _parabola(image, peaks), image[tuple(peaks.T)].astype(float), level


def threshold_level(image: Image, method: Threshold, value: float | None) -> float:
    from skimage import filters

    if method == "sigma":
        k = 6.0 if value is None else float(value)
        if k <= 0:
            raise MufasaError(f"threshold = {k}: the number of noise sd must be above 0")
        return max(k, float(np.median(image)) + k * _lower_spread(image))
    if method == "percentile":
        p = 98.0 if value is None else float(value)
        if not 0 <= p <= 100:
            raise MufasaError(f"threshold = {p}: a percentile lies in 0 … 100")
        return float(np.percentile(image, p))
    if method == "otsu":
        return float(filters.threshold_otsu(image))  # type: ignore[no-untyped-call]
    if method == "triangle":
        return float(filters.threshold_triangle(image))  # type: ignore[no-untyped-call]
    raise MufasaError(f"threshold method {method!r} is unknown: choose sigma, percentile, otsu or triangle")


def prominence(image: Image, positions_px: NDArray[np.float64], sigma_px: float) -> NDArray[np.float64]:
    """How much of a peak stands out in every direction, (candidate,): near 0.6 for a spot, 0 along an edge.

    The peak minus the mean of two opposite points 2 σ away, in the least favourable of four directions,
    relative to the peak: an edge or a filament has one direction in which it goes on.
    """

    def at(points: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(ndimage.map_coordinates(image, points.T, order=1, mode="nearest"), dtype=np.float64)

    peak = at(positions_px)
    angles = np.arange(4) * np.pi / 4
    steps = 2 * sigma_px * np.stack([np.sin(angles), np.cos(angles)], axis=1)
    drops = [peak - 0.5 * (at(positions_px + step) + at(positions_px - step)) for step in steps]
    return np.asarray(np.min(drops, axis=0) / np.maximum(peak, 1e-12))


def _parabola(image: Image, peaks: NDArray[np.int64]) -> NDArray[np.float64]:
    """Sub-pixel offset of a maximum from the parabola through it and its neighbours, at most half a pixel."""
    padded = np.pad(image.astype(float), 1, mode="edge")
    y, x = peaks.T + 1
    offsets = np.zeros(peaks.shape)
    for axis, (dy, dx) in enumerate(((1, 0), (0, 1))):
        low, mid, high = padded[y - dy, x - dx], padded[y, x], padded[y + dy, x + dx]
        bend = low - 2 * mid + high
        offset = np.divide(0.5 * (low - high), bend, out=np.zeros(len(peaks)), where=bend < 0)
        offsets[:, axis] = np.clip(offset, -0.5, 0.5)
    return offsets


def _lower_spread(image: NDArray[np.floating]) -> float:
    """Robust sd from the lower half, which spots do not reach."""
    low, middle = np.percentile(image, [15.87, 50])
    return float(middle - low)


def _smooth_floor(variance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Noise variance as a smooth map: medians over tiles, so that spots (a minority) do not count."""
    tile = 16
    rows, columns = (max(1, n // tile) for n in variance.shape)
    grid = np.array(
        [[np.median(t) for t in np.array_split(band, columns, axis=1)] for band in np.array_split(variance, rows)]
    )
    grid = ndimage.median_filter(grid, 3, mode="nearest")
    zoom = [n / g for n, g in zip(variance.shape, grid.shape, strict=True)]
    smooth = ndimage.zoom(grid, zoom, order=1, mode="nearest", grid_mode=True)
    return np.asarray(np.maximum(smooth, 1e-12))


def estimate_sigma_px(frames: Frames, n_spots: int = 40) -> float | None:
    """PSF sd in px measured on the brightest isolated spots of the movie's beginning; None without spots.

    A spot of width σ answers blur(s) − blur(s') with 1/(σ²+s²) − 1/(σ²+s'²): σ is the width whose answers
    over all scales are most nearly parallel to those of the spots.
    """
    n = min(frames.n_frames, max(1, min(50, frames.block_frames())))
    image = frames.photoelectrons(np.asarray(frames.movie[:n])).mean(axis=0)
    scales = np.array([0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6])
    blurs = [ndimage.gaussian_filter(image, s) for s in [*scales, scales[-1] * np.sqrt(2)]]
    responses = np.stack([(a - b) * s**2 for a, b, s in zip(blurs, blurs[1:], scales, strict=False)])
    noise = np.array([_lower_spread(r) for r in responses])
    ratio = responses / np.maximum(noise, 1e-12)[:, None, None]
    best = ratio.max(axis=0)
    positions, strength, _ = candidates(best, 1.4)
    if len(positions) == 0:
        return None
    brightest = np.rint(positions[np.argsort(-strength)[:n_spots]]).astype(int)
    chosen = np.clip(brightest, 0, np.array(image.shape) - 1)
    curves = np.median(responses[:, chosen[:, 0], chosen[:, 1]] / scales[:, None] ** 2, axis=1)
    widths = np.geomspace(0.5, 8.0, 200)
    steps = np.append(scales, scales[-1] * np.sqrt(2))
    models = 1 / (widths[:, None] ** 2 + steps[:-1] ** 2) - 1 / (widths[:, None] ** 2 + steps[1:] ** 2)
    models /= np.linalg.norm(models, axis=1, keepdims=True)
    return float(widths[np.argmax(models @ curves)])
