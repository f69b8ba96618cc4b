"""An EMCCD's gain register: expected photoelectrons → shot noise and multiplication noise, from one uniform.

A mean of λ photoelectrons gives n ~ Poisson(λ) of them, and an ideal register makes Gamma(n, 1) of n (in units of its
gain). The sum over n is a squared Bessel law: no electron with probability e^−λ, otherwise a value whose square root
is nearly normal, √(λ − t) + z√t with 4λt − 2t² = 2λ (mean and variance exact, the next two cumulants to first order in
1/λ; Siegel 1979, Sankaran 1959). So its quantiles are a smooth table in √λ and the normal score z, and above
`LAST_ROOT` that formula. One uniform for each pixel also keeps two simulations of one seed close where λ differs a
little: their difference has no jumps of n in it.

Other registers make kept·n + (1 − kept)·Gamma(shape·n, 1/shape) of n. Their sums have tables, too, as long as a single
electron's spread hides the numbers (F² from `TABLED` on), and above them 4λt − 2t² = F²λ and a little more or less
skewness than such a square has (`lean`).

Import this module only where a kernel is compiled: it needs numba.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import special
from scipy.interpolate import PchipInterpolator

from napari_mufasa.chance.variates import normal_quantile
from napari_mufasa.compiled import inlined, jit

LAST_ROOT, ROOT_CELLS = 6.0, 192  # of √λ; linear in between, within 1e-4 of the value
LAST_SCORE, SCORE_CELLS = 6.0, 96  # of z, both sides
TABLED = (1.3, 4.0)  # the excess noise factors F² that have a table
_NONE = np.float32(-1e3)  # the score where no electron comes
_LEAST = np.float32(2.0**-33)  # of the chances that a score is made of


@lru_cache(maxsize=16)
def quantile_roots(shape: float = 1.0, kept: float = 0.0) -> NDArray[np.float32]:
    """√x at normal score z, given that an electron came: (√λ, z) on the cells' corners."""
    means = np.linspace(0.0, LAST_ROOT, ROOT_CELLS + 1)[:, None] ** 2
    n = np.arange(1, int(LAST_ROOT**2 + 10 * LAST_ROOT) + 1)
    # P(n | n ≥ 1), λ → 0 included: λⁿ⁻¹/n! · λ/(e^λ − 1)
    share = np.exp(special.xlogy(n - 1, means) - special.gammaln(n + 1)) / special.exprel(means)
    share /= share.sum(axis=1, keepdims=True)
    last = LAST_ROOT + LAST_SCORE * math.sqrt(excess_noise(shape, kept) / 2)
    least = np.concatenate([np.geomspace(2e-5, 0.2, 160), np.linspace(0.2, last, 480)[1:]])
    values = kept + least**2  # no single electron gives less than what is kept of it
    multiplied = np.maximum(values - kept * n[:, None], 0.0) * (shape / (1 - kept))
    below = share @ special.gammainc(shape * n[:, None], multiplied)
    above = share @ special.gammaincc(shape * n[:, None], multiplied)
    scores = np.where(below < 0.5, special.ndtri(below), -special.ndtri(above))
    corners = np.linspace(-LAST_SCORE, LAST_SCORE, SCORE_CELLS + 1)
    roots = np.sqrt(values)
    table = [PchipInterpolator(s[k], roots[k])(corners) for s, k in ((s, np.isfinite(s)) for s in scores)]
    return np.asarray(table, dtype=np.float32)


def excess_noise(shape: float, kept: float) -> float:
    """F² of a register that makes kept + (1 − kept)·Gamma(shape, 1/shape) of an electron; 1 at shape 0 (`detect`)."""
    return 1.0 + (1.0 - kept) ** 2 / shape if shape > 0 else 1.0


def lean(shape: float, kept: float) -> float:
    """By how much the sum over many electrons leans farther than the square of a normal root does, times √λ / 6: its
    third cumulant is λ E J³ of one electron's J, the square's 3/2 F⁴ λ; none in an ideal register."""
    second, third = 1.0 + 1.0 / shape, (1.0 + 1.0 / shape) * (1.0 + 2.0 / shape)
    lost, excess = 1.0 - kept, excess_noise(shape, kept)
    cube = kept**3 + 3 * kept**2 * lost + 3 * kept * lost**2 * second + lost**3 * third
    return float((cube - 1.5 * excess**2) / (6 * excess**1.5))


