"""The filter that answers to a spot, and how uneven what it leaves is (docs/traces.md)."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from napari_mufasa.camera.frames import Stack
from napari_mufasa.spots.quantiles import quantiles

Image = NDArray[np.float32]
BACKGROUND_WIDTH = 2.0  # the filter's negative lobe is this much wider than its centre
NARROW_REACH, WIDE_REACH = 3.0, 2.5  # where the two blurs end, in their own sd


def spot_filter(images: Stack, sigma_px: float) -> Stack:
    """Zero-mean matched filter of a Gaussian spot for images (image, y, x): narrow minus wide blur.

    Own loops because hundreds of images pass it in every simulation of a diagnosis: four times faster than two
    of SciPy's `gaussian_filter` on 150 images of 96 × 96 pixels.
    """
    from napari_mufasa.spots import kernels

    narrow, wide = _weights(sigma_px)
    rows, columns = (np.pad(np.arange(n), len(wide) - 1, mode="symmetric") for n in images.shape[1:])
    images = np.ascontiguousarray(images, dtype=np.float32)
    filtered: Stack = kernels.spot_filter(images, narrow.astype(np.float32), wide.astype(np.float32), rows, columns)
    return filtered


def _weights(sigma_px: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Halves of the narrow and the wide blur's weights, centre first."""
    halves = []
    for sd, reach in ((sigma_px, NARROW_REACH), (BACKGROUND_WIDTH * sigma_px, WIDE_REACH)):
        weights = np.exp(-0.5 * (np.arange(int(reach * sd + 0.5) + 1) / sd) ** 2)
        halves.append(weights / (2 * weights.sum() - weights[0]))
    return halves[0], halves[1]


@lru_cache(maxsize=8)  # each as large as a frame, and each width of a PSF has its own
def border_noise(shape_px: tuple[int, int], sigma_px: float) -> Image:
    """(y, x) noise sd of the filter relative to the middle of the field: larger where it reflects at the border.

    The filter is a difference of two separable ones, so the variance of filtered white noise is a sum of
    products of one-dimensional sums of squared weights.
    """
    products = []
    for n in shape_px:
        narrow, wide = (
            ndimage.correlate1d(np.eye(n), np.concatenate([half[:0:-1], half]), axis=0) for half in _weights(sigma_px)
        )
        products.append([(a * b).sum(axis=1) for a, b in ((narrow, narrow), (narrow, wide), (wide, wide))])
    (yn, ym, yw), (xn, xm, xw) = products
    variance = np.outer(yn, xn) - 2 * np.outer(ym, xm) + np.outer(yw, xw)
    relative = variance / variance[shape_px[0] // 2, shape_px[1] // 2]
    return np.asarray(np.sqrt(relative), dtype=np.float32)


def lower_spread(image: NDArray[np.floating]) -> float:
    """Robust sd from the lower half, which spots do not reach."""
    low, middle = quantiles(image.ravel(), [0.1587, 0.5])
    return float(middle - low)
