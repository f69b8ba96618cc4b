"""How the free values of a model with effects are brought nearer to a measurement, every step simulated."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.discover import nuisance
from napari_mufasa.discover.bench import Bench
from napari_mufasa.discover.derivatives import SLOPE_SEEDS, derivatives, free_steps
from napari_mufasa.discover.library import Library
from napari_mufasa.discover.state import State
from napari_mufasa.model.model import Model

Array = NDArray[np.float64]
TRIALS = 4  # simulations that tell which of two models is nearer
DESCENTS, SHARES = 4, (1.0, 0.5, 0.25)  # steps downhill, and how much of each is tried
NEARER = 0.97  # of the misfit: another step downhill is worth its simulations


def nearer(library: Library, state: State, model: Model, x: Array) -> Model:
    """The model, or the same with its nuisance values matched again: whichever a few simulations put nearer to the
    measurement x. Hidden effects can lead the first match astray: a pattern of the sensor passes for dim molecules.

    Either keeps within reach of the first match. Where much is wrong, matching has no end of its own: spots that equal
    molecules cannot make are looked for in ever more of them, until they merge."""
    found = [nuisance.kept(m, state.values) for m in (model, library.bench.matched(model))]
    return min(found, key=lambda candidate: _seen(library, state, candidate).misfit(x))


def descended(library: Library, state: State, model: Model, x: Array) -> Model:
    """The model with its free values moved downhill towards the measurement x, derivatives taken anew at every step,
    as far as simulations of where the step leads confirm it.

    Far from a measurement a model is not linear in its values, and what they promise there is not to be had."""
    here = _seen(library, state, model)
    for _ in range(DESCENTS):
        steps = free_steps(here.model, here.values, here.free)
        slopes = derivatives(library.simulated, here.model_at, steps, here.check)
        moves = replace(here, slopes=slopes).adjusted(x).moves
        for share in SHARES:
            there = _seen(library, here, here.model_at(share * moves))
            nearer = _unmoved(there, x) < NEARER * _unmoved(here, x)
            if nearer:
                break
        if not nearer:
            break
        here = there
    return here.model


def _seen(library: Library, state: State, model: Model) -> State:
    """The state with the model in its place, its mean by a few simulations."""
    rows = library.simulated([(model, k) for k in range(TRIALS)])
    shift = (rows - library.rows[:TRIALS]).mean(axis=0)
    return replace(state, model=model, mean=library.base.mean + shift, check=rows)


def _unmoved(state: State, x: Array) -> float:
    """The misfit of the model as it is."""
    return replace(state, slopes=np.zeros_like(state.slopes)).misfit(x)


def nearing_simulations(bench: Bench[Any]) -> int:
    """How many simulations `nearer` makes."""
    return bench.matching_simulations + 2 * TRIALS


def descending_simulations(n_free: int) -> int:
    """How many simulations `descended` makes at most."""
    return TRIALS + DESCENTS * (SLOPE_SEEDS * n_free + TRIALS * len(SHARES))
