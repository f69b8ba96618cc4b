"""Linear expansion of thresholds: candidate functions, their unbiased risk terms, and the weights that minimise it.

Let y = z + b with E[z] = x, variance alpha * x, and b Gaussian of variance sigma^2. For any function F of the data the
mean of x_i F_i(y) has an unbiased estimate from y alone: evaluate F where pixel i holds ``step`` less, weight it with
y_i, and take the derivative off for the Gaussian part. In the unnormalised Haar transform a pixel enters a detail
coefficient w with weight +1 or -1 and its block sum s with weight +1, so "pixel i holds ``step`` less" reads
(w - step, s - step) or (w + step, s - step): two evaluations per coefficient give the term of the whole block, exactly.

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

#: Width of the threshold bump, in noise variances, and of the neighbour classes.
BUMP = 6.0
CLASS = 2.0
#: Share of a coefficient's own block in its noise level; the rest comes from the blocks beside it.
OWN = 0.5
#: Step of the difference that stands for the derivatives in the electron-multiplied case, in units of the gain.
EM_STEP = 0.5
SPATIAL = 4
PER_GUIDE = 4


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

    def solve(self, ridge: float = 1e-5) -> Array:
        """Weights of least estimated risk; the ridge only settles directions that the data do not determine."""
        scale = np.sqrt(np.maximum(np.diag(self.gram), 1e-30))
        normal = self.gram / np.outer(scale, scale) + ridge * np.eye(scale.size)
        weights: Array = np.linalg.solve(normal, self.cross / scale) / scale
        return weights


@njit(cache=True, inline="always", fastmath=True)  # type: ignore[untyped-decorator]
def _threshold(u: float, scale: float, slope: float) -> tuple[float, float, float]:
    """u * bump(u^2 / scale), its derivative in u, and in the block sum (``slope`` = d scale / d block sum)."""
    x = u * u / scale
    rest = max(0.0, 1.0 - 0.25 * x)
    bump_slope = -rest * rest * rest
    value = u * rest * rest * rest * rest
    return value, rest * rest * rest * rest + 2.0 * x * bump_slope, -u * bump_slope * x / scale * slope


@njit(cache=True, inline="always", fastmath=True)  # type: ignore[untyped-decorator]
def _class_weight(energy: float) -> float:
    """Smoothly 1 where the neighbourhood is empty, 0 where it is full: a cheap stand-in for exp(-energy)."""
    rest = max(0.0, 1.0 - 0.125 * energy)
    rest *= rest
    rest *= rest
    return rest * rest


@njit(cache=True, fastmath=True, nogil=True)  # type: ignore[untyped-decorator]
def candidates(
    w: Array, s: Array, s_beside: Array, energy: Array, variance: Array, guides: Array, guide_noise: Array, alpha: float
) -> Array:
    """Candidate values of one band, (K, rows, cols): thresholds of the coefficient, and of each guide's prediction."""
    rows, cols = w.shape
    n_guides = guides.shape[0]
    out = np.empty((SPATIAL + PER_GUIDE * n_guides, rows, cols), w.dtype)
    for r in range(rows):
        for c in range(cols):
            own = s[r, c]
            base = variance[r, c] + alpha * ((1.0 - OWN) * max(s_beside[r, c], 0.0) + 0.25 * alpha) + 1e-9
            level = base + OWN * alpha * max(own, 0.0)
            g = _class_weight(energy[r, c] / (CLASS * (base + OWN * alpha * max(s_beside[r, c], 0.0))))
            value = _threshold(w[r, c], BUMP * level, 0.0)[0]
            out[0, r, c] = w[r, c]
            out[1, r, c] = w[r, c] * g
            out[2, r, c] = value
            out[3, r, c] = value * g
            for k in range(n_guides):
                v = guides[k, r, c]
                value = _threshold(w[r, c] - v, BUMP * level * (1.0 + guide_noise[k]), 0.0)[0]
                first = SPATIAL + PER_GUIDE * k
                out[first, r, c] = v
                out[first + 1, r, c] = v * g
                out[first + 2, r, c] = value
                out[first + 3, r, c] = value * g
    return out


@njit(cache=True, inline="always", fastmath=True)  # type: ignore[untyped-decorator]
def _at(
    u: float, s: float, more: float, rest: float, alpha: float, wider: float, yp: float, ym: float, vp: float, vm: float
) -> float:
    """Risk term of one thresholded coefficient where the pixel in question holds ``more`` photoelectrons more."""
    block = s + more
    level = wider * (rest + OWN * alpha * max(block, 0.0))
    slope = wider * OWN * alpha if block > 0.0 else 0.0
    f_p, fu_p, fs_p = _threshold(u + more, level, slope)
    f_m, fu_m, fs_m = _threshold(u - more, level, slope)
    return yp * f_p - ym * f_m - vp * (fu_p + fs_p) - vm * (fu_m - fs_m)


