"""Linear expansion of thresholds: the candidates of a plane with their unbiased risk terms, and their weighted sum.

In the unnormalised Haar transform a pixel enters a detail coefficient with weight +1 or -1 and its block sum with
weight +1, so "pixel i holds ``step`` less" (see `noise`) reads "the details of its block change by their signs, and the
block sum by step": one evaluation for each of the four children of a block gives the term of the whole block, exactly,
whatever the three details do to each other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from . import haar
from .fused import level_pass, settle
from .kernels import (
    BEYOND,
    BUMP,
    ONE,
    OWN,
    bumps,
    gram,
    linear_terms,
    per_level,
    predictions,
    surroundings,
    threshold_terms,
)
from .risk import RiskSystem

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from .noise import Noise

    Array = NDArray[Any]


@dataclass(frozen=True)
class Guides:
    """Images of the same scene whose noise is independent of the image's (neighbouring frames), or their details.

    ``noise`` (guide,) is their variance relative to the image's, float32.
    """

    images: Array | Sequence[Array]
    noise: Array


NO_GUIDES = Guides((), np.zeros(0, np.float32))


@dataclass(frozen=True)
class Family:
    """Details (3, rows, cols) that are a candidate in each of the first ``classes`` of `Bands.classes`.

    ``own``: the block's own as they are. ``threshold``: what was taken off the block's own to make them (a guide's, or
    zero), and its width in noise variances; None: no threshold.
    """

    details: Array
    classes: int
    own: bool = False
    threshold: tuple[Array, float] | None = None


class Bands:
    """One level's details with all that its candidates are made of, before any weight is known.

    ``variance`` is the Gaussian variance of each block, ``distance`` how many array places lie between blocks that
    share no pixel, ``guides`` hold the same level's details. ``classes`` weigh the blocks: all of them, those in empty
    and those in nearly empty surroundings; ``families`` are in the order of the weights.
    """

    def __init__(
        self,
        s: Array,
        details: Array,
        variance: Array,
        noise: Noise,
        distance: int,
        flat: bool,
        guides: Guides = NO_GUIDES,
    ) -> None:
        self.s, self.noise = s, noise
        self.n, self.d = int(details.shape[0]), _three_bands(details)
        self.own = OWN * noise.alpha
        energy = haar.energy_beside(details, distance, flat)
        n_guides = len(guides.images)
        if n_guides:
            # A guide shows the coefficient itself: its square weighs as much as the whole neighbourhood.
            energy *= np.float32(0.5)
            for guide, relative in zip(guides.images, guides.noise, strict=True):
                haar.add_energy(energy, guide, 0.5 / n_guides / max(float(relative), 0.05) / self.n)
        s_beside = haar.mean_beside(s, distance, flat)
        self.rest, empty, nearly = surroundings(s_beside, energy, variance, noise.alpha)
        self.classes = (ONE, empty, nearly)
        width = BUMP * float(self.n)
        nothing = np.broadcast_to(np.zeros((3, 1, 1), self.d.dtype), self.d.shape)
        self.families = [Family(self.d, 3, own=True), Family(self.d, 3, threshold=(nothing, width))]
        self.families += [Family(p, 2) for p in predictions(self.d, s, distance, flat)]
        for guide, relative in zip(map(_three_bands, guides.images), guides.noise, strict=True):
            wider = width * (1.0 + float(relative))
            self.families += [Family(guide, 3), Family(self.d - guide, 2, threshold=(guide, wider))]
        if n_guides:  # the last shows most, and dim spots that stand still by itself
            far = BEYOND * float(self.n) * max(float(guides.noise[-1]), 1e-6)
            noise_like = bumps(guide, np.maximum(s_beside, 0), self.rest, nothing, self.own, far)
            self.families.append(Family(guide * (ONE - noise_like), 1))

    def candidates(self) -> Iterator[Array]:
        """Details (band, rows, cols) of every candidate, in the order of the weights."""
        for family in self.families:
            kept: Any = ONE
            if family.threshold is not None:
                known, width = family.threshold
                kept = bumps(self.d, self.s, self.rest, known, self.own, width)
            for share in self.classes[: family.classes]:
                yield family.details[: self.n] * (kept * share)

    def terms(self, y: Array, v: Array) -> list[float]:
        """Unbiased estimates of the sum of x times what every candidate adds to the image.

        ``y`` and ``v`` (child, rows, cols): data and Gaussian variance of each block's children, weighted with what a
        detail adds to their pixels in the synthesis.
        """
        stencil = step, less, _, more = self.noise.stencil()
        bands = float(self.n)
        out = []
        for family in self.families:
            if family.threshold is None:
                own = bands if family.own else 0.0
                per_block = linear_terms(family.details, y, v, (less - more) * step, own)
            else:
                known, width = family.threshold
                per_block = threshold_terms(self.d, self.s, self.rest, known, self.own, width, y, v, stencil, bands)
            out += [float(np.sum(per_block * g, dtype=np.float64)) for g in self.classes[: family.classes]]
        return out


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


def _analysed(a: Array, v: Array, guides: Guides, noise: Noise, h: int, flat: bool) -> tuple[Bands, Array, Guides]:
    """One level down: its bands, the blocks' Gaussian variance, and the guides' block sums."""
    s, details = haar.analyse(a, h, flat)
    variance = haar.children_sum(v, h, flat)
    analysed = [haar.analyse(guide, h, flat) for guide in guides.images]
    seen = Guides([d for _, d in analysed], guides.noise)
    bands = Bands(s, details, variance, noise, 2 * h, flat, seen)
    return bands, variance, Guides([low for low, _ in analysed], guides.noise)


def expand(image: Array, noise: Noise, levels: int, flat: bool, guides: Guides = NO_GUIDES) -> tuple[RiskSystem, Array]:
    """Risk system of one image or window, and the candidates as images (K + 1, pixels), the fixed low part first."""
    n_guides = len(guides.images)
    n_details = levels * per_level(n_guides)
    planes = np.empty((1 + n_details + n_guides, *image.shape), image.dtype)
    fixed, of_sums = planes[0], planes[1 + n_details :]
    of_levels = planes[1 : 1 + n_details].reshape(levels, -1, *image.shape)
    cross: list[float] = []

    def down(plane: Array, level: int) -> Array:
        for below in reversed(range(level)):
            plane = haar.synthesise(plane, None, 2**below, flat)
        return plane

    variance = np.broadcast_to(noise.variance, image.shape).astype(image.dtype)
    a, v = image, variance
    # Data and variance weighted with what a block's sum adds to its pixels in the synthesis.
    y_adjoint, v_adjoint = image, variance
    for number in range(levels):
        h = 2**number
        bands, v, guides = _analysed(a, v, guides, noise, h, flat)
        y_covered, v_covered = haar.covered(y_adjoint, h, flat), haar.covered(v_adjoint, h, flat)
        cross += bands.terms(_children(y_covered, h, flat), _children(v_covered, h, flat))
        # One weight for all orientations: a microscope prefers none, and a third of the weights is a third of the
        # over-fitting.
        for plane, candidate in zip(of_levels[number], bands.candidates(), strict=True):
            plane[...] = down(haar.synthesise(None, candidate, h, flat), number)
        a = bands.s
        y_adjoint, v_adjoint = haar.children_sum(y_covered, h, flat), haar.children_sum(v_covered, h, flat)

    y64 = y_adjoint.astype(np.float64)
    fixed[...] = down(a, levels)
    fixed_cross = float((y64 * a).sum() - noise.alpha * y64.sum() - v_adjoint.sum(dtype=np.float64))
    for plane, low in zip(of_sums, guides.images, strict=True):
        plane[...] = down(low, levels) - fixed
        cross.append(float((y64 * low).sum()) - fixed_cross)
    stacked = planes.reshape(len(planes), -1)
    products = gram(stacked)
    data = image.astype(np.float64)
    total_noise = noise.alpha * float(data.sum()) + float(variance.sum(dtype=np.float64))
    energy_x = float(np.sum(data * data)) - total_noise
    system = RiskSystem(
        gram=products[1:, 1:],
        cross=np.asarray(cross) - products[0, 1:],
        rest=products[0, 0] - 2.0 * fixed_cross + energy_x,
        noise=total_noise,
        n_pixels=image.size,
        levels=levels,
        guides=n_guides,
    )
    return system, stacked


def apply(image: Array, noise: Noise, levels: int, flat: bool, weights: Array, guides: Guides = NO_GUIDES) -> Array:
    """The estimator with given weights, level by level and without storing the candidates."""
    size = per_level(len(guides.images))
    weights = np.asarray(weights, np.float32)
    a = np.ascontiguousarray(image, np.float32)
    guides = Guides(np.asarray(guides.images, np.float32).reshape(-1, *a.shape), guides.noise)
    v = np.broadcast_to(noise.variance, a.shape)
    v = np.ascontiguousarray(v, np.float32) if flat else _one_row_for_all(v)
    gathered: list[Array] = []
    for number in range(levels):
        w, h = weights[number * size : (number + 1) * size], 2**number
        if flat:
            a, v, guides, out = candidate_by_candidate(a, v, guides, noise, w, h, True)
        else:
            a, v, guides, out = in_one_pass(a, v, guides, noise, w, h)
        gathered.append(out)
    of_sums = weights[levels * size :]
    plane = a * np.float32(1.0 - float(of_sums.sum()))
    for weight, low in zip(of_sums, guides.images, strict=True):
        plane += weight * low
    for number in reversed(range(levels)):
        if flat:
            plane = haar.synthesise(plane, gathered[number], 2**number, True)
        else:
            settle(plane, gathered[number], 2**number)
            plane = gathered[number]
    return plane


def candidate_by_candidate(
    a: Array, v: Array, guides: Guides, noise: Noise, w: Array, h: int, flat: bool = False
) -> tuple[Array, Array, Guides, Array]:
    """One level with known weights: block sums, their variance, those of the guides, and the estimated details."""
    bands, v, guides = _analysed(a, v, guides, noise, h, flat)
    details = sum(weight * candidate for weight, candidate in zip(w, bands.candidates(), strict=True))
    return bands.s, v, guides, np.asarray(details)


def in_one_pass(
    a: Array, v: Array, guides: Guides, noise: Noise, w: Array, h: int
) -> tuple[Array, Array, Guides, Array]:
    """The same of a plane in one pass; the details come gathered into the level below. One row of ``v`` means all."""
    v = haar.children_sum(v, h, False) if len(v) > 1 else 2.0 * (v[:, h:] + v[:, :-h])
    s, lows, gathered = level_pass(a, np.asarray(guides.images), v, noise.alpha, 3.0 * BUMP, guides.noise, w, h)
    return s, v, Guides(lows, guides.noise), gathered


def _one_row_for_all(variance: Array) -> Array:
    """The first row of a map whose rows are all the same, else the map."""
    same = variance.strides[0] == 0 or bool((variance == variance[:1]).all())
    return np.ascontiguousarray(variance[:1] if same else variance, np.float32)
