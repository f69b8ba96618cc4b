"""How uneven a field is between its spots, where these stand so densely that hardly a pixel is free of them.

What a spot must stand out of is the noise, and what is uneven without being a spot. The lower half of an image tells it
while spots are few; where they are many it lies between them, and tells their light. There they are taken out first, by
CLEAN (Högbom, Astron. Astrophys. Suppl. 15, 417, 1974): again and again, a share of each local maximum's spot.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from napari_mufasa.spots.filters import BACKGROUND_WIDTH, lower_spread, spot_filter
from napari_mufasa.spots.quantiles import quantiles

SEEN_SD = 6.0  # sd above which a local maximum counts as a spot here
DENSE = (0.2, 0.4)  # spots per 4πσ² (the area of one) where a field begins to be crowded, and where it is
UPWARDS = (1.1, 1.3)  # upper over lower spread: fringes have 1 or less, grain 1, spots that merge 1.4 and more
DEPTH_SD = 1.0  # maxima are taken out down to so many sd of what is left
SHARE = 0.5  # of a maximum's spot that is taken out at a time
MOST_SWEEPS, EARNS = 40, 0.005  # it ends where a sweep lowers the spread by a smaller share
ENOUGH_PX = 512  # sides of the middle of a field that tells


@dataclass(frozen=True)
class Between:
    """Spread between spots of images filtered for spots of sd `sigma_px`.

    crowded : 0 where spots are few and the lower half of an image tells, 1 where they must be taken out first, a share
    of both in between: what is found changes nowhere at once. of_mean : spread of the mean of the movie.
    """

    sigma_px: float
    crowded: float
    of_mean: float

    @classmethod
    def of(cls, mean: NDArray[np.float32], noise: NDArray[np.float32], sigma_px: float) -> Between:
        """As the mean of a movie, filtered, shows it (y, x), beside the sd of its noise (y, x)."""
        everywhere, image, noise = lower_spread(mean), _middle(mean), _middle(noise)
        low, middle, high = quantiles(image.ravel(), [0.1587, 0.5, 0.8413])
        upwards = np.interp(high - middle, np.multiply(UPWARDS, middle - low), (0, 1)) if middle > low else 0.0
        if upwards == 0 or _density(image, SEEN_SD * noise, sigma_px) <= DENSE[0]:
            return cls(sigma_px, 0.0, everywhere)
        between = spread_without_spots(image, sigma_px)
        density = _density(image, SEEN_SD * np.maximum(noise, between), sigma_px)
        crowded = float(upwards * np.interp(density, DENSE, (0, 1)))
        return cls(sigma_px, crowded, everywhere + crowded * min(between - float(middle - low), 0.0))

    def spread(self, image: NDArray[np.float32]) -> float:
        """Robust sd of an image (y, x) between its spots."""
        everywhere = lower_spread(image)
        if self.crowded == 0:
            return everywhere
        image = _middle(image)
        return everywhere + self.crowded * min(spread_without_spots(image, self.sigma_px) - lower_spread(image), 0.0)


def spread_without_spots(image: NDArray[np.float32], sigma_px: float) -> float:
    """Robust sd of an image (y, x), filtered for spots of sd `sigma_px`, once its spots are taken out of it."""
    rest, narrow, wide = image, sigma_px**2, (BACKGROUND_WIDTH * sigma_px) ** 2
    variance = narrow + 1 / 12
    top = variance / (variance + narrow) - variance / (variance + wide)  # of a spot of height 1, filtered
    spread = lower_spread(rest)
    for _ in range(MOST_SWEEPS):
        maxima = _maxima(rest, np.median(rest) + DEPTH_SD * spread, sigma_px)
        heights = np.where(maxima, SHARE / top * rest, 0.0)
        spots = 2 * np.pi * variance * ndimage.gaussian_filter(heights, np.sqrt(variance))
        rest = rest - spot_filter(spots[None], sigma_px)[0]
        before, spread = spread, lower_spread(rest)
        if spread > (1 - EARNS) * before:
            return min(before, spread)
    return spread


def _middle(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """The middle of a large image (y, x)."""
    y, x = (max(0, (side - ENOUGH_PX) // 2) for side in image.shape)
    return image[y : y + ENOUGH_PX, x : x + ENOUGH_PX]


def _density(image: NDArray[np.float32], above: NDArray[np.floating], sigma_px: float) -> float:
    """Local maxima per area of a spot that are so far above the middle of what there is."""
    return float(np.mean(_maxima(image, np.median(image) + above, sigma_px)) * 4 * np.pi * sigma_px**2)


def _maxima(
    image: NDArray[np.floating], level: NDArray[np.floating] | np.floating, sigma_px: float
) -> NDArray[np.bool_]:
    """(y, x) local maxima above a level, no two nearer than a spot's sd."""
    size = 2 * max(1, round(sigma_px)) + 1
    return np.asarray((image > level) & (image == ndimage.maximum_filter(image, size)))
