"""Position, width and elongation of spots from their lit image, all spots at once (docs/traces.md)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.camera.frames import Stack
from napari_mufasa.spots.aperture import Aperture, Reading


@dataclass(frozen=True)
class Shapes:
    """shift_px : (spot, 2) refined minus given position; sigma_px : (spot, 2) narrow and wide axis."""

    shift_px: NDArray[np.float64]
    sigma_px: NDArray[np.float64]


def light_around(traces: NDArray[np.float32]) -> NDArray[np.float32]:
    """(spot, frame) mean signal in the frames before and after, none below 0; of a single frame its own."""
    near = np.zeros_like(traces)
    if traces.shape[1] > 1:
        near[:, 1:] += traces[:, :-1]
        near[:, :-1] += traces[:, 1:]
        near[:, 1:-1] *= 0.5
    else:
        near += traces
    return np.maximum(near, 0.0)


class LitImages:
    """Accumulates, block by block, each molecule's image over the frames in which it shines.

    A frame counts with the molecule's mean signal in the frames before and after, never its own: so the
    noise of the image is independent of its weight and does not draw the position towards the first guess. The slope
    of the background is taken off, which would draw it uphill; what would fall below no light within the window (the
    corner of a margin of zeros) is none.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self.images = np.zeros(shape)
        self.weight = np.zeros(shape[0])
        self.offsets = np.zeros((*shape, 2))
        self.inside = np.ones(shape, dtype=bool)

    def add(
        self, opening: Aperture | Reading, stack: Stack, near: NDArray[np.float32], backgrounds: NDArray[np.float32]
    ) -> None:
        """near : (spot, frame) see `light_around`"""
        flat = stack.reshape(len(stack), -1)
        for t in range(len(stack)):
            self.images += near[:, t, None] * (flat[t][opening.window] - backgrounds[:, t, None])
        tilt = np.einsum("sit,it->is", opening.slopes(stack), near)
        falls = (np.abs(tilt) * np.abs(opening.window_offset).max(axis=1)).sum(axis=1)
        share = np.clip((near * backgrounds).sum(axis=1) / np.maximum(falls, 1e-12), 0, 1)
        self.images -= share[:, None] * (tilt[:, None] * opening.window_offset).sum(axis=-1)
        weight = near.sum(axis=1)
        self.weight += weight
        # Apertures that follow a drift lie differently on the pixels each time: the mean offset keeps the centroid.
        self.offsets += weight[:, None, None] * opening.window_offset
        self.inside &= opening.inside

    def include(self, other: LitImages) -> None:
        """Add what further frames showed."""
        self.images += other.images
        self.weight += other.weight
        self.offsets += other.offsets
        self.inside &= other.inside

    def measure(self, sigma_px: float, iterations: int = 12) -> Shapes:
        """Position and width by moments under a Gaussian window of the PSF's width that follows the spot.

        With window and spot of the same width the windowed centroid moves half way to the spot's centre, so
        twice the step converges at once; the windowed covariance C gives the spot's as (C⁻¹ − W⁻¹)⁻¹.
        """
        total_weight = np.maximum(self.weight, 1e-12)
        image = self.images / total_weight[:, None] * self.inside
        offset = self.offsets / total_weight[:, None, None]
        shift = np.zeros((len(image), 2))
        limit = 1.5 * sigma_px
        for _ in range(iterations):
            away = offset - shift[:, None]
            window = image * np.exp(-(away**2).sum(axis=-1) / (2 * sigma_px**2))
            total = np.where(window.sum(axis=1) > 0, window.sum(axis=1), np.inf)
            shift = np.clip(shift + 1.5 * (window[..., None] * away).sum(axis=1) / total[:, None], -limit, limit)
        away = offset - shift[:, None]
        window = image * np.exp(-(away**2).sum(axis=-1) / (2 * sigma_px**2))
        total = np.where(window.sum(axis=1) > 0, window.sum(axis=1), np.inf)
        moments = np.einsum("np,npi,npj->nij", window, away, away) / total[:, None, None]
        eigen = np.clip(np.linalg.eigvalsh(moments), 1e-3, None)
        inverse = 1 / eigen - 1 / sigma_px**2
        # Pixels add 1/12 to the variance of the recorded spot; sigma_px is that of the PSF itself.
        variance = np.where(inverse > 0.02, 1 / np.maximum(inverse, 0.02), 50.0) - 1 / 12
        return Shapes(shift, np.sqrt(np.clip(variance, 0.01, None)))
