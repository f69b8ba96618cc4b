"""The noise of an image, and how the mean of signal times estimate is told from the data alone.

Let y = z + b with E[z] = x, variance alpha * x, and b Gaussian of variance sigma^2. For any function F of the data the
mean of x_i F_i(y) has an unbiased estimate from y alone: evaluate F where pixel i holds ``step`` less, weight it with
y_i, and take the derivative off for the Gaussian part.

Scaled Poisson counts use ``step = alpha``. The electron-multiplying register turns n electrons into Gamma(n, 1), a
compound Poisson value with alpha = 2, for which E[x F(y)] = E[y (1 - d/dy)^2 F(y)] exactly. A second-order difference
replaces the operator: a combination of F here, with ``step`` less and with ``step`` more (`Noise.stencil`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

#: Step of the difference that stands for the derivatives in the electron-multiplied case, in units of the gain.
EM_STEP = 0.25


@dataclass(frozen=True)
class Noise:
    """Noise of one image: E[y] = x, Var[y] = alpha * x + variance (scalar or per pixel)."""

    alpha: float
    variance: Array
    multiplied: bool = False

    def within(self, part: tuple[slice, ...]) -> Noise:
        """The noise of a part of the image, which must be two-dimensional if the variance is a map."""
        variance = np.asarray(self.variance)
        return Noise(self.alpha, variance[part] if variance.ndim else variance, self.multiplied)

    def mean(self, image: Array) -> float:
        """Mean variance per pixel, with the data of the whole image in place of x."""
        return self.alpha * float(image.mean(dtype=np.float64)) + float(np.mean(self.variance))

    def stencil(self) -> tuple[float, float, float, float]:
        """Step, and the shares of F with that step less, here and with that step more."""
        if not self.multiplied:
            return self.alpha, 1.0, 0.0, 0.0
        h = EM_STEP
        return 0.5 * self.alpha * h, (1.0 + h) / h**2, 1.0 - 2.0 / h**2, (1.0 - h) / h**2


def same_mean(result: Array, data: Array) -> NDArray[np.float32]:
    """Move the result to the mean of the data, which is the unbiased estimate of the mean of the truth."""
    shift = float(data.mean(dtype=np.float64)) - float(result.mean(dtype=np.float64))
    moved: NDArray[np.float32] = (result + np.float32(shift)).astype(np.float32, copy=False)
    return moved
