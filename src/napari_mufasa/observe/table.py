"""A named number with a meaning: the row of the table that a user reads."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

COMB = 8  # counts are also looked at modulo this, to see coarse or merged digits


@dataclass(frozen=True)
class Meaning:
    """What an observable is: title, unit, and where in the movie to look for it."""

    title: str
    unit: str
    where: str


@dataclass
class Table:
    """Observables in a fixed order: the same names for every movie, whatever it shows.

    What a movie does not show is NaN: it is for those who compare movies to leave it out of both.
    """

    values: dict[str, float] = field(default_factory=dict)
    meanings: dict[str, Meaning] = field(default_factory=dict)

    def add(self, name: str, value: float, title: str, unit: str, where: str) -> None:
        number = float(value)
        self.values[name] = number if np.isfinite(number) else np.nan
        self.meanings[name] = Meaning(title, unit, where)

    def include(self, other: Table) -> None:
        """Append another table's rows."""
        self.values |= other.values
        self.meanings |= other.meanings

    def log(self, name: str, value: float, title: str, where: str, floor: float = 1e-12) -> None:
        """A positive quantity, kept as its logarithm: relative changes are what matters."""
        self.add(name, np.log(max(value, floor)) if np.isfinite(value) else np.nan, title, "ln", where)

    def count(self, name: str, value: float, title: str, where: str) -> None:
        """A count, kept as its square root: its noise is then about ½ whatever its size."""
        self.add(name, np.sqrt(max(value, 0.0)), title, "√count", where)
