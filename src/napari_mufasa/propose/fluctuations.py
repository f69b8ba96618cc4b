"""PSF width by image correlation: from how neighbouring pixels fluctuate together, where no spot stands alone."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from napari_mufasa.calibrate.sample import window
from napari_mufasa.calibrate.value import UNKNOWN, Value
from napari_mufasa.camera.detector import photoelectrons

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from napari_mufasa.model.setup import Camera

LAG = 8  # frames between the two that are compared: molecules have moved on, cells have not
WINDOW = 2 * LAG
MOST_WINDOWS = 60
LEAST_WINDOWS = 5
GROUPS = 8  # of windows, left out one by one
REACH_PX = 12  # distance up to which pixels are compared
NEAREST = 1.2  # px: read-out mixes pixels that are nearer
BROAD = 2.0  # times the PSF's width and more: light that is out of focus, cells that move
NEAR_PX = 3.0  # within which pixels must change together, in every group of windows
CLEAR = 6.0  # standard errors that the width must be above 0
SHAPE_DOUBT = 0.12  # of the width: how far molecules move within a frame, and from one to the other of a pair


def fluctuation_width(movie: Any, camera: Camera) -> Value:
    """Width of the PSF (sd, px) in a movie (frame, y, x) of molecules that move, blink or bleach; unknown where they
    do not, or too few frames are there to tell.

    Molecules that are independent of one another fluctuate together in all the pixels that one of them lights: the
    covariance over space is A exp(−r²/4σ²), the PSF with itself, and noise has none (Petersen et al., Biophys. J. 65,
    1135, 1993, doi:10.1016/S0006-3495(93)81173-1). What all pixels share, as the light's flicker, is taken off first;
    a second, broad Gaussian stands for what is out of focus. Molecules that move along an axis by no more than one and
    a half times the PSF's width in `LAG` frames make it a tenth too small, which the interval has room for; slower ones
    are seen as spots.
    Holds `WINDOW` frames and their transforms at a time, of large frames the middle.
    """
    part = window(movie.shape[1:])
    camera = camera.of_part(*part)
    starts = np.arange(0, movie.shape[0] - WINDOW + 1, LAG)
    if len(starts) < LEAST_WINDOWS or min(movie.shape[1:]) < 2 * REACH_PX:
        return UNKNOWN
    chosen = starts[np.unique(np.linspace(0, len(starts) - 1, MOST_WINDOWS).astype(int))]
    seen = np.stack(
        [_covariance(photoelectrons(np.asarray(movie[s : s + WINDOW, *part]), camera, int(s))) for s in chosen]
    )
    groups = np.array_split(np.arange(len(seen)), min(GROUPS, len(seen)))
    width = _width(seen.mean(axis=0))
    without = np.array([_width(np.delete(seen, group, axis=0).mean(axis=0)) for group in groups])
    sd = float(np.sqrt((len(groups) - 1) * without.var()))  # jackknife
    near = np.hypot(*_lags()) <= NEAR_PX
    # By chance once in 2 to the power of the number of groups.
    everywhere = all(seen[group][:, near].mean() > 0 for group in groups)
    if not (everywhere and width > CLEAR * sd):
        return UNKNOWN
    # Pixels add 1/12 to the variance of a recorded spot.
    sigma = np.sqrt(max(width**2 - 1 / 12, 0.01))
    return Value(float(sigma), float(np.hypot(sd * width / sigma, SHAPE_DOUBT * sigma)))


def _lags() -> tuple[Any, Any]:
    """Rows and columns between two pixels: of each pair of opposite lags one."""
    dy, dx = np.mgrid[0 : REACH_PX + 1, -REACH_PX : REACH_PX + 1]
    apart = np.hypot(dy, dx)
    keep = (dy > 0) & (apart > NEAREST) & (apart <= REACH_PX)
    return dy[keep], dx[keep]


def _covariance(frames: NDArray[np.floating]) -> NDArray[np.float64]:
    """Covariance over space, at `_lags`, of what changes in `LAG` frames in a window of frames (frame, y, x)."""
    mean = frames.mean(axis=0, dtype=np.float64)
    shared, _ = np.linalg.qr(np.stack([np.ones(mean.size), mean.ravel() - mean.mean()], axis=1))
    change = (frames[LAG:] - frames[:LAG]).reshape(LAG, -1)
    change = (change - (change @ shared) @ shared.T).reshape(LAG, *mean.shape)
    padded = [n + REACH_PX for n in mean.shape]
    power = np.square(np.abs(np.fft.rfft2(change, padded))).mean(axis=0)
    pairs = np.square(np.abs(np.fft.rfft2(np.ones(mean.shape), padded)))
    dy, dx = _lags()
    return np.asarray(np.fft.irfft2(power, padded)[dy, dx] / np.fft.irfft2(pairs, padded)[dy, dx])


def _width(covariance: NDArray[np.float64]) -> float:
    """Width σ of the narrow one of two Gaussians in a covariance at `_lags`; 0 where it is none of one PSF."""
    from scipy.optimize import least_squares

    r2 = np.sum(np.square(_lags()), axis=0)
    scale = float(np.abs(covariance).max()) or 1.0

    def off(p: NDArray[np.float64]) -> NDArray[np.float64]:
        width, broader = np.exp(p[2:])
        broad = (BROAD + broader) * width
        model = p[0] * np.exp(-r2 / (4 * width**2)) + p[1] * np.exp(-r2 / (4 * broad**2))
        return np.asarray(model - covariance / scale)

    height, _, width, _ = least_squares(off, [1.0, 0.1, np.log(1.3), 0.0]).x
    return float(np.exp(width)) if height > 0 else 0.0
