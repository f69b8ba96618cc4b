"""Fit one effect by direct simulation: the emulator proposes, the simulator disposes.

Around the current parameters a handful of paired simulations give the local mean and slopes; free values of
model and effect move together; twice; then fresh simulations at the end point judge it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.discover import nuisance
from napari_mufasa.discover.library import CHECK_SEED, CHECK_SIMULATIONS, Library, State, changed
from napari_mufasa.effects import Effect
from napari_mufasa.model import Model

Array = NDArray[np.float64]
ROUNDS = ((9, 0.45), (9, 0.2))  # simulations and spread of the parameters (log units or quarters of the range)
FINITE = 0.03  # relative uncertainty of a parameter from the finite number of simulations it is fitted with
PRIOR_SIMULATIONS = 6.0  # the base model's spread counts as so many simulations


@dataclass(frozen=True)
class Coordinate:
    """A parameter of an effect as a free coordinate."""

    name: str
    log: bool
    unit: float
    low: float
    high: float

    @classmethod
    def of(cls, effect: Effect, model: Model) -> list[Coordinate]:
        """Shapes stay in their plausible range, for beyond it the effect is another; strengths may leave it."""
        found = []
        for name, (low, high, log) in type(effect).plausible(model).items():
            unit = 1.0 if log else (high - low) / 4
            if name == effect.strength:
                low, high = (low / 10, high * 4) if log else (low - (high - low), high + (high - low))
            found.append(cls(name, log, unit, low, high))
        return found

    def moved(self, effect: Effect, by: float) -> float:
        value = float(getattr(effect, self.name))
        new = value * float(np.exp(by)) if self.log else value + by * self.unit
        return float(np.clip(new, self.low, self.high))

    def sd(self, effect: Effect, sd: float) -> float:
        """A standard deviation of the coordinate in the parameter's own unit."""
        return sd * (abs(float(getattr(effect, self.name))) if self.log else self.unit)


@dataclass(frozen=True)
class Fit:
    """An effect fitted into a state: the state with it, the effect, its parameters' standard deviations."""

    state: State
    effect: Effect
    sd: dict[str, float]
    score: float
    misfit: float


def planned_simulations() -> int:
    return sum(n for n, _ in ROUNDS) + CHECK_SIMULATIONS


def refine(library: Library, state: State, start: Effect, x: Array) -> Fit:
    """Fit `start` into `state` so that it explains the measurement x (part, observable)."""
    bench = library.bench
    seen = start.read_off(bench.measured)
    start = changed(start, seen)
    coordinates = [c for c in Coordinate.of(start, state.model) if c.name not in seen]
    n = len(coordinates)
    model = state.model.with_effects(start)
    free = (*state.free, *(f"{start.kind}.{c.name}" for c in coordinates))
    local = state
    for turn, (n_rows, width) in enumerate(ROUNDS):
        effect = model.effects[-1]
        offsets = _design(n_rows, n, width, np.random.default_rng([bench.seed, turn]))
        settings = [{c.name: c.moved(effect, b) for c, b in zip(coordinates, by, strict=True)} for by in offsets]
        rows = bench.rows([(model.with_effects(changed(effect, s)), k) for k, s in enumerate(settings)])
        shift = rows - library.rows[:n_rows]
        centre, slopes = _regress(offsets, shift)
        wild = shift - centre - np.einsum("kd,pod->kpo", offsets, slopes)
        local = replace(
            state,
            model=model,
            mean=library.base.mean + centre,
            spread=np.sqrt(library.base.spread**2 + (wild**2).sum(axis=0) / (n_rows + PRIOR_SIMULATIONS)),
            slopes=np.concatenate([state.slopes, slopes], axis=2),
            prior=np.concatenate([state.prior, np.full(n, 2.5 * width)]),
            free=free,
        )
        model = moved(model, library.nuisances, free, local.profiled(x).moves)
    return judge(library, replace(local, model=model), x, n)


def moved(model: Model, values: list[nuisance.Nuisance], free: tuple[str, ...], moves: Array) -> Model:
    """The model with its free values moved: nuisance values first, then parameters of effects."""
    effects = {effect.kind: effect for effect in model.effects}
    model = nuisance.apply(model, values, moves[: len(values)])
    for path, by in zip(free[len(values) :], moves[len(values) :], strict=True):
        kind, name = path.split(".")
        coordinate = next(c for c in Coordinate.of(effects[kind], model) if c.name == name)
        effects[kind] = changed(effects[kind], {name: coordinate.moved(effects[kind], float(by))})
    return model.model_copy(update={"effects": tuple(effects.values())})


def judge(library: Library, local: State, x: Array, n_effect: int) -> Fit:
    """Fresh simulations of the fitted model: its mean, its spread, its score."""
    effect = local.model.effects[-1]
    rows = library.bench.rows([(local.model, CHECK_SEED + k) for k in range(CHECK_SIMULATIONS)])
    # Paired with the base model's simulations of the same seeds: the mean is as precise as the base's.
    mean = library.base.mean + (rows - library.base.check).mean(axis=0)
    wild = rows - rows.mean(axis=0)
    variance = (PRIOR_SIMULATIONS * library.base.spread**2 + (wild**2).sum(axis=0)) / (
        PRIOR_SIMULATIONS + len(rows) - 1
    )
    spread = np.maximum(np.sqrt(variance), local.least_spread)
    prior = np.concatenate([local.prior[: len(local.prior) - n_effect], np.full(n_effect, 0.3)])
    state = replace(local, mean=mean, spread=spread, check=rows, prior=prior)
    slope = state.whiten[0] @ (state.slopes[0] / spread[0][:, None])
    loose = np.concatenate([local.prior[: len(local.prior) - n_effect], np.full(n_effect, 3.0)])
    covariance = np.linalg.inv(slope.T @ slope + np.diag(1 / loose**2))
    misfit = state.misfit(x)
    excess = max(1.0, misfit / len(library.bench.names))
    sd = np.sqrt(np.diag(covariance)[len(loose) - n_effect :] * excess)
    named = {}
    for path, s in zip(local.free[len(loose) - n_effect :], sd, strict=True):
        coordinate = next(c for c in Coordinate.of(effect, local.model) if f"{effect.kind}.{c.name}" == path)
        by_noise, by_simulation = coordinate.sd(effect, float(s)), FINITE * abs(float(getattr(effect, coordinate.name)))
        named[coordinate.name] = float(np.hypot(by_noise, by_simulation))
    return Fit(state, effect, named, state.score(x), misfit)


def _design(n: int, dimensions: int, width: float, rng: np.random.Generator) -> Array:
    """Settings around the centre (n, dimensions): balanced, uncorrelated signs, first one at the centre."""
    if dimensions == 0:
        return np.zeros((n, 0))
    signs = np.array([[(-1) ** (k >> d & 1) for d in range(dimensions)] for k in range(n)], dtype=float)
    jitter = rng.uniform(0.6, 1.2, signs.shape)
    signs[0] = 0.0
    return signs * jitter * width


def _regress(offsets: Array, shift: Array) -> tuple[Array, Array]:
    """Linear fit of shift (k, part, observable) on offsets (k, d): value at the centre, slopes (…, d)."""
    k, d = offsets.shape
    design = np.concatenate([np.ones((k, 1)), offsets], axis=1)
    gram = design.T @ design + np.diag([0.0, *np.full(d, 1e-3)])
    solution = np.linalg.solve(gram, np.einsum("kd,kpo->dpo", design, shift).reshape(d + 1, -1))
    solution = solution.reshape(d + 1, *shift.shape[1:])
    return solution[0], np.moveaxis(solution[1:], 0, -1)
