"""The weights of least estimated risk, and how good they honestly are.

The estimated risk of a weighted sum of candidates is quadratic in the weights. The candidates are those of every level
in turn (`kernels.per_level`), then one for each guide's block sums.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from .kernels import PER_GUIDE, SPATIAL, per_level

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

#: Directions in weight space whose share of the risk is below this many noise variances are faded out.
DOUBT = 2.0
#: Inverse variance of the weights before any data, in noise variances of one pixel.
WEIGHT_PRIOR = 3.0


@dataclass
class RiskSystem:
    """Quadratic form of the estimated risk in the weights; systems of several images add up."""

    gram: Array
    cross: Array
    rest: float
    noise: float
    n_pixels: int
    levels: int = 1
    guides: int = 0

    def __add__(self, other: RiskSystem) -> RiskSystem:
        return RiskSystem(
            self.gram + other.gram,
            self.cross + other.cross,
            self.rest + other.rest,
            self.noise + other.noise,
            self.n_pixels + other.n_pixels,
            self.levels,
            self.guides,
        )

    def less(self, other: RiskSystem) -> RiskSystem:
        """This system without one of those it was added up from."""
        return self + RiskSystem(-other.gram, -other.cross, -other.rest, -other.noise, -other.n_pixels)

    def reduced(self, selection: Array) -> RiskSystem:
        """The system of fewer weights, of which ``selection`` (all, fewer) makes all."""
        if selection.shape[0] == selection.shape[1]:
            return self
        # Not the matrix product: it starts threads, which cost far more than this where processors are busy.
        gram = np.einsum("ka,kb->ab", selection, np.einsum("kl,lb->kb", self.gram, selection))
        cross = np.einsum("ka,k->a", selection, self.cross)
        return RiskSystem(gram, cross, self.rest, self.noise, self.n_pixels, self.levels, self.guides)

    def risk(self, weights: Array) -> float:
        """Estimated mean squared error per pixel of the estimator with these weights."""
        total = weights @ self.gram @ weights - 2.0 * weights @ self.cross + self.rest
        return float(total / self.n_pixels)

    def noise_variance(self) -> float:
        """Estimated mean squared error per pixel of the data themselves."""
        return self.noise / self.n_pixels

    def optimism(self) -> float:
        """By how much the least estimated risk is expected to lie below the true one, per pixel.

        Three noise variances per weight: two are Mallows' term for fixed candidates, one was measured for candidates
        that depend on the data. Only used where there are too few windows to check one against the others.
        """
        return 3.0 * self.cross.size * max(self.noise_variance(), 0.0) / self.n_pixels

    def solve(self, doubt: float = DOUBT) -> Array:
        """Weights of least estimated risk, faded where the risk's own noise decides.

        In coordinates in which the Gram matrix is the identity, each coordinate carries noise of about the noise
        energy of one pixel. A coordinate whose square is not ``doubt`` times above that is fitted to chance: it is
        shrunk by the positive part of 1 - doubt * noise / square. Weights are of order one: that much is assumed
        beforehand, so that a candidate that hardly ever occurs gets none. ``doubt=0`` is plain least squares.
        """
        noise = max(self.noise_variance(), 0.0)
        gram = self.gram + (WEIGHT_PRIOR * noise if doubt > 0 else 0.0) * np.eye(self.cross.size)
        scale = np.sqrt(np.maximum(np.diag(gram), 1e-30))
        values, vectors = np.linalg.eigh(gram / np.outer(scale, scale))
        # Single precision carries about five digits into the Gram matrix; smaller directions are rounding.
        kept = values > 1e-5 * values[-1]
        values, vectors = values[kept], vectors[:, kept]
        along = vectors.T @ (self.cross / scale) / np.sqrt(values)
        along *= np.maximum(0.0, 1.0 - doubt * noise / np.maximum(along**2, 1e-30))
        weights: Array = vectors @ (along / np.sqrt(values)) / scale
        return weights


#: Candidates kept in the smaller models, as places in one level's spatial and one guide's candidates.
CORE_SPATIAL, CORE_GUIDE = (0, 1, 3, 4), (0, 3)
TINY_SPATIAL, TINY_GUIDE = (0, 3), (0,)
#: Of the data's own noise: a mean squared error estimated so far below zero says that their noise is not what it was
#: taken for (it came to -0.003 at least where it was).
IMPOSSIBLE = -0.1
#: Parts into which the windows are divided to judge weights on data that did not choose them.
FOLDS = 5
#: A model may have one weight for so many pixels.
PIXELS_PER_WEIGHT = 25


def selections(levels: int, guides: int) -> list[Array]:
    """Weights of the full model, of a core per level, and of a tiny model that all levels share."""
    one_level = np.eye(per_level(guides))

    def kept(spatial: tuple[int, ...], guide: tuple[int, ...]) -> Array:
        places = [*spatial, *(SPATIAL + PER_GUIDE * k + g for k in range(guides) for g in guide)]
        return one_level[:, places]

    def with_sums(details: Array) -> Array:
        # The guides' block sums keep a weight each.
        full, fewer = details.shape
        out = np.eye(full + guides, fewer + guides, fewer - full)
        out[:full, :fewer] = details
        return out

    apart, shared = np.eye(levels), np.ones((levels, 1))
    core, tiny = kept(CORE_SPATIAL, CORE_GUIDE), kept(TINY_SPATIAL, TINY_GUIDE)
    return [with_sums(np.kron(each, part)) for each, part in ((apart, one_level), (apart, core), (shared, tiny))]


def choose_weights(parts: list[RiskSystem]) -> tuple[Array, float, float]:
    """Weights of least estimated risk over all windows, their honest risk, and the noise variance of the data.

    The same honest judgement chooses between the full set of candidates and smaller ones, which small or very noisy
    images need.
    """
    total = sum(parts[1:], parts[0])
    folds = [sum(parts[k + FOLDS :: FOLDS], parts[k]) for k in range(min(FOLDS, len(parts)))]
    best: tuple[Array, float] = (np.zeros(total.cross.size), np.inf)
    for selection in selections(total.levels, total.guides):
        whole = total.reduced(selection)
        if whole.n_pixels < PIXELS_PER_WEIGHT * whole.cross.size:
            continue
        weights = whole.solve()
        risk = honest_risk(whole, weights, [fold.reduced(selection) for fold in folds])
        if risk < best[1]:
            best = (selection @ weights, risk)
    return *best, total.noise_variance()


def improves(risk: float, untouched: float) -> bool:
    """Is an estimated risk below that of the data as they are, and possible at all?"""
    return risk < untouched and not is_impossible(risk, untouched)


def is_impossible(risk: float, untouched: float) -> bool:
    """Is an estimated risk so far below zero that chance does not bring it there?"""
    return risk < IMPOSSIBLE * abs(untouched)


def honest_risk(whole: RiskSystem, weights: Array, folds: list[RiskSystem]) -> float:
    """Risk per pixel of the ``weights`` that all ``folds`` together chose.

    On the data that chose the weights it is too low. Each fold is therefore judged with the weights that the others
    choose; a single one gets its expected optimism added.
    """
    fitted = whole.risk(weights)
    if len(folds) == 1:
        return fitted + whole.optimism()
    errors = [fold.risk(whole.less(fold).solve()) * fold.n_pixels for fold in folds]
    judged = float(np.sum(errors)) / whole.n_pixels
    # With n of n + 1 folds the weights are a little worse than those in use: of the distance between the two risks,
    # 2 of 2 + 1/n parts are optimism.
    n = len(folds) - 1
    return fitted + (judged - fitted) * 2.0 / (2.0 + 1.0 / n)