@njit(cache=True, fastmath=True, nogil=True)  # type: ignore[untyped-decorator]
def cross_terms(
    w: Array,
    s: Array,
    s_beside: Array,
    energy: Array,
    variance: Array,
    guides: Array,
    guide_noise: Array,
    alpha: float,
    stencil: tuple[float, float, float, float],
    y_plus: Array,
    y_minus: Array,
    v_plus: Array,
    v_minus: Array,
) -> Array:
    """Unbiased estimates of sum_i x_i F_i for every candidate of one band.

    ``y_plus`` and ``y_minus`` hold, per block, the data of its positive and negative pixels weighted with what the
    coefficient contributes to them in the synthesis; ``v_plus`` and ``v_minus`` the same of the Gaussian variance.
    """
    rows, cols = w.shape
    n_guides = guides.shape[0]
    total = np.zeros(SPATIAL + PER_GUIDE * n_guides)
    step, share_less, share_here, share_more = stencil
    for r in range(rows):
        for c in range(cols):
            rest = variance[r, c] + alpha * ((1.0 - OWN) * max(s_beside[r, c], 0.0) + 0.25 * alpha) + 1e-9
            g = _class_weight(energy[r, c] / (CLASS * (rest + OWN * alpha * max(s_beside[r, c], 0.0))))
            yp, ym, vp, vm = y_plus[r, c], y_minus[r, c], v_plus[r, c], v_minus[r, c]
            constant = yp - ym
            x, own = w[r, c], s[r, c]
            linear = constant * x - (share_less - share_more) * step * (yp + ym) - (vp + vm)
            total[0] += linear
            total[1] += linear * g
            for k in range(-1, n_guides):
                v = 0.0
                wider = BUMP
                if k >= 0:
                    v = guides[k, r, c]
                    wider *= 1.0 + guide_noise[k]
                u = x - v
                term = share_less * _at(u, own, -step, rest, alpha, wider, yp, ym, vp, vm)
                if share_more != 0.0:
                    term += share_more * _at(u, own, step, rest, alpha, wider, yp, ym, vp, vm)
                if share_here != 0.0:
                    term += share_here * _at(u, own, 0.0, rest, alpha, wider, yp, ym, vp, vm)
                first = SPATIAL + PER_GUIDE * k + 2 if k >= 0 else 2
                total[first] += term
                total[first + 1] += term * g
                if k >= 0:
                    total[first - 2] += constant * v
                    total[first - 1] += constant * v * g
    return total


@njit(cache=True, fastmath=True, nogil=True)  # type: ignore[untyped-decorator]
def combine(
    w: Array,
    s: Array,
    s_beside: Array,
    energy: Array,
    variance: Array,
    guides: Array,
    guide_noise: Array,
    alpha: float,
    weights: Array,
) -> Array:
    """The weighted sum of :func:`candidates`, without storing them."""
    rows, cols = w.shape
    n_guides = guides.shape[0]
    out = np.empty((rows, cols), w.dtype)
    for r in range(rows):
        for c in range(cols):
            own = s[r, c]
            base = variance[r, c] + alpha * ((1.0 - OWN) * max(s_beside[r, c], 0.0) + 0.25 * alpha) + 1e-9
            level = BUMP * (base + OWN * alpha * max(own, 0.0))
            g = _class_weight(energy[r, c] / (CLASS * (base + OWN * alpha * max(s_beside[r, c], 0.0))))
            x = w[r, c]
            value = (weights[0] + weights[1] * g) * x
            value += (weights[2] + weights[3] * g) * _threshold(x, level, 0.0)[0]
            for k in range(n_guides):
                v = guides[k, r, c]
                first = SPATIAL + PER_GUIDE * k
                value += (weights[first] + weights[first + 1] * g) * v
                value += (weights[first + 2] + weights[first + 3] * g) * _threshold(
                    x - v, level * (1.0 + guide_noise[k]), 0.0
                )[0]
            out[r, c] = value
    return out


def _empty_guides(shape: tuple[int, int], dtype: Any) -> Array:
    return np.zeros((0, *shape), dtype)


def _energy(band: Array, guide_bands: list[Array], guide_noise: Array, length: int, flat: bool) -> Array:
    """How much signal the neighbourhood shows, in units of the band's variance, from data independent of the block."""
    energy: Array = haar.beside(band, length, flat, True)
    if guide_bands:
        # A guide shows the coefficient itself: its square weighs as much as the whole neighbourhood.
        energy = 0.5 * energy
        for guide, noise in zip(guide_bands, guide_noise, strict=True):
            energy += (0.5 / len(guide_bands) / max(float(noise), 0.05)) * guide * guide
    return energy


