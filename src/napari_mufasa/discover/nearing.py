"""How a model's free values are brought near a measurement: by moments, and downhill, every step simulated."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.discover import nuisance
from napari_mufasa.discover.bench import Bench, as_table
from napari_mufasa.discover.coordinates import Coordinate
from napari_mufasa.model import Model

if TYPE_CHECKING:
    from napari_mufasa.discover.library import Library, State

Array = NDArray[np.float64]
MATCHING_SEED = 10_000
MATCHING_ROUNDS = 4
TRIALS = 4  # simulations that tell which of two models is nearer
SLOPE_SEEDS = 3
PARAMETER_STEP = 0.2  # of effects in the model, in log units or quarters of the range
DESCENTS, SHARES = 4, (1.0, 0.5, 0.25)  # steps downhill, and how much of each is tried
NEARER = 0.97  # of the misfit: another step downhill is worth its simulations


def matched(bench: Bench, model: Model) -> Model:
    """The model with its molecules as far apart as the spots tell, its nuisance values brought near the measurement by
    moments."""
    measured, spots = as_table(bench.names, bench.measured.part("all")), bench.measured.spots
    height, width = model.acquisition.shape_px
    model = nuisance.spaced(model, spots.positions_px, height * width)
    model = nuisance.with_molecules(model, 1.15 * measured["spots"] ** 2)
    for turn in range(MATCHING_ROUNDS):
        rows = bench.rows([(model, MATCHING_SEED + 10 * turn + k) for k in range(2)])
        model = nuisance.match(model, measured, as_table(bench.names, rows[:, 0].mean(axis=0)))
    return model


def rematched(library: Library, state: State, model: Model, x: Array) -> Model:
    """The model, or the same with its nuisance values matched again: whichever a few simulations put nearer to the
    measurement x. Hidden effects can lead the first match astray: a pattern of the sensor passes for dim molecules.

    Either keeps within reach of the first match. Where much is wrong, matching has no end of its own: spots that equal
    molecules cannot make are looked for in ever more of them, until they merge."""
    found = [nuisance.kept(m, state.values) for m in (model, matched(library.bench, model))]
    return min(found, key=lambda candidate: _seen(library, state, candidate).misfit(x))


def descended(library: Library, state: State, model: Model, x: Array) -> Model:
    """The model with its free values moved downhill towards the measurement x, derivatives taken anew at every step,
    as far as simulations of where the step leads confirm it.

    Far from a measurement a model is not linear in its values, and what they promise there is not to be had."""
    here = _seen(library, state, model)
    for _ in range(DESCENTS):
        steps = free_steps(here.model, here.values, here.free)
        slopes = derivatives(library.bench, here.moved, steps, here.check)
        moves = replace(here, slopes=slopes).profiled(x).moves
        for share in SHARES:
            there = _seen(library, here, here.moved(share * moves))
            nearer = _unmoved(there, x) < NEARER * _unmoved(here, x)
            if nearer:
                break
        if not nearer:
            break
        here = there
    return here.model


def _seen(library: Library, state: State, model: Model) -> State:
    """The state with the model in its place, its mean by a few simulations."""
    rows = library.bench.rows([(model, k) for k in range(TRIALS)])
    shift = (rows - library.rows[:TRIALS]).mean(axis=0)
    return replace(state, model=model, mean=library.base.mean + shift, check=rows)


def _unmoved(state: State, x: Array) -> float:
    """The misfit of the model as it is."""
    return replace(state, slopes=np.zeros_like(state.slopes)).misfit(x)


def free_steps(model: Model, values: Sequence[nuisance.Nuisance], free: Sequence[str]) -> list[float]:
    """The step of each free value for its derivative, within its range."""
    effects = {effect.kind: effect for effect in model.effects}
    steps = [n.inward(model, n.step if j % 2 else -n.step) for j, n in enumerate(values)]
    for path in free[len(values) :]:
        kind, name = path.rsplit(".", 1)
        coordinate = next(c for c in Coordinate.of(effects[kind], model) if c.name == name)
        steps.append(coordinate.inward(effects[kind], PARAMETER_STEP))
    return steps


def derivatives(bench: Bench, model_at: Callable[[Array], Model], steps: list[float], base: Array) -> Array:
    """Derivatives of the observables (part, observable, free value), by differences of paired simulations."""
    jobs = [(model_at(by), k) for by in np.diag(steps) for k in range(SLOPE_SEEDS)]
    rows = bench.rows(jobs).reshape(len(steps), SLOPE_SEEDS, *base.shape[1:])
    change = rows - base[:SLOPE_SEEDS]
    mean, variance = change.mean(axis=1), change.var(axis=1, ddof=1) / SLOPE_SEEDS
    return np.moveaxis(mean * trusted(mean, variance) / np.array(steps)[:, None, None], 0, -1)


def trusted(derivative: Array, variance: Array) -> Array:
    """The share of a derivative that stands out from its own error: the rest is noise, drawn towards zero."""
    share: Array = np.clip(1 - 2 * variance / np.maximum(derivative**2, 1e-300), 0.0, 1.0)
    return share


def rematching_simulations() -> int:
    """How many simulations `rematched` makes."""
    return 2 * MATCHING_ROUNDS + 2 * TRIALS


def descending_simulations(n_free: int) -> int:
    """How many simulations `descended` makes at most."""
    return TRIALS + DESCENTS * (SLOPE_SEEDS * n_free + TRIALS * len(SHARES))
