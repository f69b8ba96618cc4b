"""Random variates by counter: every pixel of every frame, and every molecule, has a stream of its own.

A stream is named by (key, i, j), so any pixel can be drawn anywhere, in any order, by any worker, and gives
the same number. Streams also stay in step when a model changes: two simulations of one seed that differ in
one effect share all other chance, which makes their difference precise. That is what discovery lives on and
what a sequential generator cannot give.

splitmix64 is the generator; the variates are textbook ones: normal by its inverse distribution function, Poisson by
inversion, by its smooth inverse where many are bright, or by Hörmann's transformed rejection (PTRS), gamma by
Marsaglia and Tsang. Each function takes the state and returns (value, new state). `uniforms`, `tails`, `poisson_row`
and `poisson_quantiles` do a whole row of streams in loops that compilers turn into vector instructions; all but the
last draw the same numbers as one by one.
Import this module only where a kernel is compiled: it needs numba.
"""

from __future__ import annotations

import math

import numpy as np

from napari_mufasa.compiled import inlined, jit

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX2 = np.uint64(0x94D049BB133111EB)
_SALT = np.uint64(0xD1B54A32D192ED03)
_INVERSE = np.concatenate(([0.0], 1.0 / np.arange(1, 201)))  # a division per step would double the cost
_LOG_FACTORIAL = np.array([math.lgamma(k + 1.0) for k in range(2048)])
INVERTED = 30.0  # Poisson means up to here are drawn by inversion
SMOOTH = 16.0  # … and those from here on may be by `poisson_quantiles`
_ONE_BITS, _BELOW_ONE = np.uint64(0x3FF0000000000000), 1.0 - 2.0**-53  # the first: 1 as bits
_ONE, _ROOT_HALF = np.float32(1.0), np.int32(0x3F3504F3)  # the second: √½ as bits
_PER_REACH = np.float32(2.0 / 4.709640090068079)
_COEFFICIENTS = tuple(np.float32(c) for c in (
    3.103046097, 3.230008607, 0.4018923868, -0.8015023434, 0.9417267817, -0.1240975447, -1.224035533,
    0.9440984023, 1.002212449, -1.207067598, -0.4767014535, 0.7349680110, 0.1004871278, -0.1811063797,
))  # fmt: skip


@jit
def mix(x):  # type: ignore[no-untyped-def]
    x = (x ^ (x >> np.uint64(30))) * _MIX1
    x = (x ^ (x >> np.uint64(27))) * _MIX2
    return x ^ (x >> np.uint64(31))


@jit
def stream(key, i, j):  # type: ignore[no-untyped-def]
    """The first state of stream (i, j) under `key` (uint64)."""
    return mix(key + np.uint64(i) * _GOLDEN) + np.uint64(j) * _SALT


@jit
def unit(bits):  # type: ignore[no-untyped-def]
    """(n + ½)/2⁵² of the first 52 bits n of uint64: in the open interval (0, 1), exact, and without a conversion."""
    return np.uint64((bits >> np.uint64(12)) | _ONE_BITS).view(np.float64) - _BELOW_ONE


@jit
def uniform(state):  # type: ignore[no-untyped-def]
    """Uniform in the open interval (0, 1)."""
    state = state + _GOLDEN
    return unit(mix(state)), state


@jit
def exponential(state):  # type: ignore[no-untyped-def]
    u, state = uniform(state)
    return -math.log(u), state


@jit
def normal(state):  # type: ignore[no-untyped-def]
    """Standard normal: the inverse distribution function of one uniform."""
    u, state = uniform(state)
    return normal_quantile(np.float32(-u if u < 0.5 else 1.0 - u)), state


@inlined
def log(x):  # type: ignore[no-untyped-def]
    """Natural logarithm of a float32 above 1e-37, within 1e-6."""
    bits = np.float32(x).view(np.int32)
    exponent = np.int32(np.int32(bits - _ROOT_HALF) >> np.int32(23))
    part = np.int32(bits - np.int32(exponent << np.int32(23))).view(np.float32)  # √½ … √2
    t = (part - _ONE) / (part + _ONE)
    t2 = t * t
    series = np.float32(1 / 7) + t2 * np.float32(1 / 9)
    series = _ONE + t2 * (np.float32(1 / 3) + t2 * (np.float32(1 / 5) + t2 * series))
    return np.float32(2.0) * t * series + np.float32(exponent) * np.float32(math.log(2.0))


@inlined
def normal_quantile(tail):  # type: ignore[no-untyped-def]
    """The standard normal's value at a tail (float32): below −tail lies the chance −tail, above tail the chance tail.

    For p = |tail| and d = 1 − 2p, z/d is smooth in √(−ln(1 − d²)): a polynomial within 2e-5 of z down to p = 1e-10.
    """
    p = abs(tail)
    d = _ONE - np.float32(2.0) * p
    t = np.sqrt(max(-log(np.float32(4.0) * p * (_ONE - p)), np.float32(0.0))) * _PER_REACH - _ONE
    ratio = _COEFFICIENTS[13]
    ratio = ratio * t + _COEFFICIENTS[12]
    ratio = ratio * t + _COEFFICIENTS[11]
    ratio = ratio * t + _COEFFICIENTS[10]
    ratio = ratio * t + _COEFFICIENTS[9]
    ratio = ratio * t + _COEFFICIENTS[8]
    ratio = ratio * t + _COEFFICIENTS[7]
    ratio = ratio * t + _COEFFICIENTS[6]
    ratio = ratio * t + _COEFFICIENTS[5]
    ratio = ratio * t + _COEFFICIENTS[4]
    ratio = ratio * t + _COEFFICIENTS[3]
    ratio = ratio * t + _COEFFICIENTS[2]
    ratio = ratio * t + _COEFFICIENTS[1]
    z = d * (ratio * t + _COEFFICIENTS[0])
    return z if tail > np.float32(0.0) else -z


