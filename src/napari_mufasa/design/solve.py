"""Solving a design: the value at which the predictions meet what is wanted, by one root-finding over `predict`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from napari_mufasa import checks
from napari_mufasa.design.predict import SATURATES, Prediction, numbers, predict
from napari_mufasa.errors import MufasaError
from napari_mufasa.model.model import Model

if TYPE_CHECKING:
    from collections.abc import Callable

POWER, EXPOSURE = "excitation.power_density_w_per_cm2", "acquisition.frame_length_s"
#: Of these less is better: a target is the most there may be. Of all others it is the least.
LESS_IS_BETTER = ("localisation_nm", "bleached_by_the_end", "w1_floor_e", "smallest_change", "dark_time_s", "movie_s")
DECADES, STEPS = 5.0, 200  # looked through to either side of the value that the model has, and in how many steps
QUANTITIES = tuple(field.name for field in fields(Prediction))


@dataclass(frozen=True)
class Solution:
    """Where one value of a model meets its targets.

    Attributes
    ----------
    vary : dotted path of the value
    model : with the value at which the first target is just met
    prediction : of that model
    ranges : by target, the stretches of the value in which it is met: ((low, high), …); a stretch ends where the
        values looked through end, are no longer allowed, or cut off the brightest pixel
    together : the stretches in which all are met; () where they exclude each other
    """

    vary: str
    model: Model
    prediction: Prediction
    ranges: dict[str, tuple[tuple[float, float], ...]]
    together: tuple[tuple[float, float], ...]
    targets: dict[str, float]

    @property
    def value(self) -> float:
        part, name = self.vary.split(".")
        return float(getattr(getattr(self.model, part), name))

    @property
    def met(self) -> dict[str, bool]:
        """By target, whether `model` meets it (to one part in a thousand)."""
        return {
            name: _excess(getattr(self.prediction, name), name, wanted) > -1e-3 for name, wanted in self.targets.items()
        }


def solve(model: Model, targets: Mapping[str, float], vary: str = POWER) -> Solution:
    """Change one value of a model until it is predicted to give what is wanted.

    ``solve(model, {"snr_spot": 5, "frames_before_bleaching": 200}).model`` has the power at which SNR 5 is just
    reached; `ranges` and `together` say whether 200 frames can be had as well.

    Parameters
    ----------
    targets : by the name of a `Prediction`, the least that is wanted; the most for those of `LESS_IS_BETTER`
    vary : dotted path of the number that may change (`design.numbers`), everything else stays: background per pixel
        and frame, too, whatever the exposure

    Raises
    ------
    MufasaError : unknown names; a first target that no value meets or that all meet.
    """
    checks.need(model, Model, "model", "give preset(NAME) or Model.from_json(PATH)")
    checks.need(targets, Mapping, "targets", "give a dictionary, as {'snr_spot': 5}")
    if vary not in numbers():
        raise MufasaError(f"{vary} is no number of a model: choose one of {', '.join(numbers())}")
    if not targets:
        raise MufasaError("no target: give at least one, as snr_spot = 5")
    wanted = {
        checks.choice(name, "target", QUANTITIES): checks.number(value, name, 1e-300) for name, value in targets.items()
    }
    values = _values(model, vary)
    at = {value: _predicted(model, vary, value) for value in values}
    allowed = [value for value in values if at[value] is not None]
    if len(allowed) < 2:
        raise MufasaError(f"{vary} cannot be changed in this model: no other value is allowed")

    def told_at(value: float) -> Prediction | None:
        return at[value] if value in at else _predicted(model, vary, value)

    def excess(name: str, most: float = SATURATES) -> Callable[[float], float]:
        def of(value: float) -> float:
            told = told_at(value)
            if told is None or (told.headroom_sd < most and name != "headroom_sd"):
                return -np.inf
            return _excess(getattr(told, name), name, wanted[name])

        return of

    def is_held(value: float) -> bool:
        """Does the camera hold the brightest pixel?"""
        told = told_at(value)
        return told is not None and told.headroom_sd >= SATURATES

    ranges = {name: _met(allowed, excess(name), vary) for name in wanted}
    first = next(iter(wanted))
    met = _met(allowed, excess(first, -np.inf), vary)
    edges = [edge for stretch in met for edge in stretch if allowed[0] < edge < allowed[-1]]
    edges = [edge for edge in edges if first == "headroom_sd" or is_held(edge)]
    if not edges:
        reached = [getattr(told, first) for value in allowed if is_held(value) and (told := at[value]) is not None]
        seen = [r for r in reached if r is not None]
        span = f"{min(seen):.3g} to {max(seen):.3g}" if seen else "nothing"
        less = first in LESS_IS_BETTER
        tried = f"{vary} from {allowed[0]:.3g} to {allowed[-1]:.3g}"
        if ranges[first]:
            raise MufasaError(f"{first} = {wanted[first]:g} is met throughout: {tried} gives {span}; ask for more")
        best = "" if not seen else f"; at {'least' if less else 'most'} {(min if less else max)(seen):.3g}"
        full = [value for value in allowed if not is_held(value)]
        best += f" where no pixel is cut off (at {full[0]:.3g} to {full[-1]:.3g} the brightest is)" if full else ""
        raise MufasaError(
            f"{first} = {wanted[first]:g} cannot be reached{best}: {tried} was looked through; vary another value"
        )
    now = _now(model, vary)
    chosen = min(edges, key=lambda edge: abs(np.log(edge / now)))
    found = model.with_values({vary: _typed(vary, chosen)})
    return Solution(vary, found, predict(found), ranges, _together(list(ranges.values())), wanted)


def _now(model: Model, vary: str) -> float:
    part, name = vary.split(".")
    return float(getattr(getattr(model, part), name) or 0.0) or 1.0  # from a value of 0 or none: around 1


def _values(model: Model, vary: str) -> list[float]:
    """The values looked through, from small to large."""
    spread = _now(model, vary) * np.logspace(-DECADES, DECADES, 2 * STEPS + 1)
    return sorted({float(_typed(vary, value)) for value in spread})


def _typed(vary: str, value: float) -> float | int:
    return round(value) if numbers()[vary] is int else float(value)


def _predicted(model: Model, vary: str, value: float) -> Prediction | None:
    """None where the model does not allow the value."""
    try:
        return predict(model.with_values({vary: _typed(vary, value)}))
    except MufasaError:
        return None


def _excess(reached: float | None, name: str, wanted: float) -> float:
    """log of what is reached over what is wanted, from 0 on it is met. What a model does not have is met where less is
    better, and where it never ends (no bleaching); else it is not."""
    if reached is None:
        never_ends = name in LESS_IS_BETTER or "bleaching" in name or name in ("on_time_s", "detected_e_per_visit")
        return np.inf if never_ends and name != "localisation_nm" else -np.inf
    ratio = np.log(reached / wanted) if reached > 0 else -np.inf
    return float(-ratio if name in LESS_IS_BETTER else ratio)


def _met(values: list[float], excess: Callable[[float], float], vary: str) -> tuple[tuple[float, float], ...]:
    from scipy.optimize import brentq

    stretches: list[tuple[float, float]] = []
    is_met = [excess(value) >= 0 for value in values]
    start = values[0] if is_met[0] else None
    for (low, high), (before, after) in zip(pairwise(values), pairwise(is_met), strict=True):
        if before == after:
            continue
        if numbers()[vary] is int:
            edge = high if after else low
        elif np.isfinite(excess(low)) and np.isfinite(excess(high)):
            edge = float(brentq(excess, low, high, xtol=1e-12 * high, rtol=1e-10))
        else:
            edge = high if after else low
        if after:
            start = edge
        elif start is not None:
            stretches.append((start, edge))
            start = None
    if start is not None:
        stretches.append((start, values[-1]))
    return tuple(stretches)


def _together(ranges: list[tuple[tuple[float, float], ...]]) -> tuple[tuple[float, float], ...]:
    """Where all are met."""
    found = ranges[0]
    for other in ranges[1:]:
        found = tuple((max(a, c), min(b, d)) for a, b in found for c, d in other if max(a, c) <= min(b, d) * (1 + 1e-9))
    return found
