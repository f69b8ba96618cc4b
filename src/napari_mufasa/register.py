"""An EMCCD's gain register: expected photoelectrons → shot noise and multiplication noise, from one uniform.

A mean of λ photoelectrons gives n ~ Poisson(λ) of them, and the register makes Gamma(n, 1) of n (in units of its
gain). The sum over n is a squared Bessel law: no electron with probability e^−λ, otherwise a value whose square root
is nearly normal, √(λ − t) + z√t with 4λt − 2t² = 2λ (mean and variance exact, the next two cumulants to first order in
1/λ; Siegel 1979, Sankaran 1959). So its quantiles are a smooth table in √λ and the normal score z, and above
`LAST_ROOT` that formula. One uniform for each pixel also keeps two simulations of one seed close where λ differs a
little: their difference has no jumps of n in it.

Import this module only where a kernel is compiled: it needs numba.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import special
from scipy.interpolate import PchipInterpolator

from napari_mufasa.variates import exp_minus, jit, normal_quantile, vectorised

LAST_ROOT, ROOT_CELLS = 6.0, 192  # of √λ; linear in between, within 1e-4 of the value
LAST_SCORE, SCORE_CELLS = 6.0, 96  # of z, both sides


@lru_cache(maxsize=1)
def quantile_roots() -> NDArray[np.float32]:
    """√x at normal score z, given that an electron came: (√λ, z) on the cells' corners."""
    means = np.linspace(0.0, LAST_ROOT, ROOT_CELLS + 1)[:, None] ** 2
    n = np.arange(1, int(LAST_ROOT**2 + 10 * LAST_ROOT) + 1)
    # P(n | n ≥ 1), λ → 0 included: λⁿ⁻¹/n! · λ/(e^λ − 1)
    share = np.exp(special.xlogy(n - 1, means) - special.gammaln(n + 1)) / special.exprel(means)
    share /= share.sum(axis=1, keepdims=True)
    roots = np.concatenate([np.geomspace(2e-5, 0.2, 160), np.linspace(0.2, LAST_ROOT + LAST_SCORE, 480)[1:]])
    below = share @ special.gammainc(n[:, None], roots**2)
    above = share @ special.gammaincc(n[:, None], roots**2)
    scores = np.where(below < 0.5, special.ndtri(below), -special.ndtri(above))
    corners = np.linspace(-LAST_SCORE, LAST_SCORE, SCORE_CELLS + 1)
    table = [PchipInterpolator(s[k], roots[k])(corners) for s, k in ((s, np.isfinite(s)) for s in scores)]
    return np.asarray(table, dtype=np.float32)


@vectorised
def scores(u, none, z):  # type: ignore[no-untyped-def]
    """The share (u − e^−λ)/(1 − e^−λ) of the chance that an electron comes (n,); none comes where it is 0 or less."""
    for x in range(u.size):
        z[x] = (u[x] - none[x]) / (1.0 - none[x])


@jit
def electrons_after_gain(mean, u, table, none, z, out):  # type: ignore[no-untyped-def]
    """A row (n,) of photoelectron numbers `mean` ≥ 0 → electrons over gain at the uniforms u; none and z: scratch.

    In steps of a whole row each: they take half the time of one loop with all of them.
    """
    exp_minus(mean, none)
    scores(u, none, z)
    for x in range(u.size):
        z[x] = normal_quantile(z[x] if z[x] > 1e-300 else 1e-300)  # also where 0/0 made it no number
    for x in range(u.size):
        if mean[x] > LAST_ROOT * LAST_ROOT:
            t = mean[x] - math.sqrt(mean[x] * mean[x] - mean[x])
            root = math.sqrt(mean[x] - t) + z[x] * math.sqrt(t)
        else:
            score = z[x] if z[x] < LAST_SCORE else LAST_SCORE
            score = score if score > -LAST_SCORE else -LAST_SCORE
            across = (score + LAST_SCORE) * (0.4999999 * SCORE_CELLS / LAST_SCORE)
            along = min(math.sqrt(mean[x]), 0.999999 * LAST_ROOT) * (ROOT_CELLS / LAST_ROOT)
            i, j = np.int64(along), np.int64(across)
            a, b = along - i, across - j
            root = (1.0 - a) * (table[i, j] + b * (table[i, j + 1] - table[i, j])) + a * (
                table[i + 1, j] + b * (table[i + 1, j + 1] - table[i + 1, j])
            )
        out[x] = root * root if u[x] > none[x] else 0.0
