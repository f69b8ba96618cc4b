"""How molecules move, from where they were seen: diffusion, drift and how well they were localised (docs/traces.md)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
LEAST_SIGHTINGS = 4  # two values and a drift need as many
# Share of diffusion in how far a molecule seems to move from frame to frame, 0.75 q / (q + s) with q = 2 D.
SHARES = np.union1d([0.0, *np.geomspace(1e-5, 0.1, 101)], np.linspace(0.1, 1.0, 181))


@dataclass(frozen=True)
class Motion:
    """Of each molecule, nan where it was seen too rarely.

    diffusion_px2 : D, px² per frame, where the mean squared displacement is 4 D t · diffusion_sd_px2 : its uncertainty
    drift_px : (molecule, 2) steady motion (y, x), px per frame · drift_sd_px : its uncertainty along each axis
    localisation_px : sd of a place along one axis, what the motion within an exposure evens out taken off: the mean
        squared displacement is 4 D t + 4 localisation_px²
    """

    diffusion_px2: Array
    diffusion_sd_px2: Array
    drift_px: Array
    drift_sd_px: Array
    localisation_px: Array


def motion_of(seen_px: Array) -> Motion:
    """Diffusion and drift of molecules (molecule, frame, 2) that were seen in places with errors; nan where not seen.

    Places are those of a random walk with steady drift, q = 2 D per frame and axis, and errors of variance s: the
    displacements are correlated like those of Berglund, Phys. Rev. E 82, 011917 (2010), who shows that the motion
    within an exposure (of share R) leaves D as it is and makes s = σ² − 2 D R. The likelihood is maximised over D and
    s, as in Michalet and Berglund, Phys. Rev. E 85, 061916 (2012); frames without a sighting count as what they are.
    For molecules that are seen well it agrees with the covariance-based estimator of Vestergaard, Blainey and
    Flyvbjerg, Phys. Rev. E 89, 022726 (2014); for slow ones it is surer.
    """
    from napari_mufasa.spots.kernels import walks

    n = len(seen_px)
    one, two = np.full((5, n), np.nan), np.full((n, 2), np.nan)
    result = Motion(one[0], one[1], two, one[2], one[3])
    seen = np.isfinite(seen_px[..., 0])
    for i in np.flatnonzero(seen.sum(axis=1) >= LEAST_SIGHTINGS):
        frames = np.flatnonzero(seen[i])
        fits = walks(frames.astype(np.float64), np.ascontiguousarray(seen_px[i, frames], dtype=np.float64), SHARES)
        freedom = 2.0 * (len(frames) - 2)
        q, sd, best, scale = _best(fits, freedom)
        result.diffusion_px2[i], result.diffusion_sd_px2[i] = q / 2, sd / 2
        result.drift_px[i] = fits[best, 2:4]
        result.drift_sd_px[i] = np.sqrt(scale / fits[best, 4])
        result.localisation_px[i] = np.sqrt(max(scale - q, 0.0))
    return result


def _best(fits: Array, freedom: float) -> tuple[float, float, int, float]:
    """q, its uncertainty, the number of its share and q + s where the likelihood of `walks` is largest.

    The uncertainty is half the interval of q within which the likelihood, s fitted anew for each, falls by less than
    exp(−½); where it reaches down to 0, the part above q.
    """
    scales = np.maximum(fits[:, 1], 1e-12) / freedom  # the best for each share
    height = fits[:, 0] + freedom * np.log(scales) + freedom
    best = int(np.argmin(height))
    scale = float(scales[best])
    top = float(SHARES[best] * scale * 4 / 3)
    q = np.concatenate([[0.0], np.geomspace(4e-5 / 3, 8.0, 240)]) * scale
    with np.errstate(divide="ignore", invalid="ignore"):
        c = 0.75 * q[:, None] / SHARES  # (q, share): the scale that makes them agree
        c[0] = scales[0]
        whole = fits[:, 0] + freedom * np.log(c) + fits[:, 1] / c
    whole[1:, 0] = np.inf  # without a share there is no q
    whole[0, 1:] = np.inf
    fall = whole.min(axis=1) - height[best] - 1.0
    above = int(np.searchsorted(q, top, side="right"))
    high = _crossing(q, fall, above, 1)
    low = _crossing(q, fall, above - 1, -1)
    return top, 0.5 * (high - low) if low > 0 else high - top, best, scale


def _crossing(q: Array, fall: Array, start: int, step: int) -> float:
    """Where `fall` rises above 0, from number `start` on in steps of ±1; between two numbers on a straight line."""
    i = start
    while 0 <= i < len(q) and fall[i] < 0:
        i += step
    if not 0 < i < len(q):
        return 0.0 if i <= 0 else float(q[-1])
    inner = i - step
    if not 0 <= inner < len(q) or fall[inner] >= 0 or not np.isfinite(fall[i]):
        return float(q[i])
    return float(q[inner] + (q[i] - q[inner]) * fall[inner] / (fall[inner] - fall[i]))
