"""What chance alone does: calibration by parametric bootstrap of the fitted base model.

Base simulations go through the same screening as the measurement. Their largest evidences follow a Gumbel
law (a maximum over effects), their misfits a scaled chi² (here: a gamma law); the tails are read from the
fitted laws, since a few dozen simulations cannot show a one-percent tail themselves. A few are freaks, though,
of several hundred: two molecules that chance made neighbours look like one that goes dark. They say nothing
about the usual ones, and count as what they are: so many among all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

FREAK = 3.0  # interquartile ranges above the upper quartile: a Gumbel law has 0.3 % beyond


@dataclass(frozen=True)
class Tail:
    """How often chance alone reaches a value: the law of the usual values, and the freaks among all, largest first."""

    law: Any  # a frozen law of scipy.stats
    freaks: NDArray[np.float64]
    among: int

    def p(self, value: float) -> float:
        """Probability of more than this."""
        with np.errstate(over="ignore"):  # far below the law's place it is 1
            usually = float(self.law.sf(value))
        return min(1.0, usually + float((self.freaks > value).sum()) / self.among)

    def at(self, p: float) -> float:
        """The value that chance exceeds with probability p."""
        beyond = np.arange(len(self.freaks) + 1)  # so many freaks may be larger
        left = p - beyond / self.among
        values = np.maximum(self.law.isf(left[left > 0]), np.append(self.freaks, -np.inf)[left > 0])
        return float(values.min())


def usual(values: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """All values, freaks drawn in to the fence; and the freaks, largest first."""
    low, high = np.quantile(values, [0.25, 0.75])
    fence = high + FREAK * (high - low)
    return np.minimum(values, fence), np.sort(values[values > fence])[::-1]


@dataclass(frozen=True)
class Null:
    """The largest evidence of any effect, and the misfit, when nothing is missing."""

    evidence: Tail
    misfit: Tail

    @classmethod
    def of(cls, evidence: NDArray[np.float64], misfit: NDArray[np.float64]) -> Null:
        values, freaks = usual(evidence)
        scale = max(float(values.std(ddof=1)) * np.sqrt(6) / np.pi, 0.5)
        location = float(values.mean()) - float(np.euler_gamma) * scale
        by_chance = Tail(stats.gumbel_r(location, scale), freaks, len(values))
        values, freaks = usual(misfit)
        mean, variance = float(values.mean()), float(values.var(ddof=1))
        return cls(by_chance, Tail(stats.gamma(mean**2 / variance, scale=variance / mean), freaks, len(values)))
