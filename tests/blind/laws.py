"""Dwell laws and time courses: the different shapes nature gives to the same mechanism."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Rng = np.random.Generator
Dwell = Callable[[Rng], float]


# ---- dwell laws: each returns a sampler of one duration with the mean asked for -------------------------
def exponential(mean_s: float) -> Dwell:
    return lambda rng: mean_s * -np.log1p(-rng.random())


def two_component(mean_s: float, ratio: float = 8.0, slow_share: float = 0.3) -> Dwell:
    """Hyper-exponential: a share of visits lasts ``ratio`` times longer than the others."""
    fast_s = mean_s / (1.0 - slow_share + slow_share * ratio)
    return lambda rng: (fast_s * ratio if rng.random() < slow_share else fast_s) * -np.log1p(-rng.random())


def two_step(mean_s: float) -> Dwell:
    """Two equal steps in a row (Erlang 2): short visits are rare."""
    return lambda rng: -0.5 * mean_s * (np.log1p(-rng.random()) + np.log1p(-rng.random()))


def log_normal(mean_s: float, sigma: float = 1.0) -> Dwell:
    return lambda rng: mean_s * float(np.exp(sigma * rng.standard_normal() - 0.5 * sigma**2))


def power_law_mean_s(shortest_s: float, longest_s: float, exponent: float = 1.5) -> float:
    """Mean of a density t**-exponent between the two cut-offs."""
    a, b, m = shortest_s, longest_s, exponent
    norm = (b ** (1 - m) - a ** (1 - m)) / (1 - m)
    return (b ** (2 - m) - a ** (2 - m)) / (2 - m) / norm


def power_law(shortest_s: float, longest_s: float, exponent: float = 1.5) -> Dwell:
    lo, hi = shortest_s ** (1 - exponent), longest_s ** (1 - exponent)
    return lambda rng: (lo + rng.random() * (hi - lo)) ** (1.0 / (1.0 - exponent))


# ---- time courses ---------------------------------------------------------------------------------------
COURSES = ("linear", "settling", "step", "random_walk")


def course(form: int, n: int, rng: Rng, n_before: int = 0) -> np.ndarray:
    """A course from 0 at the first frame to a change of about 1, sampled ``n`` times.

    ``n_before`` further samples, for what was recorded before the movie, come first in the result.
    """
    u = (np.arange(-n_before, n) + 0.5) / n
    if form == 0:
        return u
    if form == 1:
        # Where it is followed backwards too (dark frames before the movie) it settles more slowly.
        tau = rng.uniform(0.5, 1.0) if n_before else rng.uniform(0.2, 0.5)
        return (1.0 - np.exp(-u / tau)) / (1.0 - np.exp(-1.0 / tau))
    if form == 2:
        where = rng.uniform(0.3, 0.7)
        return 1.0 / (1.0 + np.exp(-(u - where) / 0.004))
    walk = np.cumsum(rng.standard_normal(n_before + n))
    walk -= walk[n_before]
    span = np.ptp(walk[n_before:])
    return walk / max(float(span), 1e-12)


def pink(n: int, rng: Rng, exponent: float = 1.0) -> np.ndarray:
    """Noise of unit variance whose power falls as 1/f**exponent (1/f for the default)."""
    spectrum = np.fft.rfft(rng.standard_normal(n))
    f = np.fft.rfftfreq(n)
    f[0] = f[1]
    noise = np.fft.irfft(spectrum * f ** (-0.5 * exponent), n)
    noise -= noise.mean()
    return noise / noise.std()


def correlated(n: int, frames: float, rng: Rng) -> np.ndarray:
    """Ornstein-Uhlenbeck noise of unit variance with the correlation time given in frames."""
    keep = np.exp(-1.0 / frames)
    kicks = rng.standard_normal(n) * np.sqrt(1.0 - keep**2)
    kicks[0] = rng.standard_normal()
    out = np.empty(n)
    out[0] = kicks[0]
    for i in range(1, n):
        out[i] = keep * out[i - 1] + kicks[i]
    return out
