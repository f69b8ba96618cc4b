"""What a diagnosis may move: nuisance values of the model, and the parameters of its effects, as free coordinates.

A coordinate's path is that of a nuisance value ("camera.baseline_adu") or "effect.parameter"; in every list the
nuisance values come first. 0 is where the model stands.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.discover import nuisance
from napari_mufasa.discover.nuisance import Nuisance
from napari_mufasa.discover.rules import AT_AN_END
from napari_mufasa.effects import Effect
from napari_mufasa.model.model import Model

Array = NDArray[np.float64]


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
        """Shapes stay in their plausible range, for beyond it the effect is another; strengths may leave it. What does
        not matter to the effect's form is not free."""
        found = []
        for name, (low, high, log) in type(effect).plausible(model).items():
            if not effect.matters(name) or (log and getattr(effect, name) <= 0):
                continue
            unit = 1.0 if log else (high - low) / 4
            if name == effect.strength:
                low, high = (low / 10, high * 4) if log else (low - (high - low), high + (high - low))
            least, most = hard_limits(effect, name)
            found.append(cls(name, log, unit, max(low, least), min(high, most)))
        return found

    def value_at(self, effect: Effect, by: float) -> float:
        value = float(getattr(effect, self.name))
        return self.kept(value * float(np.exp(by)) if self.log else value + by * self.unit, value)

    def kept(self, new: float, value: float) -> float:
        """A new value kept within the range, where the value is not beyond that already."""
        return float(np.clip(new, min(self.low, value), max(self.high, value)))

    def room(self, effect: Effect) -> tuple[float, float]:
        """How far the coordinate may move down and up: its range, and where it stands if that is beyond."""
        value = float(getattr(effect, self.name))
        low, high = min(self.low, value), max(self.high, value)
        if self.log:
            return float(np.log(low / value)), float(np.log(high / value))
        return (low - value) / self.unit, (high - value) / self.unit

    def inward(self, effect: Effect, step: float) -> float:
        """A step of that size that the range does not cut short."""
        here = float(getattr(effect, self.name))
        there, back = abs(self.value_at(effect, step) - here), abs(self.value_at(effect, -step) - here)
        return step if there >= 0.99 * back else -step

    def sd(self, effect: Effect, sd: float) -> float:
        """A standard deviation of the coordinate in the parameter's own unit: upwards, where a logarithm is uncertain
        to either side alike."""
        return float(np.expm1(sd) if self.log else sd) * self._unit_at(effect)

    def steps(self, effect: Effect, sd: float) -> float:
        """A standard deviation of the parameter in the coordinate's unit."""
        share = sd / self._unit_at(effect)
        return float(np.log1p(share)) if self.log else share

    def _unit_at(self, effect: Effect) -> float:
        return abs(float(getattr(effect, self.name))) if self.log else self.unit


def model_at(model: Model, values: Sequence[Nuisance], free: Sequence[str], moves: Array) -> Model:
    """The model with its free values moved: nuisance values first, then parameters of effects."""
    effects = {effect.kind: effect for effect in model.effects}
    model = nuisance.apply(model, values, moves[: len(values)])
    for path, by in zip(free[len(values) :], moves[len(values) :], strict=True):
        kind, name = path.rsplit(".", 1)
        coordinate = next(c for c in Coordinate.of(effects[kind], model) if c.name == name)
        effects[kind] = changed(effects[kind], {name: coordinate.value_at(effects[kind], float(by))})
    return model.model_copy(update={"effects": tuple(effects.values())})


def is_next_to_none(effect: Effect, model: Model) -> bool:
    """Is the effect's strength far below what is plausible of it?"""
    low, high, log = type(effect).plausible(model)[effect.strength]
    strength = abs(float(getattr(effect, effect.strength)) - effect.none_at(model))
    return strength < (low / 5 if log else (high - low) / 50)


def is_at_an_end(effect: Effect, model: Model) -> bool:
    """Has a shape of the effect come to an end of its range?"""
    shapes = [c for c in Coordinate.of(effect, model) if c.name != effect.strength]
    return any(abs(end) < AT_AN_END for shape in shapes for end in shape.room(effect))


def changed(effect: Effect, values: dict[str, Any], **choices: str) -> Effect:
    """The effect with parameters changed, kept within their hard limits, and with other choices of form."""
    data = {name: value for name, value in effect.model_dump().items() if name != "kind"} | choices
    for name, value in values.items():
        low, high = hard_limits(effect, name)
        data[name] = value if low == -np.inf and high == np.inf else min(max(value, low), high)
    return type(effect)(**data)


def hard_limits(effect: Effect, name: str) -> tuple[float, float]:
    """The least and the largest value that a parameter takes."""
    low, high = -np.inf, np.inf
    for limit in type(effect).model_fields[name].metadata:
        if hasattr(limit, "ge"):
            low = max(low, float(limit.ge))
        if hasattr(limit, "gt"):
            low = max(low, float(limit.gt) + 1e-9)
        if hasattr(limit, "le"):
            high = min(high, float(limit.le))
    return low, high


def room(model: Model, values: Sequence[Nuisance], free: Sequence[str]) -> Array:
    """How far the free values may move (2, value), down and up: nuisance values by `VALUE_REACH` of their priors from
    where they started (a data sheet is not wrong by ten standard deviations, whatever that would explain, and whatever
    is added), parameters within their range."""
    effects = {effect.kind: effect for effect in model.effects}
    ends = [value.room(model) for value in values]
    for path in free[len(values) :]:
        kind, name = path.rsplit(".", 1)
        coordinate = next(c for c in Coordinate.of(effects[kind], model) if c.name == name)
        ends.append(coordinate.room(effects[kind]))
    return np.array(ends).reshape(-1, 2).T
