"""Random variates by counter: every pixel of every frame, and every molecule, has a stream of its own.

A stream is named by (key, i, j), so any pixel can be drawn anywhere, in any order, by any worker, and gives
the same number. Streams also stay in step when a model changes: two simulations of one seed that differ in
one effect share all other chance, which makes their difference precise. That is what discovery lives on and
what a sequential generator cannot give.

splitmix64 is the generator; the variates are textbook ones: normal by its inverse distribution function (a table,
in the tails Wichura's AS 241), Poisson by inversion or Hörmann's transformed rejection (PTRS), gamma by Marsaglia
and Tsang. Each function takes the state and returns (value, new state). `uniforms` and `poisson_row` do a whole row
of streams in loops that compilers turn into vector instructions; they give the same numbers as one by one.
Import this module only where a kernel is compiled: it needs numba.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from scipy import special

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX2 = np.uint64(0x94D049BB133111EB)
_SALT = np.uint64(0xD1B54A32D192ED03)
_INVERSE = np.concatenate(([0.0], 1.0 / np.arange(1, 201)))  # a division per step would double the cost
_TO_UNIT = 1.0 / 4503599627370496.0  # 2⁻⁵²: the largest uniform is below 1
CELLS = 2048  # of the normal table, linear in between: within 3e-5 of the truth where it is used
_TAIL = 0.02
_NORMAL = special.ndtri(np.clip(np.arange(CELLS + 1) / CELLS, 1e-3, 1 - 1e-3)).astype(np.float32)

jit: Any = njit(cache=True, nogil=True, error_model="numpy")
vectorised: Any = njit(cache=True, nogil=True, error_model="numpy", fastmath=True)


@jit
def mix(x):  # type: ignore[no-untyped-def]
    x = (x ^ (x >> np.uint64(30))) * _MIX1
    x = (x ^ (x >> np.uint64(27))) * _MIX2
    return x ^ (x >> np.uint64(31))


@jit
def stream(key, i, j):  # type: ignore[no-untyped-def]
    """The first state of stream (i, j) under `key` (uint64)."""
    return mix(mix(key + np.uint64(i) * _GOLDEN) + np.uint64(j) * _SALT)


@jit
def uniform(state):  # type: ignore[no-untyped-def]
    """Uniform in the open interval (0, 1)."""
    state = state + _GOLDEN
    return (np.float64(mix(state) >> np.uint64(12)) + 0.5) * _TO_UNIT, state


@jit
def exponential(state):  # type: ignore[no-untyped-def]
    u, state = uniform(state)
    return -math.log(u), state


@jit
def normal(state):  # type: ignore[no-untyped-def]
    """Standard normal: the inverse distribution function of one uniform."""
    u, state = uniform(state)
    return normal_quantile(u), state


@jit
def normal_quantile(u):  # type: ignore[no-untyped-def]
    """z with Φ(z) = u: a table with straight lines between its points, AS 241 in the tails."""
    if u > _TAIL and u < 1.0 - _TAIL:
        place = u * CELLS
        i = np.int64(place)
        return np.float64(_NORMAL[i] + np.float32(place - i) * (_NORMAL[i + 1] - _NORMAL[i]))
    return _wichura(u)


@jit
def _wichura(u):  # type: ignore[no-untyped-def]
    """Inverse of the normal distribution function (Wichura 1988, AS 241)."""
    q = u - 0.5
    if abs(q) <= 0.425:
        r = 0.180625 - q * q
        top = (((((((2509.0809287301226727 * r + 33430.575583588128105) * r + 67265.770927008700853) * r
              + 45921.953931549871457) * r + 13731.693765509461125) * r + 1971.5909503065514427) * r
              + 133.14166789178437745) * r + 3.387132872796366608)  # fmt: skip
        bottom = (((((((5226.495278852545925 * r + 28729.085735721942674) * r + 39307.89580009271061) * r
                 + 21213.794301586595867) * r + 5394.1960214247511077) * r + 687.1870074920579083) * r
                 + 42.313330701600911252) * r + 1.0)  # fmt: skip
        return q * top / bottom
    r = math.sqrt(-math.log(u if q < 0.0 else 1.0 - u))
    if r <= 5.0:
        r -= 1.6
        top = (((((((7.7454501427834140764e-4 * r + 0.0227238449892691845833) * r + 0.24178072517745061177) * r
              + 1.27045825245236838258) * r + 3.64784832476320460504) * r + 5.7694972214606914055) * r
              + 4.6303378461565452959) * r + 1.42343711074968357734)  # fmt: skip
        bottom = (((((((1.05075007164441684324e-9 * r + 5.475938084995344946e-4) * r + 0.0151986665636164571966) * r
                 + 0.14810397642748007459) * r + 0.68976733498510000455) * r + 1.6763848301838038494) * r
                 + 2.05319162663775882187) * r + 1.0)  # fmt: skip
    else:
        r -= 5.0
        top = (((((((2.01033439929228813265e-7 * r + 2.71155556874348757815e-5) * r + 0.0012426609473880784386) * r
              + 0.026532189526576123093) * r + 0.29656057182850489123) * r + 1.7848265399172913358) * r
              + 5.4637849111641143699) * r + 6.6579046435011037772)  # fmt: skip
        bottom = (((((((2.04426310338993978564e-15 * r + 1.4215117583164458887e-7) * r + 1.8463183175100546818e-5) * r
                 + 7.868691311456132591e-4) * r + 0.0148753612908506148525) * r + 0.13692988092273580531) * r
                 + 0.59983220655588793769) * r + 1.0)  # fmt: skip
    z = top / bottom
    return -z if q < 0.0 else z


@jit
def poisson(mean, state):  # type: ignore[no-untyped-def]
    """Poisson: inversion below 30 (one uniform), transformed rejection above (Hörmann 1993)."""
    if mean <= 0.0:
        return 0, state
    if mean < 30.0:
        u, state = uniform(state)
        k, p = 0, math.exp(-mean)
        while u > p and k < 200:
            u -= p
            k += 1
            p *= mean * _INVERSE[k]
        return k, state
    b = 0.931 + 2.53 * math.sqrt(mean)
    a = -0.059 + 0.02483 * b
    inverse_alpha = 1.1239 + 1.1328 / (b - 3.4)
    squeeze = 0.9277 - 3.6224 / (b - 2.0)
    log_mean = math.log(mean)
    while True:
        u, state = uniform(state)
        v, state = uniform(state)
        u -= 0.5
        us = 0.5 - abs(u)
        k = math.floor((2.0 * a / us + b) * u + mean + 0.43)
        if us >= 0.07 and v <= squeeze:
            return k, state
        if k < 0 or (us < 0.013 and v > us):
            continue
        if math.log(v * inverse_alpha / (a / (us * us) + b)) <= k * log_mean - mean - math.lgamma(k + 1.0):
            return k, state


@jit
def gamma(shape, state):  # type: ignore[no-untyped-def]
    """Gamma of unit scale (Marsaglia and Tsang 2000); shape 0 gives 0."""
    if shape <= 0.0:
        return 0.0, state
    if shape == 1.0:
        return exponential(state)
    boost = 1.0
    if shape < 1.0:
        u, state = uniform(state)
        boost = u ** (1.0 / shape)
        shape += 1.0
    d = shape - 1.0 / 3.0
    c = 1.0 / math.sqrt(9.0 * d)
    while True:
        x, state = normal(state)
        v = 1.0 + c * x
        if v <= 0.0:
            continue
        v = v * v * v
        u, state = uniform(state)
        if u < 1.0 - 0.0331 * x**4 or math.log(u) < 0.5 * x * x + d * (1.0 - v + math.log(v)):
            return boost * d * v, state


@jit
def uniforms(key, i, first, draw, out):  # type: ignore[no-untyped-def]
    """Draw number `draw` (from 1) of the streams (i, first), (i, first + 1) …, into out (n,)."""
    base, ahead = mix(key + np.uint64(i) * _GOLDEN), np.uint64(draw) * _GOLDEN
    for x in range(out.size):
        bits = mix(mix(base + np.uint64(first + x) * _SALT) + ahead)
        out[x] = (np.float64(np.int64(bits >> np.uint64(12))) + 0.5) * _TO_UNIT


@vectorised
def exp_minus(mean, out):  # type: ignore[no-untyped-def]
    """e^−mean (n,): for means up to 40 as e^(−r)⁶⁴, the series good to 1e-11; above, less than 1e-17."""
    for x in range(mean.size):
        r = min(mean[x], 40.0) * (1.0 / 64.0)
        e = 1.0
        for term in range(10, 0, -1):
            e = 1.0 - r * _INVERSE[term] * e
        for _ in range(6):
            e *= e
        out[x] = e


@vectorised
def poisson_row(mean, u, terms, p, below, k):  # type: ignore[no-untyped-def]
    """Poisson by inversion of u for means up to 30, all (n,): counts into k (float64); p and below are scratch.

    `terms` is how many terms of the distribution are summed: enough for the largest mean.
    """
    exp_minus(mean, p)
    for x in range(mean.size):
        below[x] = p[x]
        k[x] = 0.0
    for term in range(1, terms):
        for x in range(mean.size):
            k[x] += 1.0 if u[x] > below[x] else 0.0
            p[x] *= mean[x] * _INVERSE[term]
            below[x] += p[x]