@inlined
def chances(mean, none, some):  # type: ignore[no-untyped-def]
    """e^−mean and 1 − e^−mean (n,) float32, both exact in proportion: by the series at mean/64, doubled six times."""
    for x in range(mean.size):
        r = min(mean[x], np.float32(40.0)) * np.float32(1.0 / 64.0)
        s = np.float32(1.0)
        for term in range(9, 1, -1):
            s = np.float32(1.0) - r * np.float32(1.0 / term) * s
        s *= r
        e = np.float32(1.0) - s
        for _ in range(6):
            s = s * (np.float32(2.0) - s)
            e = e * e
        none[x], some[x] = e, s


@inlined
def scores(tail, none, some, z):  # type: ignore[no-untyped-def]
    """The normal score of the chance left when an electron comes (n,); `_NONE` where none does."""
    for x in range(tail.size):
        per = np.float32(1.0) / max(some[x], np.float32(1e-37))
        low = tail[x] < np.float32(0.0)
        near = (-tail[x] - none[x] if low else tail[x]) * per  # the chance from this end on, given an electron
        far = np.float32(1.0) - near
        below, above = (near, far) if low else (far, near)
        inner = above if above < np.float32(0.5) else -max(below, _LEAST)
        z[x] = normal_quantile(inner) if below > np.float32(0.0) else _NONE


@inlined
def places(mean, z, cell, along, across):  # type: ignore[no-untyped-def]
    """Where the table is read (n,): the cell's number in the flat table, and how far along √λ and across z within."""
    for x in range(mean.size):
        row = min(np.sqrt(mean[x]) * np.float32(ROOT_CELLS / LAST_ROOT), np.float32(0.999999 * ROOT_CELLS))
        score = min(max(z[x], np.float32(-LAST_SCORE)), np.float32(LAST_SCORE))
        column = (score + np.float32(LAST_SCORE)) * np.float32(0.4999995 * SCORE_CELLS / LAST_SCORE)
        i, j = np.int32(row), np.int32(column)
        along[x], across[x] = row - np.float32(i), column - np.float32(j)
        cell[x] = np.int32(i * np.int32(SCORE_CELLS + 1) + j)


@inlined
def look_up(cell, along, across, flat, out):  # type: ignore[no-untyped-def]
    """The square of the table's root (n,)."""
    right, below = np.uint64(1), np.uint64(SCORE_CELLS + 1)
    for x in range(cell.size):
        k = np.uint64(cell[x])
        low = flat[k] + across[x] * (flat[k + right] - flat[k])
        high = flat[k + below] + across[x] * (flat[k + below + right] - flat[k + below])
        root = low + along[x] * (high - low)
        out[x] = root * root


@jit
def electrons_after_gain(mean, tail, table, excess, leans, cell, scratch, out):  # type: ignore[no-untyped-def]
    """A row (n,) of photoelectron numbers `mean` ≥ 0 → electrons over gain at the uniforms' tails (see
    `variates.tails`), float32, by the table of a register with that excess noise factor and `lean`; cell (n,) int32 and
    scratch (3, n) float32 are for what comes in between.

    In steps of a whole row each: they take half the time of one loop with all of them.
    """
    z, along, across = scratch[0], scratch[1], scratch[2]
    chances(mean, along, across)
    scores(tail, along, across, z)
    places(mean, z, cell, along, across)
    look_up(cell, along, across, table.ravel(), out)
    owed = 3.0 * excess**1.5 * leans  # of the variance, which leaning has its share in
    for x in range(mean.size):
        if z[x] == _NONE:
            out[x] = 0.0
        elif mean[x] > LAST_ROOT * LAST_ROOT:
            t = mean[x] - math.sqrt(mean[x] * mean[x] - 0.5 * (excess * mean[x] - owed))
            score = z[x] + leans / math.sqrt(mean[x]) * (z[x] * z[x] - 1.0)
            root = math.sqrt(mean[x] - t) + score * math.sqrt(t)
            out[x] = root * root
