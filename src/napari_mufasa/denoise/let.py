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
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit

from . import haar

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

#: Width of the threshold bump in noise variances, per orientation.
BUMP = 4.0
#: Widths of the neighbour classes: an empty surrounding, and one that is not quite empty.
CLASS_NARROW, CLASS_WIDE = 1.0, 4.0
#: Share of a coefficient's own block in its noise level; the rest comes from the blocks beside it.
OWN = 0.5
#: Step of the difference that stands for the derivatives in the electron-multiplied case, in units of the gain.
EM_STEP = 0.5
#: Candidates per level: {coefficient, thresholded} x {everywhere, empty surrounding, nearly empty surrounding}.
SPATIAL = 6
#: Candidates per level and guide: {prediction, thresholded difference from it} x {everywhere, empty surrounding}.
PER_GUIDE = 4
#: Directions in weight space whose share of the risk is below this many noise variances are faded out.
DOUBT = 2.0
ZERO, ONE, EIGHTH = np.float32(0.0), np.float32(1.0), np.float32(0.125)
NARROW, WIDE = np.float32(1.0 / CLASS_NARROW), np.float32(1.0 / CLASS_WIDE)


@dataclass(frozen=True)
class Noise:
    """Noise of one image: E[y] = x, Var[y] = alpha * x + variance (scalar or per pixel)."""

    alpha: float
    variance: Array
    multiplied: bool = False

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

    def __add__(self, other: System) -> System:
        return System(
            self.gram + other.gram,
            self.cross + other.cross,
            self.rest + other.rest,
            self.noise + other.noise,
            self.n_pixels + other.n_pixels,
        )

    def risk(self, weights: Array) -> float:
        """Estimated mean squared error per pixel of the estimator with these weights."""
        total = weights @ self.gram @ weights - 2.0 * weights @ self.cross + self.rest
        return float(total / self.n_pixels)

    def noise_variance(self) -> float:
        """Estimated mean squared error per pixel of the data themselves."""
        return self.noise / self.n_pixels

    def solve(self, doubt: float = DOUBT) -> Array:
        """Weights of least estimated risk, faded where the risk's own noise decides.

        In coordinates in which the Gram matrix is the identity, each coordinate carries noise of about the noise
        energy of one pixel. A coordinate whose square is not ``doubt`` times above that is fitted to chance: it is
        shrunk by the positive part of 1 - doubt * noise / square. ``doubt=0`` is plain least squares.
        """
        scale = np.sqrt(np.maximum(np.diag(self.gram), 1e-30))
        values, vectors = np.linalg.eigh(self.gram / np.outer(scale, scale))
        # Single precision carries about five digits into the Gram matrix; smaller directions are rounding.
        kept = values > 1e-5 * values[-1]
        values, vectors = values[kept], vectors[:, kept]
        along = vectors.T @ (self.cross / scale) / np.sqrt(values)
        doubtful = doubt * max(self.noise_variance(), 0.0)
        along *= np.maximum(0.0, 1.0 - doubtful / np.maximum(along**2, 1e-30))
        weights: Array = vectors @ (along / np.sqrt(values)) / scale
        return weights


@njit(cache=True, inline="always", fastmath=True)
def _class_weight(energy: Any) -> Any:
    """Smoothly 1 where the neighbourhood is empty, 0 where it is full: a cheap stand-in for exp(-energy)."""
    rest = max(ZERO, ONE - EIGHTH * energy)
    rest *= rest
    rest *= rest
    return rest * rest


@njit(cache=True, fastmath=True, nogil=True)
def surroundings(s_beside: Array, energy: Array, variance: Array, alpha: float) -> tuple[Array, Array, Array]:
    """Noise level without the block's own share, and the two class weights; none depends on the block's own pixels."""
    rows, cols = s_beside.shape
    rest = np.empty((rows, cols), s_beside.dtype)
    narrow = np.empty((rows, cols), s_beside.dtype)
    wide = np.empty((rows, cols), s_beside.dtype)
    own = np.float32(OWN * alpha)
    other = np.float32((1.0 - OWN) * alpha)
    floor = np.float32(0.25 * alpha * alpha + 1e-9)
    for r in range(rows):
        for c in range(cols):
            beside = max(s_beside[r, c], ZERO)
            base = variance[r, c] + other * beside + floor
            x = energy[r, c] / (base + own * beside)
            rest[r, c] = base
            narrow[r, c] = _class_weight(x * NARROW)
            wide[r, c] = _class_weight(x * WIDE)
    return rest, narrow, wide


