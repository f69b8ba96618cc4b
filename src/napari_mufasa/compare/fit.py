"""A quick fit by moments: what a comparison needs so that a wrong brightness is not read as wrong physics.

Fitted in this order, each from one number of the traces: background (local background level), bleaching
(share of molecules bleached by the end), brightness (mean on level), spread of brightness (spread of on
levels beyond that of the simulation). The elaborate fit, with every effect and its evidence, is `discover`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.effects.base import effect_from_data
from napari_mufasa.model import Model
from napari_mufasa.traces import TraceSet
from napari_mufasa.traces.select import Dynamics, dynamics

ROUNDS = 3


@dataclass(frozen=True)
class Fit:
    """The fitted model and the fitted values by name (dotted model path or effect.parameter)."""

    model: Model
    values: dict[str, float]


def fit_model(
    measured: TraceSet | NDArray[np.floating],
    model: Model,
    simulate: Callable[[Model], Any],
    *,
    background_subtracted: bool = True,
    rounds: int = ROUNDS,
) -> Fit:
    """Fit brightness, background, bleaching rate and spread of brightness by moments (SPEC.md §7).

    `simulate` gives the traces of a model through the same chain as the measurement: a `TraceSet`, or an
    array (molecule, frame) when `measured` is one.
    """
    values: dict[str, float] = {}
    fitted = model
    if isinstance(measured, TraceSet):
        fitted = _with_background(fitted, measured.background_e, values)
    elif not background_subtracted:
        # Traces alone do not tell background from light: the dimmest trace bounds it.
        lowest = float(np.percentile(np.asarray(measured).mean(axis=1), 1))
        ceiling = model.camera.quantum_efficiency * model.optics.background_photons_per_px
        fitted = _with_background(fitted, min(ceiling, 0.9 * lowest), values)
    offset = 0.0 if background_subtracted else _background_e(fitted)
    real = _moments(measured, offset)
    fitted = _with_bleaching(fitted, real, values)
    for _ in range(rounds):
        made = _moments(simulate(fitted), offset)
        ratio = real.level / made.level if made.n else 2.0  # nothing detected: brighten until something is
        factor = float(np.clip(fitted.optics.brightness_correction * np.clip(ratio, 0.1, 10.0), 1e-4, 1e5))
        fitted = fitted.with_values({"optics.brightness_correction": factor})
        values["optics.brightness_correction"] = factor
        if made.n > 1:
            fitted = _with_spread(fitted, real, made, values)
    return Fit(fitted, values)


@dataclass(frozen=True)
class _Moments:
    n: int
    level: float
    spread: float  # relative, between molecules
    bleached: float  # share by the end
    n_frames: int


def _moments(traces: Any, offset_e: float) -> _Moments:
    array = np.asarray(traces.traces if isinstance(traces, TraceSet) else traces, dtype=float) - offset_e
    if len(array) == 0:
        return _Moments(0, 0.0, 0.0, 0.0, array.shape[1])
    dyn: Dynamics = dynamics(array)
    on = dyn.on_level[dyn.on_level > 0]
    if len(on) == 0:
        return _Moments(0, 0.0, 0.0, 0.0, array.shape[1])
    return _Moments(
        len(on),
        float(on.mean()),
        float(on.std() / on.mean()),
        float(np.mean(dyn.bleaching_frame >= 0)),
        array.shape[1],
    )


def _with_background(model: Model, background_e: float, values: dict[str, float]) -> Model:
    camera = model.camera
    photons = max(0.0, (background_e - camera.clock_induced_charge_e) / camera.quantum_efficiency)
    values["optics.background_photons_per_px"] = photons
    return model.with_values({"optics.background_photons_per_px": photons})


def _with_bleaching(model: Model, real: _Moments, values: dict[str, float]) -> Model:
    """The rate at which the measured share has bleached by the end; the model's own bleaching is replaced."""
    share = min(real.bleached, 1 - 0.5 / max(real.n, 1))
    seconds = real.n_frames * model.acquisition.interval_s
    rate = -np.log1p(-share) / seconds
    values["photobleaching.rate_per_s"] = float(rate)
    plain = model.with_values({"fluorophore.cycles_before_bleaching": None})
    kept = tuple(effect for effect in plain.effects if effect.kind != "photobleaching")
    plain = plain.model_copy(update={"effects": kept})
    if rate <= 0:
        return plain
    exposure = model.acquisition.frame_length_s / model.acquisition.interval_s
    return plain.with_effects(effect_from_data({"kind": "photobleaching", "rate_per_s": float(rate / exposure)}))


def _with_spread(model: Model, real: _Moments, made: _Moments, values: dict[str, float]) -> Model:
    """Add what is missing of the spread of levels, in quadrature, to what the model has already."""
    have = next((e.spread for e in model.effects if e.kind == "brightness_heterogeneity"), 0.0)  # type: ignore[attr-defined]
    spread = float(np.sqrt(max(0.0, have**2 + real.spread**2 - made.spread**2)))
    values["brightness_heterogeneity.spread"] = spread
    return model.with_effects(effect_from_data({"kind": "brightness_heterogeneity", "spread": min(spread, 3.0)}))


def _background_e(model: Model) -> float:
    camera = model.camera
    return camera.quantum_efficiency * model.optics.background_photons_per_px + camera.clock_induced_charge_e
