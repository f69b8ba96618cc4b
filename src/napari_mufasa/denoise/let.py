"""Linear expansion of thresholds: candidate functions, their unbiased risk terms, and the weights that minimise it.

Let y = z + b with E[z] = x, variance alpha * x, and b Gaussian of variance sigma^2. For any function F of the data the
mean of x_i F_i(y) has an unbiased estimate from y alone: evaluate F where pixel i holds ``step`` less, weight it with
y_i, and take the derivative off for the Gaussian part. In the unnormalised Haar transform a pixel enters a detail
coefficient with weight +1 or -1 and its block sum with weight +1, so "pixel i holds ``step`` less" reads
"the details of its block change by their signs, and the block sum by step": one evaluation for each of the four
children of a block gives the term of the whole block, exactly, whatever the three details do to each other.

Scaled Poisson counts use ``step = alpha``. The electron-multiplying register turns n electrons into Gamma(n, 1), a
compound Poisson value with alpha = 2, for which E[x F(y)] = E[y (1 - d/dy)^2 F(y)] exactly. A second-order difference
replaces the operator: a combination of F here, with ``step`` less and with ``step`` more (`Noise.stencil`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from . import haar
from .fused import level_pass, settle
from .kernels import (
    BUMP,
    OWN,
    PER_GUIDE,
    SPATIAL,
    bumps,
    gram,
    linear_terms,
    predictions,
    surroundings,
    threshold_terms,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

#: Step of the difference that stands for the derivatives in the electron-multiplied case, in units of the gain.
EM_STEP = 0.25
#: Directions in weight space whose share of the risk is below this many noise variances are faded out.
DOUBT = 2.0
#: Inverse variance of the weights before any data, in noise variances of one pixel.
WEIGHT_PRIOR = 3.0


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

    def stencil(self) -> tuple[float, float, float, float]:
        """Step, and the shares of F with that step less, here and with that step more."""
        if not self.multiplied:
            return self.alpha, 1.0, 0.0, 0.0
        h = EM_STEP
        return 0.5 * self.alpha * h, (1.0 + h) / h**2, 1.0 - 2.0 / h**2, (1.0 - h) / h**2


@dataclass
class System:
    """Quadratic form of the estimated risk in the weights; systems of several images add up."""

    gram: Array
    cross: Array
    rest: float
    noise: float
    n_pixels: int
    levels: int = 1
    guides: int = 0

    def __add__(self, other: System) -> System:
        return System(
            self.gram + other.gram,
            self.cross + other.cross,
            self.rest + other.rest,
            self.noise + other.noise,
            self.n_pixels + other.n_pixels,
            self.levels,
            self.guides,
        )

    def less(self, other: System) -> System:
        """This system without one of those it was added up from."""
        minus = System(-other.gram, -other.cross, -other.rest, -other.noise, -other.n_pixels)
        return self + minus

    def reduced(self, selection: Array) -> System:
        """The system of fewer weights, of which ``selection`` (all, fewer) makes all."""
        if selection.shape[0] == selection.shape[1]:
            return self
        # Not the matrix product: it starts threads, which cost far more than this where processors are busy.
        gram = np.einsum("ka,kb->ab", selection, np.einsum("kl,lb->kb", self.gram, selection))
        cross = np.einsum("ka,k->a", selection, self.cross)
        return System(gram, cross, self.rest, self.noise, self.n_pixels, self.levels, self.guides)

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
#: Parts into which the windows are divided to judge weights on data that did not choose them.
FOLDS = 5
#: A model may have one weight for so many pixels.
PIXELS_PER_WEIGHT = 25


def selections(levels: int, guides: int) -> list[Array]:
    """Weights of the full model, of a core per level, and of a tiny model that all levels share."""
    per_level = SPATIAL + PER_GUIDE * guides
    size = levels * per_level + guides

    def places(spatial: tuple[int, ...], guide: tuple[int, ...]) -> list[int]:
        return [*spatial, *(SPATIAL + PER_GUIDE * k + g for k in range(guides) for g in guide)]

    eye = np.eye(size)
    extras = eye[:, levels * per_level :]
    starts = [level * per_level for level in range(levels)]
    core = [start + place for start in starts for place in places(CORE_SPATIAL, CORE_GUIDE)]
    tiny = [sum(eye[start + place] for start in starts) for place in places(TINY_SPATIAL, TINY_GUIDE)]
    return [eye, np.hstack([eye[:, core], extras]), np.hstack([np.stack(tiny, axis=1), extras])]


def learn(parts: list[System]) -> tuple[Array, float, float]:
    """Weights of least estimated risk over all windows, their honest risk, and the noise variance of the data.

    The risk of weights on the data that chose them is too low. Each fold of the windows is therefore judged with the
    weights that the others choose; a single window gets its expected optimism added. The same judgement chooses
    between the full set of candidates and smaller ones, which small or very noisy images need.
    """
    total = parts[0]
    for part in parts[1:]:
        total = total + part
    best: tuple[Array, float] = (np.zeros(total.cross.size), np.inf)
    folds = [sum(parts[k + FOLDS :: FOLDS], parts[k]) for k in range(min(FOLDS, len(parts)))]
    for selection in selections(total.levels, total.guides):
        whole = total.reduced(selection)
        if whole.n_pixels < PIXELS_PER_WEIGHT * whole.cross.size:
            continue
        weights = whole.solve()
        if len(folds) == 1:
            risk = whole.risk(weights) + whole.optimism()
        else:
            pieces = [fold.reduced(selection) for fold in folds]
            errors = [piece.risk(whole.less(piece).solve()) * piece.n_pixels for piece in pieces]
            judged = float(np.sum(errors)) / whole.n_pixels
            fitted = whole.risk(weights)
            # With n of n + 1 folds the weights are a little worse than those in use: of the distance between the
            # two risks, 2 of 2 + 1/n parts are optimism.
            n = len(pieces) - 1
            risk = fitted + (judged - fitted) * 2.0 / (2.0 + 1.0 / n)
        if risk < best[1]:
            best = (selection @ weights, risk)
    return *best, total.noise_variance()


def _three_bands(d: Array) -> Array:
    """Rows only have one detail band; the kernels take three, the missing ones being zero."""
    return d if d.shape[0] == 3 else np.concatenate([d, np.zeros((2, *d.shape[1:]), d.dtype)])


def _children(a: Array, h: int, flat: bool) -> Array:
    """The four children of every block, (4, rows, cols); rows only have two."""
    left, right = a[:, :-h], a[:, h:]
    if flat:
        zero = np.zeros_like(left)
        return np.stack([left, right, zero, zero])
    return np.stack([left[:-h], right[:-h], left[h:], right[h:]])


class Bands:
    """One level's details with all that its candidates are made of, before any weight is known.

    ``variance`` is the Gaussian variance of each block, ``distance`` how many array places lie between blocks that
    share no pixel, ``guides`` the details of independent images of the same scene.
    """

    def __init__(
        self,
        s: Array,
        details: Array,
        variance: Array,
        noise: Noise,
        distance: int,
        flat: bool,
        guides: list[Array],
        guide_noise: Array,
    ) -> None:
        self.s, self.noise = s, noise
        self.n = int(details.shape[0])
        self.d = _three_bands(details)
        self.width = BUMP * float(self.n)
        self.own = OWN * noise.alpha
        self.guides = [_three_bands(guide) for guide in guides]
        self.guide_noise = guide_noise
        energy = haar.energy_beside(details, distance, flat)
        if guides:
            # A guide shows the coefficient itself: its square weighs as much as the whole neighbourhood.
            energy *= np.float32(0.5)
            for guide, relative in zip(guides, guide_noise, strict=True):
                haar.add_energy(energy, guide, 0.5 / len(guides) / max(float(relative), 0.05) / self.n)
        s_beside = haar.mean_beside(s, distance, flat)
        self.rest, self.narrow, self.wide = surroundings(s_beside, energy, variance, noise.alpha)
        self.distance, self.flat = distance, flat
        self.zero = np.zeros((3, 1, 1), self.d.dtype)

    @cached_property
    def predictions(self) -> Array:
        """What the blocks beside say of the details."""
        return predictions(self.d, self.s, self.distance, self.flat)

    def bump(self, guide: int) -> Array:
        """Threshold of the details (guide -1) or of their difference from a guide."""
        reference = np.broadcast_to(self.zero, self.d.shape) if guide < 0 else self.guides[guide]
        out: Array = bumps(self.d, self.s, self.rest, reference, self.own, self.guide_width(guide))
        return out

    def guide_width(self, guide: int) -> float:
        return self.width * (1.0 if guide < 0 else 1.0 + float(self.guide_noise[guide]))

    def candidates(self) -> list[Array]:
        """Details (3, rows, cols) of every candidate, in the order of the weights."""
        bump = self.bump(-1)
        out = [self.d * g for g in (1.0, self.narrow, self.wide)]
        out += [self.d * (bump * g) for g in (np.float32(1.0), self.narrow, self.wide)]
        for prediction in self.predictions:
            out += [prediction, prediction * self.narrow]
        for k, guide in enumerate(self.guides):
            bump = self.bump(k)
            out += [guide, guide * self.narrow, guide * self.wide]
            out += [(self.d - guide) * bump, (self.d - guide) * (bump * self.narrow)]
        return [np.asarray(c, self.d.dtype) for c in out]

    def terms(self, y: Array, v: Array) -> list[float]:
        """Unbiased estimates of the sum of x times what every candidate adds to the image.

        ``y`` and ``v`` (child, rows, cols): data and Gaussian variance of each block's children, weighted with what a
        detail adds to their pixels in the synthesis.
        """
        step, less, here, more = self.noise.stencil()
        bands = float(self.n)
        linear = linear_terms(self.d, y, v, (less - more) * step, bands)
        classes = (None, self.narrow, self.wide)

        def sums(per_block: Array, weights: tuple[Array | None, ...]) -> list[float]:
            return [float(np.sum(per_block if g is None else per_block * g, dtype=np.float64)) for g in weights]

        def thresholded(guide: int) -> Array:
            reference = np.broadcast_to(self.zero, self.d.shape) if guide < 0 else self.guides[guide]
            out: Array = threshold_terms(
                self.d, self.s, self.rest, reference, self.own, self.guide_width(guide), y, v,
                (step, less, here, more), bands,
            )  # fmt: skip
            return out

        out = sums(linear, classes) + sums(thresholded(-1), classes)
        for prediction in self.predictions:
            out += sums(linear_terms(prediction, y, np.zeros_like(v), 0.0, bands), classes[:2])
        for k, guide in enumerate(self.guides):
            known = linear_terms(guide, y, np.zeros_like(v), 0.0, bands)
            out += sums(known, classes) + sums(thresholded(k), classes[:2])
        return out


def _analysed(
    a: Array, variance: Array, lows: list[Array], noise: Noise, h: int, flat: bool, guide_noise: Array
) -> tuple[Bands, Array, list[Array]]:
    """One level down: its bands, the blocks' Gaussian variance, and the guides' block sums."""
    s, details = haar.analyse(a, h, flat)
    block_variance = haar.children_sum(variance, h, haar.LOW_1D if flat else haar.LOW_2D, flat)
    analysed = [haar.analyse(low, h, flat) for low in lows]
    bands = Bands(s, details, block_variance, noise, 2 * h, flat, [d for _, d in analysed], guide_noise)
    return bands, block_variance, [low for low, _ in analysed]


def expand(
    image: Array, noise: Noise, levels: int, flat: bool, guides: list[Array], guide_noise: Array
) -> tuple[System, Array]:
    """Risk system of one image or window, and the candidates as images (K + 1, pixels), the fixed low part first.

    ``guides`` are images of the same scene whose noise is independent of ``image`` (neighbouring frames);
    ``guide_noise`` their variance relative to the image's.
    """
    low = haar.LOW_1D if flat else haar.LOW_2D
    variance = np.broadcast_to(noise.variance, image.shape).astype(image.dtype)
    a, b, v, v_adjoint, lows = image, image, variance, variance, list(guides)
    shapes: list[tuple[int, ...]] = []
    size = levels * (SPATIAL + PER_GUIDE * len(guides)) + len(guides)
    stacked = np.empty((1 + size, image.size), image.dtype)
    cross: list[float] = []

    def down(plane: Array, level: int) -> Array:
        for below in reversed(range(level)):
            plane = haar.synthesise(plane, None, 2**below, flat, shapes[below])
        return np.asarray(plane)

    for number in range(levels):
        h = 2**number
        shapes.append(a.shape)
        bands, v, lows = _analysed(a, v, lows, noise, h, flat, guide_noise)
        b_covered, v_covered = haar.covered(b, h, flat), haar.covered(v_adjoint, h, flat)
        cross += bands.terms(_children(b_covered, h, flat), _children(v_covered, h, flat))
        # One weight for all orientations: a microscope prefers none, and a third of the weights is a third of the
        # over-fitting.
        for place, candidate in enumerate(bands.candidates(), 1 + number * (size - len(guides)) // levels):
            plane = haar.synthesise(None, candidate[: bands.n], h, flat, shapes[number])
            stacked[place] = down(plane, number).ravel()
        a = bands.s
        b, v_adjoint = haar.children_sum(b_covered, h, low, flat), haar.children_sum(v_covered, h, low, flat)

    fixed = down(a, levels)
    b64 = b.astype(np.float64)
    fixed_cross = float((b64 * a).sum() - noise.alpha * b64.sum() - v_adjoint.sum(dtype=np.float64))
    stacked[0] = fixed.ravel()
    for place, guide in enumerate(lows, 1 + size - len(guides)):
        stacked[place] = down(guide, levels).ravel() - stacked[0]
        cross.append(float((b64 * guide).sum()) - fixed_cross)
    products = gram(stacked)
    data = image.astype(np.float64)
    total_noise = noise.alpha * float(data.sum()) + float(variance.sum(dtype=np.float64))
    energy_x = float(np.sum(data * data)) - total_noise
    system = System(
        gram=products[1:, 1:],
        cross=np.asarray(cross) - products[0, 1:],
        rest=products[0, 0] - 2.0 * fixed_cross + energy_x,
        noise=total_noise,
        n_pixels=image.size,
        levels=levels,
        guides=len(guides),
    )
    return system, stacked


def apply(
    image: Array, noise: Noise, levels: int, flat: bool, guides: list[Array], guide_noise: Array, weights: Array
) -> Array:
    """The estimator with given weights, level by level and without storing the candidates."""
    per_level = SPATIAL + PER_GUIDE * len(guides)
    weights = np.asarray(weights, np.float32)
    a = np.ascontiguousarray(image, np.float32)
    lows = np.stack([np.asarray(guide, np.float32) for guide in guides]) if guides else np.zeros((0, 1, 1), np.float32)
    v = np.broadcast_to(noise.variance, image.shape)
    v = np.ascontiguousarray(v, np.float32) if flat else _one_row_for_all(v)
    shapes: list[tuple[int, ...]] = []
    gathered: list[Array] = []
    for number in range(levels):
        h = 2**number
        w = weights[number * per_level : (number + 1) * per_level]
        shapes.append(a.shape)
        if flat:
            bands, v, sums = _analysed(a, v, list(lows), noise, h, flat, guide_noise)
            a, lows = bands.s, np.stack(sums) if sums else lows
            gathered.append(sum(share * c for share, c in zip(w, bands.candidates(), strict=True))[: bands.n])
        else:
            v = haar.children_sum(v, h, haar.LOW_2D, flat) if len(v) > 1 else 2.0 * (v[:, h:] + v[:, :-h])
            a, lows, out = level_pass(a, lows, v, noise.alpha, 3.0 * BUMP, guide_noise, w, h)
            gathered.append(out)
    extra = weights[levels * per_level :]
    plane = a * np.float32(1.0 - float(extra.sum()))
    for weight, guide in zip(extra, lows, strict=True):
        plane += weight * guide
    for number in reversed(range(levels)):
        if flat:
            plane = haar.synthesise(plane, gathered[number], 2**number, flat, shapes[number])
        else:
            settle(plane, gathered[number], 2**number)
            plane = gathered[number]
    return np.asarray(plane)


def _one_row_for_all(variance: Array) -> Array:
    """The first row of a map whose rows are all the same, else the map."""
    same = variance.strides[0] == 0 or bool((variance == variance[:1]).all())
    return np.ascontiguousarray(variance[:1] if same else variance, np.float32)
