"""A number as it is measured."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Value:
    """A measured number and its standard error (nan where it was given or cannot be known)."""

    value: float
    sd: float

    def __str__(self) -> str:
        return f"{self.value:.4g} ± {self.sd:.2g}"
