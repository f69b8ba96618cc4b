"""A number as it is measured."""

from __future__ import annotations

from dataclasses import dataclass
from math import floor, isfinite, log10, nan

NORMAL = 1.959964  # of a normal law, 95 % lie within so many sd


@dataclass(frozen=True)
class Value:
    """A measured number, its standard error (nan where it was given or cannot be known), and its 95 % interval.

    Without `low` and `high` of its own the interval is that of a normal law.
    """

    value: float
    sd: float
    low: float = nan
    high: float = nan

    @property
    def interval(self) -> tuple[float, float]:
        """95 %; (nan, nan) where it is unknown."""
        reach = NORMAL * self.sd
        low = self.low if isfinite(self.low) else self.value - reach
        high = self.high if isfinite(self.high) else self.value + reach
        return low, high

    def holds(self, truth: float) -> bool:
        """Whether a number lies in the interval."""
        low, high = self.interval
        return low <= truth <= high

    def over(self, factor: float) -> Value:
        """The value divided by an exact positive number."""
        return Value(self.value / factor, self.sd / factor, self.low / factor, self.high / factor)

    def plain(self) -> dict[str, float | None]:
        """Plain data, without what is unknown."""
        low, high = self.interval
        given = {"value": self.value, "sd": self.sd, "low": low, "high": high}
        return {name: number if isfinite(number) else None for name, number in given.items()}

    def __str__(self) -> str:
        """As many digits as the error allows; a value that was given has none."""
        if not isfinite(self.sd) or self.sd <= 0:
            return f"{self.value:.6g}"
        digits = min(max(1 - floor(log10(self.sd)), 0), 8)
        return f"{self.value:.{digits}f} ± {self.sd:.{digits}f}"


UNKNOWN = Value(nan, nan)
