"""What chance alone does: calibration by parametric bootstrap of the fitted base model.

Base simulations go through the same screening as the measurement. Their largest evidences follow a Gumbel
law (a maximum over effects), their misfits a scaled chi² (here: a gamma law); the tails are read from the
fitted laws, since a few dozen simulations cannot show a one-percent tail themselves. A few are freaks, though,
of several hundred: two molecules that chance made neighbours look like one that goes dark. They say nothing
about the usual ones, and count as what they are: so many among all; and against an effect, as what they would have
brought that effect: neighbours do not pass for the noise of rows.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from napari_mufasa.discover.rules import ALARM, FREAK


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
        usual, larger = self.within(p)
        return float(self.freaks[larger:].max(initial=usual))

    def within(self, p: float) -> tuple[float, int]:
        """How a probability p is best shared out: the value that usual ones exceed with what is left of it, where so
        many freaks may be larger."""
        left = p - np.arange(len(self.freaks) + 1) / self.among
        usual = self.law.isf(left[left > 0])
        larger = int(np.argmin(np.maximum(usual, np.append(self.freaks, -np.inf)[left > 0])))
        return float(usual[larger]), larger


def fence(values: NDArray[np.float64]) -> float:
    """The value beyond which there are only freaks."""
    low, high = np.quantile(values, [0.25, 0.75])
    return float(high + FREAK * (high - low))


def beyond(values: NDArray[np.float64], most: float) -> NDArray[np.float64]:
    """The values above the fence, largest first."""
    return np.sort(values[values > most])[::-1]


@dataclass(frozen=True)
class Null:
    """The largest evidence of any effect, and the misfit, when nothing is missing.

    of_each : the same law of usual evidence with the freaks of that effect alone · alarm : what each effect must bring,
    so that with a chance of 2 % (`rules.ALARM`) any of them does
    """

    evidence: Tail
    misfit: Tail
    of_each: Mapping[str, Tail]
    alarm: Mapping[str, float]

    @classmethod
    def of(cls, evidence: Mapping[str, NDArray[np.float64]], misfit: NDArray[np.float64]) -> Null:
        """From simulations of a model that lacks nothing: the evidence (simulation,) of each effect, and the misfit
        (simulation,)."""
        largest = np.max(list(evidence.values()), axis=0) if evidence else np.zeros_like(misfit)
        n, most = len(misfit), fence(largest)
        values = np.minimum(largest, most)
        scale = max(float(values.std(ddof=1)) * np.sqrt(6) / np.pi, 0.5)
        law = stats.gumbel_r(float(values.mean()) - float(np.euler_gamma) * scale, scale)
        of_each = {kind: Tail(law, beyond(own, most), n) for kind, own in evidence.items()}
        by_chance = Tail(law, beyond(largest, most), n)
        usual, spared = by_chance.within(ALARM)
        kept = np.argsort(-largest, kind="stable")[spared:]
        alarm = {kind: float(beyond(own[kept], most).max(initial=usual)) for kind, own in evidence.items()}
        most = fence(misfit)
        values = np.minimum(misfit, most)
        mean, variance = float(values.mean()), float(values.var(ddof=1))
        law = stats.gamma(mean**2 / variance, scale=variance / mean)
        return cls(by_chance, Tail(law, beyond(misfit, most), n), of_each, alarm)

    def evidence_of(self, kind: str) -> Tail:
        """What chance makes an effect worth; of one that was not asked for then: any."""
        return self.of_each.get(kind, self.evidence)

    def needed(self, kind: str) -> float:
        """What an effect must bring for an alarm; one that was not asked for then: what any must."""
        return self.alarm.get(kind, self.evidence.at(ALARM))
