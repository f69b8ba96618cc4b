"""A model whose values were measured."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from napari_mufasa.calibrate.value import Value
from napari_mufasa.model.model import Model


@dataclass(frozen=True)
class Known:
    """A model, how far each of its values is known, why others are not, and what else a user should know."""

    model: Model
    values: dict[str, Value]
    unknown: dict[str, str]
    notes: tuple[str, ...]

    def report(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "model": self.model.to_dict(),
            "values": {name: value.plain() for name, value in self.values.items()},
            "unknown": self.unknown,
            "notes": list(self.notes),
        }
