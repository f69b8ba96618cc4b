"""The Gaussian PSF on pixels: how far it reaches, and which share of a spot's light a pixel gets."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

REACH_SIGMA = 5.0  # pixels farther from the emitter than this hold less than 1e-6 of its photons


def pixel_shares(
    offset_y: NDArray[np.floating], offset_x: NDArray[np.floating], sigma_px: float
) -> NDArray[np.float64]:
    """Share of a spot's light in a pixel whose centre lies at this offset from the spot."""
    scale = 1.0 / (np.sqrt(2.0) * sigma_px)

    def along(d: NDArray[np.floating]) -> NDArray[np.float64]:
        return np.asarray(0.5 * (erf((d + 0.5) * scale) - erf((d - 0.5) * scale)))

    return along(offset_y) * along(offset_x)


PLACES = (np.arange(21) + 0.5) / 21 - 0.5  # of a spot within its pixel, along an axis


def mean_peak_share(sigma_px: float) -> float:
    """Share of a spot's light in its brightest pixel, averaged over the spot's place within that pixel."""
    return float(pixel_shares(PLACES[:, None], PLACES[None, :], sigma_px).mean())


def mean_disc_share(sigma_px: float, radius_px: float) -> float:
    """Share of a spot's light in the pixels whose centres lie within a disc around it, averaged over the spot's place
    within its pixel."""
    reach = int(np.ceil(radius_px + 0.5))
    along = (np.arange(-reach, reach + 1) - PLACES[:, None]).ravel()
    y, x = along[:, None], along[None, :]
    inside = pixel_shares(y, x, sigma_px)[y**2 + x**2 <= radius_px**2]
    return float(inside.sum() / len(PLACES) ** 2)