@njit(cache=True, fastmath=True, nogil=True)
def bumps(d: Array, s: Array, rest: Array, guide: Array, own: float, width: float) -> Array:
    """Share of each block's details (less the guide's) that the threshold keeps as noise-like: 1 at 0, 0 far out."""
    rows, cols = s.shape
    out = np.empty((rows, cols), d.dtype)
    own32 = np.float32(own)
    scale = np.float32(0.25 / width)
    for r in range(rows):
        for c in range(cols):
            a, b, e = d[0, r, c] - guide[0, r, c], d[1, r, c] - guide[1, r, c], d[2, r, c] - guide[2, r, c]
            level = rest[r, c] + own32 * max(s[r, c], ZERO)
            left = max(ZERO, ONE - scale * (a * a + b * b + e * e) / level)
            left *= left
            out[r, c] = left * left
    return out


@njit(cache=True, fastmath=True, nogil=True)
def linear_terms(d: Array, y: Array, v: Array, step_mean: float, bands: float) -> Array:
    """Risk terms of the details themselves, per block; ``y`` and ``v`` (child, rows, cols) as in `threshold_terms`."""
    rows, cols = d.shape[1:]
    out = np.empty((rows, cols), d.dtype)
    for r in range(rows):
        for c in range(cols):
            y0, y1, y2, y3 = y[0, r, c], y[1, r, c], y[2, r, c], y[3, r, c]
            part = d[0, r, c] * (y0 - y1 + y2 - y3) + d[1, r, c] * (y0 + y1 - y2 - y3)
            part += d[2, r, c] * (y0 - y1 - y2 + y3)
            noise = step_mean * (y0 + y1 + y2 + y3) + v[0, r, c] + v[1, r, c] + v[2, r, c] + v[3, r, c]
            out[r, c] = part - bands * noise
    return out


@njit(cache=True, fastmath=True, nogil=True)
def threshold_terms(
    d: Array,
    s: Array,
    rest: Array,
    guide: Array,
    own: float,
    width: float,
    y: Array,
    v: Array,
    stencil: tuple[float, float, float, float],
    bands: float,
) -> Array:
    """Unbiased estimates, per block, of x times what the thresholded details (less the guide's) add to the image.

    ``y[k]`` holds the data of the block's k-th child weighted with what a detail adds to those pixels in the
    synthesis; ``v[k]`` the same of the Gaussian variance.
    """
    rows, cols = s.shape
    out = np.empty((rows, cols), d.dtype)
    step = stencil[0]
    for r in range(rows):
        for c in range(cols):
            a, b, e = d[0, r, c] - guide[0, r, c], d[1, r, c] - guide[1, r, c], d[2, r, c] - guide[2, r, c]
            total = 0.0
            for k in range(4):
                sign_a = 1.0 - 2.0 * (k & 1)
                sign_b = 1.0 - (k & 2)
                sign_e = sign_a * sign_b
                yk, vk = y[k, r, c], v[k, r, c]
                if yk == 0.0 and vk == 0.0:
                    continue
                for side in range(3):
                    share = stencil[side + 1]
                    if share == 0.0:
                        continue
                    more = step * (side - 1)
                    block = s[r, c] + more
                    level = rest[r, c] + own * max(block, 0.0)
                    p, q, t = a + sign_a * more, b + sign_b * more, e + sign_e * more
                    signed = sign_a * p + sign_b * q + sign_e * t
                    x = 0.25 / width * (p * p + q * q + t * t) / level
                    left = max(0.0, 1.0 - x)
                    cube = left * left * left
                    slope = 0.5 / width * signed / level - (x * own / level if block > 0.0 else 0.0)
                    value = cube * left * signed
                    # Along the pixel's direction every detail changes by its sign: their signs' squares sum to the number of bands.
                    change = cube * left * bands - 4.0 * cube * slope * signed
                    total += share * (yk * value - vk * change)
            out[r, c] = total
    return out