def expand(
    image: Array, noise: Noise, levels: int, flat: bool, guides: list[Array], guide_noise: Array
) -> tuple[System, Array]:
    """Risk system of one image or window, and the candidates as images (K + 1, pixels), the fixed low part first.

    ``guides`` are images of the same scene whose noise is independent of ``image`` (neighbouring frames);
    ``guide_noise`` their variance relative to the image's.
    """
    shape = image.shape
    signs_all = haar.SIGNS_1D if flat else haar.SIGNS_2D
    low = haar.LOW_1D if flat else haar.LOW_2D
    variance = np.broadcast_to(noise.variance, shape).astype(image.dtype)
    a, b, v, v_adjoint, lows = image, image, variance, variance, list(guides)
    shapes: list[tuple[int, int]] = []
    planes: list[Array] = []
    cross: list[float] = []
    for level in range(levels):
        h = 2**level
        shapes.append(a.shape)  # type: ignore[arg-type]
        s, details = haar.analyse(a, h, flat)
        guide_details = []
        for k, guide in enumerate(lows):
            lows[k], bands = haar.analyse(guide, h, flat)
            guide_details.append(bands)
        b_covered, v_covered = haar.covered(b, h, flat), haar.covered(v_adjoint, h, flat)
        block_variance = haar.children_sum(v, h, low, flat)
        s_beside = haar.beside(s, 2 * h, flat, False)
        per_band: list[Array] = []
        terms = np.zeros(SPATIAL + PER_GUIDE * len(guides))
        for o, signs in enumerate(signs_all):
            bands_here = [g[o] for g in guide_details]
            stack = np.stack(bands_here) if bands_here else _empty_guides(s.shape, s.dtype)
            energy = _energy(details[o], bands_here, guide_noise, 2 * h, flat)
            arguments = (details[o], s, s_beside, energy, block_variance, stack, guide_noise, noise.alpha)
            per_band.append(candidates(*arguments))
            terms += cross_terms(
                *arguments,
                noise.stencil(),
                haar.children_sum(b_covered, h, signs, flat),
                haar.children_sum(b_covered, h, -signs, flat),
                haar.children_sum(v_covered, h, signs, flat),
                haar.children_sum(v_covered, h, -signs, flat),
            )
        # One weight for all orientations: a microscope prefers none, and a third of the weights is a third of the
        # over-fitting.
        for k in range(terms.size):
            plane = haar.synthesise(None, np.stack([band[k] for band in per_band]), h, flat, shapes[level])
            for below in reversed(range(level)):
                plane = haar.synthesise(plane, None, 2**below, flat, shapes[below])
            planes.append(plane)
            cross.append(terms[k])
        a, v = s, block_variance
        b, v_adjoint = haar.children_sum(b_covered, h, low, flat), haar.children_sum(v_covered, h, low, flat)

    def down(plane: Array) -> Array:
        for below in reversed(range(levels)):
            plane = haar.synthesise(plane, None, 2**below, flat, shapes[below])
        return plane

    fixed = down(a)
    b64 = b.astype(np.float64)
    fixed_cross = float((b64 * a).sum() - noise.alpha * b64.sum() - v_adjoint.sum(dtype=np.float64))
    for guide in lows:
        planes.append(down(guide) - fixed)
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
    """The estimator with given weights, band by band and without storing the candidates."""
    low = haar.LOW_1D if flat else haar.LOW_2D
    per_level = SPATIAL + PER_GUIDE * len(guides)
    weights = np.asarray(weights, image.dtype)
    a, lows = image, list(guides)
    v = np.broadcast_to(noise.variance, image.shape).astype(image.dtype)
    kept: list[tuple[tuple[int, int], Array]] = []
    for level in range(levels):
        h = 2**level
        s, details = haar.analyse(a, h, flat)
        guide_details = []
        for k, guide in enumerate(lows):
            lows[k], bands = haar.analyse(guide, h, flat)
            guide_details.append(bands)
        v = haar.children_sum(v, h, low, flat)
        s_beside = haar.beside(s, 2 * h, flat, False)
        for o in range(details.shape[0]):
            bands_here = [g[o] for g in guide_details]
            stack = np.stack(bands_here) if bands_here else _empty_guides(s.shape, s.dtype)
            energy = _energy(details[o], bands_here, guide_noise, 2 * h, flat)
            chosen = weights[level * per_level : (level + 1) * per_level]
            details[o] = combine(details[o], s, s_beside, energy, v, stack, guide_noise, noise.alpha, chosen)
        kept.append((a.shape, details))  # type: ignore[arg-type]
        a = s
    extra = weights[levels * per_level :]
    plane = a * image.dtype.type(1.0 - float(extra.sum()))
    for weight, guide in zip(extra, lows, strict=True):
        plane = plane + weight * guide
    for level in reversed(range(levels)):
        shape, details = kept[level]
        plane = haar.synthesise(plane, details, 2**level, flat, shape)
    return plane
