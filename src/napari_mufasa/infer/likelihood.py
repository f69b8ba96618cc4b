"""Rates and levels of most likelihood, and how well the molecules say them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from napari_mufasa.errors import Cancelled, MufasaError
from napari_mufasa.infer.hidden import Hidden

if TYPE_CHECKING:
    from napari_mufasa.traces.dynamics import Dynamics

Array = NDArray[np.float64]
RATES = ("bleaching", "off", "back", "activation")
FACTORS = np.linspace(-0.8, 0.8, 17)  # log of a molecule's brightness over the common one, tried
PER_MEDIAN = 1.4826  # standard deviation over the median distance from the middle, of a normal law
ALIKE = 3 * 1.17  # over √n: three standard errors of that standard deviation (1 in 700), relative
LEAST = 1e-2  # events in all traces: the least a rate can be
MOST_PER_FRAME = 20.0
NUDGE = 1e-6  # of the logarithms, for first derivatives: a level can be known to one in thousands
STEP = 0.5  # standard errors, for second ones
LEAST_BEND = 0.05  # of the log likelihood along any direction, over what the gradients' products say: 1 of a true model
MOST_STEPS, ENOUGH = 60, 2e-3  # steps of a fit, and the log likelihood below which a step ends it


@dataclass(frozen=True)
class Problem:
    """Traces (molecule, frame) of photoelectrons, and the timing.

    least_s : how long a molecule must have shone to be among the traces; None: all molecules are
    """

    traces: Array
    frame_s: float
    dead_s: float
    least_s: float | None

    def log_likelihoods(self, hidden: Hidden, level: float, offset: float, noise: Array, factors: Array) -> Array:
        """(molecule,); `noise`: variance of a dark frame, and what a bright one has more."""
        from napari_mufasa.infer.kernels import log_likelihoods

        found = log_likelihoods(
            self.traces, level * factors, offset, noise[0], noise[1] * factors, hidden.within(self.frame_s),
            hidden.widths, hidden.between(self.dead_s), hidden.start,
        )  # fmt: skip
        if self.least_s is not None:
            movie_s = self.traces.shape[1] * (self.frame_s + self.dead_s)
            found = found - hidden.log_seen(movie_s, self.least_s)
        return np.asarray(found)


@dataclass(frozen=True)
class Fitted:
    """What was fitted: `names`, their `point` (logarithms; the offset and the start as they are), its covariance
    between molecules (0 until `with_errors`), the log likelihood, and (molecule,) brightness over the common one."""

    names: tuple[str, ...]
    point: Array
    covariance: Array
    score: float
    factors: Array

    def log(self, name: str) -> tuple[float, float]:
        """Logarithm of a number, and its standard error."""
        i = self.names.index(name)
        return float(self.point[i]), float(np.sqrt(self.covariance[i, i]))

    def has(self, name: str) -> bool:
        return name in self.names

    def combined(self, **powers: float) -> tuple[float, float]:
        """Logarithm of a product of powers of the numbers, and its standard error."""
        weights = np.array([powers.get(name, 0.0) for name in self.names])
        return float(weights @ self.point), float(np.sqrt(weights @ self.covariance @ weights))


def unpacked(names: tuple[str, ...], point: Array) -> tuple[Hidden, float, float, Array]:
    """The chain, the level of a bright frame, the offset of a dark one, the two variances."""
    at = dict(zip(names, point, strict=True))
    rates = {name: float(np.exp(at[name])) for name in RATES if name in at}
    starts = float(1 / (1 + np.exp(-at["start"]))) if "start" in at else 1.0
    level = float(np.exp(at["level"]))
    offset = float(at["offset"]) * level if "offset" in at else 0.0
    return Hidden(**rates, starts_bright=starts), level, offset, np.exp([at["dark"], at["extra"]])


def fitted(
    problem: Problem, seen: Dynamics, rates: tuple[str, ...], cancel: Callable[[], bool] | None = None,
    factors: Array | None = None,
) -> Fitted:  # fmt: skip
    """Fit level, noise, start and the rates named."""
    names, point, bounds = _start(problem, seen, rates)
    factors = np.ones(len(problem.traces)) if factors is None else factors
    low, high = np.array(bounds).T

    def each(at: Array) -> Array:
        if cancel is not None and cancel():
            raise Cancelled
        return problem.log_likelihoods(*unpacked(names, at), factors)

    # Scoring: steps by the molecules' own gradients, whose products add up to the information.
    now, damping = each(point), 1e-3

    def stepped(step: Array) -> tuple[Array, Array]:
        after = np.clip(point + np.clip(step, -1, 1), low, high)
        return after, each(after)

    for _ in range(MOST_STEPS):
        gradients = np.array([(each(point + u) - now) / NUDGE for u in NUDGE * np.eye(len(names))])
        slope = gradients.sum(axis=1)
        gradients -= gradients.mean(axis=1, keepdims=True)  # far from the best all point the same way
        information = gradients @ gradients.T
        for _ in range(8):
            damped = information + damping * np.diag(np.diag(information) + 1e-6)
            # What lies at its bound and would go beyond it stays; the others do not go with it.
            free = ((point > low) | (slope > 0)) & ((point < high) | (slope < 0))
            step = np.zeros(len(names))
            step[free] = np.linalg.solve(damped[np.ix_(free, free)], slope[free])
            after, then = stepped(step)
            if then.sum() >= now.sum():
                break
            damping = max(10 * damping, 1e-2)
        else:
            break
        # A molecule that fits badly rules the information, and steps by that are far too small.
        while np.abs(step).max() < 1 and (farther := stepped(2 * step))[1].sum() > then.sum():
            step, (after, then) = 2 * step, farther
        gain, point, now, damping = float(then.sum() - now.sum()), after, then, damping / 10
        if gain < ENOUGH and damping <= 1e-2:
            break
    return Fitted(names, point, np.zeros((len(names), len(names))), float(now.sum()), factors)


def with_errors(problem: Problem, seen: Dynamics, found: Fitted) -> Fitted:
    """The fit with the covariance of its point."""
    bounds = _start(problem, seen, tuple(name for name in RATES if found.has(name)))[2]
    return replace(found, covariance=_covariance(problem, found.names, found.point, found.factors, bounds))


def own_factors(problem: Problem, found: Fitted) -> Array:
    """(molecule,) each one's brightness over the common one: its own best, drawn to 1 as far as it is uncertain. All 1
    where the molecules differ no more than `ALIKE` molecules may by chance: factors made of noise take light from the
    level and certainty from its error."""
    hidden, level, offset, noise = unpacked(found.names, found.point)
    n = len(problem.traces)
    tried = np.stack(
        [problem.log_likelihoods(hidden, level, offset, noise, np.full(n, np.exp(f))) for f in FACTORS], axis=1
    )
    best = np.clip(np.argmax(tried, axis=1), 1, len(FACTORS) - 2)
    rows, step = np.arange(n), FACTORS[1] - FACTORS[0]
    left, middle, right = (tried[rows, best + d] for d in (-1, 0, 1))
    curvature = np.maximum((2 * middle - left - right) / step**2, 1e-6)
    own = FACTORS[best] + np.clip((right - left) / (2 * step) / curvature, -step, step)
    error = 1 / curvature
    sure = error < np.median(error) * 9
    # Robust, for a few spots hold two.
    middle_own = float(np.median(own[sure]))
    apart = np.abs(own[sure] - middle_own)
    beyond = PER_MEDIAN * float(np.median(apart / np.sqrt(error[sure]))) - 1
    spread = (PER_MEDIAN * float(np.median(apart))) ** 2 - float(np.median(error[sure]))
    if spread <= 0 or beyond < ALIKE / np.sqrt(sure.sum()):
        return np.ones(n)
    return np.asarray(np.exp((own - middle_own) * spread / (spread + error)))


def _start(
    problem: Problem, seen: Dynamics, rates: tuple[str, ...]
) -> tuple[tuple[str, ...], Array, list[tuple[float, float]]]:
    """Where the fit begins: what the steps of the traces say."""
    shines = seen.on_level > 0
    level = float(np.median(seen.on_level[shines])) if shines.any() else float(problem.traces.std())
    lit, dark = problem.traces[seen.lit], problem.traces[~seen.lit]
    interval = problem.frame_s + problem.dead_s
    bright_s, dark_s = max(seen.lit.sum(), 1) * interval, max((~seen.lit).sum(), 1) * interval
    # Half the squared differences of neighbours, by their median: the noise alone, whatever switches between.
    apart = np.square(np.diff(problem.traces, axis=1)) / 0.91
    both_lit, both_dark = seen.lit[:, 1:] & seen.lit[:, :-1], ~seen.lit[:, 1:] & ~seen.lit[:, :-1]
    v1 = float(np.median(apart[both_lit])) if both_lit.any() else float(np.var(lit))
    v0 = float(np.median(apart[both_dark])) if both_dark.sum() > 20 else v1 / 2
    if not min(v0, v1) > 0:
        raise MufasaError("the traces do not scatter from frame to frame: give them as measured, not idealised")
    n = len(problem.traces)
    guess = {
        "bleaching": max(int((seen.bleaching_frame >= 0).sum()), 0.5) / bright_s,
        "off": max(int(seen.n_blinks.sum()), 0.5) / bright_s,
        "back": max(int(seen.n_blinks.sum()), 0.5) / dark_s,
        "activation": 1 / max(float(np.mean(np.maximum(seen.first, 0.5))) * interval, interval / 2),
    }
    least, most = LEAST / (n * problem.traces.shape[1] * interval), MOST_PER_FRAME / problem.frame_s
    found: dict[str, tuple[float, tuple[float, float]]] = {
        "level": (np.log(level), (np.log(level) - 2, np.log(level) + 2)),
        "dark": (np.log(v0), (np.log(v0) - 6, np.log(v0) + 3)),
        "extra": (np.log(max(v1 - v0, 0.1 * v0)), (np.log(v0) - 7, np.log(v0) + 9)),
    }
    for name in rates:
        found[name] = (np.log(np.clip(guess[name], 2 * least, most / 2)), (np.log(least), np.log(most)))
    if dark.size > 0.05 * problem.traces.size:
        found["offset"] = (0.0, (-0.5, 0.5))
    if "back" in rates or "activation" in rates:
        first = float(np.mean(seen.lit[:, 0]))
        found["start"] = (float(np.log((first + 0.02) / (1.02 - first))), (-7.0, 7.0))
    names = tuple(found)
    return names, np.array([found[n][0] for n in names]), [found[n][1] for n in names]


def _covariance(
    problem: Problem, names: tuple[str, ...], point: Array, factors: Array, bounds: list[tuple[float, float]]
) -> Array:
    """H⁻¹ (Σ g gᵀ) H⁻¹ with each molecule's own gradient g: what resampling the molecules would give. The level is that
    times the molecules' mean factor, which resampling changes, too: what a molecule's factor has taken over is missing
    from its gradient."""

    def each(at: Array) -> Array:
        return problem.log_likelihoods(*unpacked(names, at), factors)

    now = each(point)
    slopes = np.array([(each(point + u) - now) / NUDGE for u in NUDGE * np.eye(len(names))])
    sure = np.sum((slopes - slopes.mean(axis=1, keepdims=True)) ** 2, axis=1)
    steps = np.clip(STEP / np.sqrt(np.maximum(sure, 1e-9)), 1e-5, 0.1)
    # A number that lies at its bound is not known; it must not spoil the others.
    free = np.array([low + 0.05 < p < high - 0.05 or name == "offset"
                     for p, name, (low, high) in zip(point, names, bounds, strict=True)])  # fmt: skip
    unit = np.diag(steps)[free]
    plus, minus = [each(point + u) for u in unit], [each(point - u) for u in unit]
    gradients = np.array([(p - m) / 2 for p, m in zip(plus, minus, strict=True)])
    gradients = gradients - gradients.mean(axis=1, keepdims=True)
    middle = float(now.sum())
    k = int(free.sum())
    curvature = np.empty((k, k))
    for i in range(k):
        curvature[i, i] = 2 * middle - plus[i].sum() - minus[i].sum()
        for j in range(i):
            both = each(point + unit[i] + unit[j]).sum() + each(point - unit[i] - unit[j]).sum()
            one = plus[i].sum() + minus[i].sum() + plus[j].sum() + minus[j].sum()
            curvature[i, j] = curvature[j, i] = -(both - one + 2 * middle) / 2
    # What hardly shows, as the light's own noise on a high background, may bend the likelihood upwards; the gradients'
    # products say how little is known of it without spoiling the others.
    products = gradients @ gradients.T
    if eigh(curvature, products + 1e-9 * np.trace(products) * np.eye(k), eigvals_only=True)[0] < LEAST_BEND:
        curvature = products
    eigen, vectors = np.linalg.eigh(curvature)
    inverse = vectors @ np.diag(1 / np.maximum(eigen, 1e-9 * max(eigen.max(), 1e-30))) @ vectors.T
    influence = np.zeros((len(names), len(problem.traces)))
    influence[free] = steps[free, None] * (inverse @ gradients)
    influence[names.index("level")] += (factors / factors.mean() - 1) / factors.size
    found: Array = influence @ influence.T * factors.size / max(factors.size - 1, 1)
    found[~free, ~free] = 25.0
    return found