@njit(cache=True, fastmath=True, nogil=True)
def combine(d: Array, bump: Array, narrow: Array, wide: Array, w: Array) -> None:
    """Replace the details by the weighted sum of their spatial candidates."""
    bands, rows, cols = d.shape
    w0, w1, w2, w3, w4, w5 = w[0], w[1], w[2], w[3], w[4], w[5]
    for r in range(rows):
        for c in range(cols):
            g, h = narrow[r, c], wide[r, c]
            factor = (w0 + w1 * g + w2 * h) + bump[r, c] * (w3 + w4 * g + w5 * h)
            for o in range(bands):
                d[o, r, c] *= factor


@njit(cache=True, fastmath=True, nogil=True)
def combine_guide(out: Array, d: Array, guide: Array, bump: Array, narrow: Array, w: Array) -> None:
    """Add the weighted candidates of one guide; ``d`` are the details before `combine`."""
    bands, rows, cols = d.shape
    w0, w1, w2, w3 = w[0], w[1], w[2], w[3]
    for r in range(rows):
        for c in range(cols):
            g = narrow[r, c]
            direct = w0 + w1 * g
            shrunk = bump[r, c] * (w2 + w3 * g)
            for o in range(bands):
                v = guide[o, r, c]
                out[o, r, c] += direct * v + shrunk * (d[o, r, c] - v)


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


class _Level:
    """What one level of the transform knows before any weight: details, noise level, classes."""

    def __init__(
        self, a: Array, variance: Array, lows: list[Array], guide_noise: Array, noise: Noise, h: int, flat: bool
    ) -> None:
        self.h, self.flat, self.shape = h, flat, a.shape
        self.s, details = haar.analyse(a, h, flat)
        self.d = _three_bands(details)
        self.width = BUMP * (1.0 if flat else 3.0)
        self.own = OWN * noise.alpha
        self.variance = haar.children_sum(variance, h, haar.LOW_1D if flat else haar.LOW_2D, flat)
        self.lows: list[Array] = []
        self.guides: list[Array] = []
        for low in lows:
            guide_s, bands = haar.analyse(low, h, flat)
            self.lows.append(guide_s)
            self.guides.append(_three_bands(bands))
        energy = haar.energy_beside(details, 2 * h, flat)
        if self.guides:
            # A guide shows the coefficient itself: its square weighs as much as the whole neighbourhood.
            energy *= np.float32(0.5)
            for guide, relative in zip(self.guides, guide_noise, strict=True):
                share = 0.5 / len(self.guides) / max(float(relative), 0.05) / details.shape[0]
                haar.add_energy(energy, guide, share)
        s_beside = haar.mean_beside(self.s, 2 * h, flat)
        self.rest, self.narrow, self.wide = surroundings(s_beside, energy, self.variance, noise.alpha)
        self.zero = np.zeros_like(self.d)
        self.guide_noise = guide_noise

    def bump(self, guide: int) -> Array:
        """Threshold of the details (guide -1) or of their difference from a guide."""
        reference = self.zero if guide < 0 else self.guides[guide]
        out: Array = bumps(self.d, self.s, self.rest, reference, self.own, self.guide_width(guide))
        return out

    def guide_width(self, guide: int) -> float:
        return self.width * (1.0 if guide < 0 else 1.0 + float(self.guide_noise[guide]))

    def candidates(self) -> list[Array]:
        """Details (3, rows, cols) of every candidate, in the order of the weights."""
        bump = self.bump(-1)
        out = [self.d * g for g in (1.0, self.narrow, self.wide)]
        out += [self.d * (bump * g) for g in (np.float32(1.0), self.narrow, self.wide)]
        for k, guide in enumerate(self.guides):
            bump = self.bump(k)
            out += [guide, guide * self.narrow, (self.d - guide) * bump, (self.d - guide) * (bump * self.narrow)]
        return [np.asarray(c, self.d.dtype) for c in out]

    def terms(self, y: Array, v: Array, noise: Noise) -> list[float]:
        """Unbiased estimates of the sum of x times every candidate's image."""
        step, less, here, more = noise.stencil()
        bands = 1.0 if self.flat else 3.0
        linear = linear_terms(self.d, y, v, (less - more) * step, bands)
        classes = (None, self.narrow, self.wide)

        def sums(per_block: Array, weights: tuple[Array | None, ...]) -> list[float]:
            return [float(np.sum(per_block if g is None else per_block * g, dtype=np.float64)) for g in weights]

        def thresholded(guide: int) -> Array:
            reference = self.zero if guide < 0 else self.guides[guide]
            out: Array = threshold_terms(
                self.d, self.s, self.rest, reference, self.own, self.guide_width(guide), y, v,
                (step, less, here, more), bands,
            )  # fmt: skip
            return out

        out = sums(linear, classes) + sums(thresholded(-1), classes)
        for k, guide in enumerate(self.guides):
            known = linear_terms(guide, y, np.zeros_like(v), 0.0, bands)
            out += sums(known, classes[:2]) + sums(thresholded(k), classes[:2])
        return out


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
    planes: list[Array] = []
    cross: list[float] = []

    def down(plane: Array, level: int) -> Array:
        for below in reversed(range(level)):
            plane = haar.synthesise(plane, None, 2**below, flat, shapes[below])
        return plane

    for number in range(levels):
        h = 2**number
        shapes.append(a.shape)
        level = _Level(a, v, lows, guide_noise, noise, h, flat)
        b_covered, v_covered = haar.covered(b, h, flat), haar.covered(v_adjoint, h, flat)
        cross += level.terms(_children(b_covered, h, flat), _children(v_covered, h, flat), noise)
        # One weight for all orientations: a microscope prefers none, and a third of the weights is a third of the
        # over-fitting.
        for candidate in level.candidates():
            plane = haar.synthesise(None, candidate[: 1 if flat else 3], h, flat, shapes[number])
            planes.append(down(plane, number))
        a, v, lows = level.s, level.variance, level.lows
        b, v_adjoint = haar.children_sum(b_covered, h, low, flat), haar.children_sum(v_covered, h, low, flat)

    fixed = down(a, levels)
    b64 = b.astype(np.float64)
    fixed_cross = float((b64 * a).sum() - noise.alpha * b64.sum() - v_adjoint.sum(dtype=np.float64))
    for guide in lows:
        planes.append(down(guide, levels) - fixed)
        cross.append(float((b64 * guide).sum()) - fixed_cross)
    stacked = np.stack([fixed, *planes]).reshape(len(planes) + 1, -1)
    products = (stacked @ stacked.T).astype(np.float64)
    data = image.astype(np.float64)
    total_noise = noise.alpha * float(data.sum()) + float(variance.sum(dtype=np.float64))
    energy_x = float(np.sum(data * data)) - total_noise
    system = System(
        gram=products[1:, 1:],
        cross=np.asarray(cross) - products[0, 1:],
        rest=products[0, 0] - 2.0 * fixed_cross + energy_x,
        noise=total_noise,
        n_pixels=image.size,
    )
    return system, stacked