@jit
def poisson(mean, state):  # type: ignore[no-untyped-def]
    """Poisson: inversion below 30 (one uniform), transformed rejection above (Hörmann 1993)."""
    if mean <= 0.0:
        return 0, state
    if mean < INVERTED:
        return poisson_by_inversion(mean, math.exp(-mean), state)
    return poisson_by_rejection(mean, rejection_of(mean), state)


@jit
def poisson_by_inversion(mean, none, state):  # type: ignore[no-untyped-def]
    """For means below `INVERTED`; `none` is e^−mean."""
    u, state = uniform(state)
    k, p = 0, none
    while u > p and k < 200:
        u -= p
        k += 1
        p *= mean * _INVERSE[k]
    return k, state


@jit
def rejection_of(mean):  # type: ignore[no-untyped-def]
    """What `poisson_by_rejection` needs of a mean: a, b and the squeeze."""
    b = 0.931 + 2.53 * math.sqrt(mean)
    return -0.059 + 0.02483 * b, b, 0.9277 - 3.6224 / (b - 2.0)


@jit
def poisson_by_rejection(mean, shape, state):  # type: ignore[no-untyped-def]
    """For means from `INVERTED` on; `shape` is `rejection_of` the mean."""
    a, b, squeeze = shape
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
        inverse_alpha = 1.1239 + 1.1328 / (b - 3.4)
        log_factorial = _LOG_FACTORIAL[k] if k < _LOG_FACTORIAL.size else math.lgamma(k + 1.0)
        if math.log(v * inverse_alpha / (a / (us * us) + b)) <= k * math.log(mean) - mean - log_factorial:
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
    base = stream(key, i, first) + np.uint64(draw) * _GOLDEN
    for x in range(out.size):
        out[x] = unit(mix(base + np.uint64(x) * _SALT))


@inlined
def tail(bits):  # type: ignore[no-untyped-def]
    """A uniform of uint64 as float32 that is exact at either end: −u below a half, 1 − u above."""
    high = np.int32(np.int64(bits >> np.uint64(32)))
    from_end = np.int32(high ^ np.int32(high >> np.int32(31)))
    p = (np.float32(from_end) + np.float32(0.5)) * np.float32(2.0**-32)
    return -p if high >= 0 else p


@jit
def first_tail(state):  # type: ignore[no-untyped-def]
    """The first draw of a state as a `tail`."""
    return tail(mix(state + _GOLDEN))


@jit
def tails(key, i, first, bits, out):  # type: ignore[no-untyped-def]
    """The first draw of the streams (i, first), (i, first + 1) … as a `tail`, into out (n,); bits (n,) uint64 is
    scratch."""
    base = stream(key, i, first) + _GOLDEN
    for x in range(out.size):
        bits[x] = mix(base + np.uint64(x) * _SALT)
    for x in range(out.size):
        out[x] = tail(bits[x])


@inlined
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


@inlined
def poisson_row(mean, u, terms, p, below, k):  # type: ignore[no-untyped-def]
    """Poisson by inversion of u for means up to 30, all (n,): counts into k (float64); p and below are scratch.

    `terms` is how many terms of the distribution are summed at most, enough for the largest mean; the sum ends once
    no u lies above it.
    """
    exp_minus(mean, p)
    for x in range(mean.size):
        below[x] = p[x]
        k[x] = 0.0
    for term in range(1, terms):
        left = 0.0
        for x in range(mean.size):
            above = 1.0 if u[x] > below[x] else 0.0
            left += above
            k[x] += above
            p[x] *= mean[x] * _INVERSE[term]
            below[x] += p[x]
        if left == 0.0:
            break


@inlined
def poisson_quantiles(mean, tail, k):  # type: ignore[no-untyped-def]
    """Poisson for means from `SMOOTH` on, counts into k (float), all (n,): the quantile at a `tail`, by the first terms
    of its expansion in 1/√mean about the normal's (Giles, ACM Trans. Math. Softw. 42, 7, 2016). Within 5e-5 of
    the distribution function, and without any branch; for smaller means it would give zero too often."""
    for x in range(mean.size):
        w, m = normal_quantile(tail[x]), mean[x]
        root = np.sqrt(m)
        w2 = w * w
        constant = np.float32(1 / 3) + w2 * np.float32(1 / 6)
        first = -w * (np.float32(1 / 36) + w2 * np.float32(1 / 72))
        second = np.float32(-8 / 405) + w2 * (np.float32(7 / 810) + w2 * np.float32(1 / 270))
        k[x] = max(np.floor(m + root * w + constant + (first + second / root) / root), np.float32(0.0))
