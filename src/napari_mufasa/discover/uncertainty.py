"""How uncertain fitted values are: how fits scatter, and how far they follow values that move.

A slope from a few simulations is part noise, and noise in what is fitted with draws estimates towards where the model
stands (errors in variables: Fuller, Measurement Error Models, 1987, section 1.1). An estimate that goes half the way
that the truth goes scatters half as much as it is uncertain.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import hadamard

from napari_mufasa.discover.coordinates import Coordinate
from napari_mufasa.discover.library import Library
from napari_mufasa.discover.rules import ASKED_PRIOR, FINITE, FOLLOWED, LEAST_FOLLOWED, LINEAR
from napari_mufasa.discover.state import State
from napari_mufasa.one_thread import one_thread

Array = NDArray[np.float64]


def parameters_sd(library: Library, birge: float) -> dict[str, dict[str, float]]:
    """Standard deviations of the free parameters of each effect of the library's model, `birge` times what
    simulations of the model say, and that of their finite number."""
    state, n = library.base, len(library.base.values)
    effects = {effect.kind: effect for effect in state.model.effects}
    found: dict[str, dict[str, float]] = {path.rsplit(".", 1)[0]: {} for path in state.free[n:]}
    if not found:
        return found
    widths = coordinates_sd(library) * birge
    for path, sd in zip(state.free[n:], widths[n:], strict=True):
        kind, name = path.rsplit(".", 1)
        coordinate = next(c for c in Coordinate.of(effects[kind], state.model) if c.name == name)
        finite = FINITE * abs(float(getattr(effects[kind], name)))
        found[kind][name] = float(np.hypot(coordinate.sd(effects[kind], float(sd)), finite))
    return found


def coordinates_sd(library: Library) -> Array:
    """(value,) standard deviations of the free values: by how much fits of simulations of the model scatter, at least
    what the linear theory says, over how far fits follow; and no more than the prior allows."""
    loose = _loose(library.base)
    fits = np.array([loose.adjusted(row).moves for row in (*library.rows, *loose.check)])
    widths = np.maximum(fits.std(axis=0, ddof=1), _linear_sd(loose))
    known = _followed(library, loose, fits, widths) / widths
    result: Array = 1 / np.sqrt(known**2 + 1 / loose.prior**2)
    return result


@one_thread
def _linear_sd(state: State) -> Array:
    """(value,) what the linear theory says."""
    slope = state.whiten[0] @ (state.slopes[0] / state.spread[0][:, None])
    result: Array = np.sqrt(np.diag(np.linalg.inv(slope.T @ slope + np.diag(1 / state.prior**2))))
    return result


def _followed(library: Library, loose: State, fits: Array, widths: Array) -> Array:
    """(value,) the share of the way that each value moves which its estimate moves, by paired simulations with all
    values moved at once, by two `widths` to either side and no farther than a model is about linear (by rows of a
    Hadamard matrix, so that no value answers for another)."""
    n = len(widths)
    signs = hadamard(max(FOLLOWED, 1 << n.bit_length()))[:, 1 : n + 1]
    step = np.minimum(2 * widths, LINEAR)
    low, high = (np.clip(by, *loose.room) for by in (-step, step))
    numbers = np.arange(len(signs)) % len(library.rows)
    moves = np.where(signs > 0, high, low)
    rows = library.simulated([(loose.model_at(by), int(k)) for by, k in zip(moves, numbers, strict=True)])
    answers = np.array([loose.adjusted(row).moves for row in rows]) - fits[numbers]
    way = (high - low) / 2
    share = (signs * answers).mean(axis=0) / np.maximum(way, 1e-12)
    result: Array = np.where(way > 0, np.clip(share, LEAST_FOLLOWED, 1.0), 1.0)
    return result


def _loose(state: State) -> State:
    """The state with wide priors of the parameters of effects."""
    n = len(state.values)
    return replace(state, prior=np.concatenate([state.prior[:n], np.full(len(state.free) - n, ASKED_PRIOR)]))
