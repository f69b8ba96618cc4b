"""The source's recipe in its literal steps: Gaussian wavelet shrinkage, then a Poisson denoiser (docs/denoising.md)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]


def bayes_shrink(image: Array, sigma: float) -> NDArray[np.float32]:
    """Wavelet shrinkage of Gaussian noise of known ``sigma`` with BayesShrink thresholds."""
    from skimage.restoration import denoise_wavelet

    if sigma <= 0:
        return np.asarray(image, np.float32)
    # An image of constants has bands without any variance, whose threshold is 0/0 and irrelevant.
    with np.errstate(invalid="ignore", divide="ignore"):
        shrunk = denoise_wavelet(image, sigma=sigma, method="BayesShrink", mode="soft", rescale_sigma=False)
    return np.nan_to_num(np.asarray(shrunk, np.float32))


def anscombe(image: Array, sigma: float = 0.0) -> Array:
    """Generalised Anscombe transform of Poisson counts with Gaussian noise ``sigma``: variance about 1."""
    stable: Array = 2.0 * np.sqrt(np.maximum(image + (0.375 + sigma * sigma), 0.0))
    return stable


def inverse_anscombe(stable: Array) -> Array:
    """Closed-form approximation of the exact unbiased inverse."""
    d = np.maximum(stable, 2.0 * np.sqrt(0.375))
    root = np.sqrt(1.5)
    signal: Array = 0.25 * d**2 + 0.25 * root / d - 1.375 / d**2 + 0.625 * root / d**3 - 0.125
    return signal


def anscombe_wavelet(image: Array) -> NDArray[np.float32]:
    """Poisson denoising by Anscombe transform and BayesShrink; a simple stand-in for PURE-LET in the recipe."""
    return np.asarray(inverse_anscombe(bayes_shrink(anscombe(np.maximum(image, 0.0)), 1.0)), np.float32)