def apply(
    image: Array, noise: Noise, levels: int, flat: bool, guides: list[Array], guide_noise: Array, weights: Array
) -> Array:
    """The estimator with given weights, level by level and without storing the candidates."""
    per_level = SPATIAL + PER_GUIDE * len(guides)
    weights = np.asarray(weights, image.dtype)
    a, lows = image, list(guides)
    v = np.broadcast_to(noise.variance, image.shape).astype(image.dtype)
    kept: list[tuple[tuple[int, ...], Array]] = []
    for number in range(levels):
        level = _Level(a, v, lows, guide_noise, noise, 2**number, flat)
        w = weights[number * per_level : (number + 1) * per_level]
        out = level.d.copy() if guides else level.d
        bump = level.bump(-1)
        combine(out, bump, level.narrow, level.wide, w[:SPATIAL])
        for k, guide in enumerate(level.guides):
            first = SPATIAL + PER_GUIDE * k
            combine_guide(out, level.d, guide, level.bump(k), level.narrow, w[first : first + PER_GUIDE])
        kept.append((a.shape, out[: 1 if flat else 3]))
        a, v, lows = level.s, level.variance, level.lows
    extra = weights[levels * per_level :]
    plane = a * image.dtype.type(1.0 - float(extra.sum()))
    for weight, guide in zip(extra, lows, strict=True):
        plane = plane + weight * guide
    for number in reversed(range(levels)):
        shape, details = kept[number]
        plane = haar.synthesise(plane, details, 2**number, flat, shape)
    return plane
