"""What chance alone does: calibration by parametric bootstrap of the fitted base model.

Base simulations go through the same screening as the measurement. Their largest evidences follow a Gumbel
law (a maximum over effects), their misfits a scaled chi² (here: a gamma law); the tails are read from the
fitted laws, since a few dozen simulations cannot show a one-percent tail themselves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

ALARM = 0.02  # chance level of the evidence that raises the alarm
MISFIT_ALARM = 0.01  # chance level at which the misfit alone raises it


@dataclass(frozen=True)
class Null:
    """Laws of the largest evidence and of the misfit when nothing is missing."""

    location: float
    scale: float
    shape: float
    rate: float

    @classmethod
    def of(cls, evidence: NDArray[np.float64], misfit: NDArray[np.float64]) -> Null:
        scale = max(float(evidence.std(ddof=1)) * np.sqrt(6) / np.pi, 0.5)
        location = float(evidence.mean()) - 0.5772 * scale
        mean, variance = float(misfit.mean()), float(misfit.var(ddof=1))
        return cls(location, scale, mean**2 / variance, mean / variance)

    def p_evidence(self, gain: float) -> float:
        """Probability of at least this much evidence for the best effect when nothing is missing."""
        return float(-np.expm1(-np.exp(-(gain - self.location) / self.scale)))

    def evidence_at(self, p: float) -> float:
        """The evidence that chance exceeds with probability p."""
        return float(self.location - self.scale * np.log(-np.log1p(-p)))

    def p_misfit(self, misfit: float) -> float:
        return float(stats.gamma.sf(misfit, self.shape, scale=1 / self.rate))

    def misfit_at(self, p: float) -> float:
        return float(stats.gamma.isf(p, self.shape, scale=1 / self.rate))
