"""What free values do to the observables: differences of paired simulations."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.discover.coordinates import Coordinate
from napari_mufasa.discover.nuisance import Nuisance
from napari_mufasa.discover.rules import PARAMETER_STEP, SLOPE_SEEDS
from napari_mufasa.model.model import Model

Array = NDArray[np.float64]
Rows = Callable[[Sequence[tuple[Model, int]]], Array]


def free_steps(model: Model, values: Sequence[Nuisance], free: Sequence[str]) -> list[float]:
    """The step of each free value for its derivative, within its range."""
    effects = {effect.kind: effect for effect in model.effects}
    steps = [n.inward(model, n.step if j % 2 else -n.step) for j, n in enumerate(values)]
    for path in free[len(values) :]:
        kind, name = path.rsplit(".", 1)
        coordinate = next(c for c in Coordinate.of(effects[kind], model) if c.name == name)
        steps.append(coordinate.inward(effects[kind], PARAMETER_STEP))
    return steps


def derivatives(rows_of: Rows, model_at: Callable[[Array], Model], steps: list[float], base: Array) -> Array:
    """Derivatives of the observables (part, observable, free value), by differences of paired simulations.

    rows_of : simulates (model, seed number) jobs · base (simulation, part, observable) : what they are paired with
    """
    jobs = [(model_at(by), k) for by in np.diag(steps) for k in range(SLOPE_SEEDS)]
    rows = rows_of(jobs).reshape(len(steps), SLOPE_SEEDS, *base.shape[1:])
    change = rows - base[:SLOPE_SEEDS]
    mean, variance = change.mean(axis=1), change.var(axis=1, ddof=1) / SLOPE_SEEDS
    return np.moveaxis(mean * trusted(mean, variance) / np.array(steps)[:, None, None], 0, -1)


def trusted(derivative: Array, variance: Array) -> Array:
    """The share of a derivative that stands out from its own error: the rest is noise, drawn towards zero."""
    share: Array = np.clip(1 - 2 * variance / np.maximum(derivative**2, 1e-300), 0.0, 1.0)
    return share
