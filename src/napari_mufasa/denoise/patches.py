"""A second pass over one image: like patches of a first estimate are filtered together.

The first estimate (the pilot) says which patches look alike, how noisy each pixel is, and, in the second round, how
strong each frequency of a group is. The noise is made white by the tangent, at the pilot, of the root that would
stabilise it: that is linear in the data, so no bias is made at low counts that an inverse would have to take back.

How much of the result is taken is decided by its risk, estimated as for the first pass; as the filter is no sum of
known functions, its derivative is measured by disturbing the data a little along a random sign pattern.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from .let import Noise

    Array = NDArray[Any]

SIDE = 8
GROUP = 16
#: Like patches are looked for this many pixels away in either direction.
REACH = 9
#: Distance between reference patches.
STEP = 4
#: Disturbance of the data that measures the derivative, in noise standard deviations.
PROBE = 0.1
#: Patches that differ by more than this many noise variances per pixel are not alike.
MATCH = 2.0
#: The pilot's signal is taken to be at least this share of one electron's when the noise level is computed.
FLOOR = 0.1


def _cosines() -> NDArray[np.float32]:
    k, n = np.mgrid[:SIDE, :SIDE]
    basis = np.sqrt(2.0 / SIDE) * np.cos(np.pi * (n + 0.5) * k / SIDE)
    basis[0] /= np.sqrt(2.0)
    return np.asarray(basis, np.float32)


COSINES = _cosines()


@njit(cache=True, fastmath=True, nogil=True)
def _transform(block: Array, basis: Array, work: Array) -> None:
    """In place: ``basis @ block @ basis.T``."""
    for i in range(SIDE):
        for j in range(SIDE):
            total = np.float32(0.0)
            for k in range(SIDE):
                total += basis[j, k] * block[i, k]
            work[i, j] = total
    for i in range(SIDE):
        for j in range(SIDE):
            block[i, j] = np.float32(0.0)
        for k in range(SIDE):
            w = basis[i, k]
            for j in range(SIDE):
                block[i, j] += w * work[k, j]


@njit(cache=True, fastmath=True, nogil=True)
def _along(group: Array, n: int, work: Array, inverse: bool) -> None:
    """Orthonormal Haar transform in place along the first axis of ``group`` (n, 64); n is a power of two."""
    root = np.float32(np.sqrt(0.5))
    size = 2 if inverse else n
    while 2 <= size <= n:
        half = size // 2
        for k in range(half):
            for p in range(SIDE * SIDE):
                if inverse:
                    work[2 * k, p] = root * (group[k, p] + group[half + k, p])
                    work[2 * k + 1, p] = root * (group[k, p] - group[half + k, p])
                else:
                    work[k, p] = root * (group[2 * k, p] + group[2 * k + 1, p])
                    work[half + k, p] = root * (group[2 * k, p] - group[2 * k + 1, p])
        for k in range(size):
            for p in range(SIDE * SIDE):
                group[k, p] = work[k, p]
        size = size * 2 if inverse else half


@njit(cache=True, fastmath=True, nogil=True)
def _nearest(pilot: Array, r: int, c: int, places: Array, far: Array) -> int:
    """Places (row, col) of the ``GROUP`` patches of the pilot most like the one at (r, c), the nearest first."""
    rows, cols = pilot.shape
    found = 0
    for i in range(max(0, r - REACH), min(rows - SIDE, r + REACH) + 1):
        for j in range(max(0, c - REACH), min(cols - SIDE, c + REACH) + 1):
            distance = np.float32(0.0)
            limit = far[found - 1] if found == GROUP else np.float32(np.inf)
            for a in range(SIDE):
                for b in range(SIDE):
                    x = pilot[r + a, c + b] - pilot[i + a, j + b]
                    distance += x * x
                if distance > limit:
                    break
            if i == r and j == c:
                distance = np.float32(-1.0)
            if distance >= limit or distance > MATCH * SIDE * SIDE:
                continue
            k = min(found, GROUP - 1)
            while k > 0 and far[k - 1] > distance:
                far[k] = far[k - 1]
                places[k, 0], places[k, 1] = places[k - 1, 0], places[k - 1, 1]
                k -= 1
            far[k] = distance
            places[k, 0], places[k, 1] = i, j
            found = min(found + 1, GROUP)
    n = 1
    while 2 * n <= found:
        n *= 2
    return n


@njit(cache=True, fastmath=True, nogil=True)
def _spectra(image: Array, places: Array, n: int, basis: Array, out: Array, block: Array, work: Array) -> None:
    """Cosine transform of the ``n`` patches, then Haar across them, into ``out``."""
    for k in range(n):
        i, j = places[k, 0], places[k, 1]
        for a in range(SIDE):
            for b in range(SIDE):
                block[a, b] = image[i + a, j + b]
        _transform(block, basis, work[:SIDE, :SIDE])
        for a in range(SIDE):
            for b in range(SIDE):
                out[k, a * SIDE + b] = block[a, b]
    _along(out, n, work, False)


@njit(cache=True, fastmath=True, nogil=True)
def _filtered(z: Array, pilot: Array, window: Array, basis: Array, step: int) -> Array:
    """White data ``z`` filtered group by group; ``pilot`` in the same units."""
    rows, cols = z.shape
    total = np.zeros((rows, cols), np.float32)
    weight = np.zeros((rows, cols), np.float32)
    places = np.zeros((GROUP, 2), np.int64)
    far = np.zeros(GROUP, np.float32)
    data = np.empty((GROUP, SIDE * SIDE), np.float32)
    guess = np.empty((GROUP, SIDE * SIDE), np.float32)
    work = np.empty((GROUP, SIDE * SIDE), np.float32)
    block = np.empty((SIDE, SIDE), np.float32)
    back = basis.T.copy()
    for ri in range(-(-(rows - SIDE) // step) + 1):
        r = min(ri * step, rows - SIDE)
        for ci in range(-(-(cols - SIDE) // step) + 1):
            c = min(ci * step, cols - SIDE)
            n = _nearest(pilot, r, c, places, far)
            _spectra(z, places, n, basis, data, block, work)
            _spectra(pilot, places, n, basis, guess, block, work)
            power = np.float32(1e-3)
            for k in range(n):
                for p in range(SIDE * SIDE):
                    gain = guess[k, p] * guess[k, p]
                    gain /= gain + np.float32(1.0)
                    power += gain * gain
                    data[k, p] *= gain
            _along(data, n, work, True)
            # The noise that a group lets through is its weight's inverse.
            share = np.float32(1.0) / power
            for k in range(n):
                i, j = places[k, 0], places[k, 1]
                for a in range(SIDE):
                    for b in range(SIDE):
                        block[a, b] = data[k, a * SIDE + b]
                _transform(block, back, work[:SIDE, :SIDE])
                for a in range(SIDE):
                    for b in range(SIDE):
                        w = share * window[a, b]
                        total[i + a, j + b] += w * block[a, b]
                        weight[i + a, j + b] += w
    for r in range(rows):
        for c in range(cols):
            total[r, c] /= weight[r, c]
    return total


def _window() -> NDArray[np.float32]:
    edge = np.kaiser(SIDE, 2.0)
    return np.outer(edge, edge).astype(np.float32)


WINDOW = _window()


def collaborate(data: Array, pilot: Array, noise: Noise, step: int = STEP) -> Array:
    """One round: Wiener filter of groups of like patches, the pilot standing for the signal."""
    alpha, variance = noise.alpha, np.broadcast_to(noise.variance, data.shape)
    lifted = np.maximum(pilot, np.float32(FLOOR * alpha))
    level = np.sqrt(alpha * lifted + variance).astype(np.float32)
    stable = np.sqrt(alpha * lifted + np.float32(np.mean(variance))).astype(np.float32)
    known = 2.0 / alpha * stable + (pilot - lifted) / stable if alpha > 0 else pilot / stable
    known = np.ascontiguousarray(known, np.float32)
    white = np.ascontiguousarray(known + (data - pilot) / level, np.float32)
    out: Array = pilot + level * (_filtered(white, known, WINDOW, COSINES, step) - known)
    return out


def refined(data: Array, pilot: Array, noise: Noise) -> Array:
    """Mean of two rounds, the first's result being the second's pilot."""
    first = collaborate(data, pilot, noise)
    out: Array = np.float32(0.5) * (first + collaborate(data, first, noise))
    return out


def towards(data: Array, pilot: Array, noise: Noise, way: float) -> Array:
    """The pilot moved by the share ``way`` to `refined`, with the pilot's mean."""
    change = refined(data, pilot, noise) - pilot
    out: Array = pilot + np.float32(way) * (change - np.float32(change.mean(dtype=np.float64)))
    return out


def big_enough(shape: tuple[int, ...]) -> bool:
    """Whether patches fit a plane."""
    return min(shape) >= 2 * SIDE


def judge(data: Array, noise: Noise, first_pass: Callable[[Array], Array]) -> tuple[float, float]:
    """How far to go from the pilot, made by ``first_pass``, to `refined`: from 0 to 1, and what it adds to the risk.

    To first order E[x F(y)] = E[y F(y) - (alpha y + variance) F'(y)]; one disturbed run of both passes measures the
    sum of the derivatives. With alpha y itself the sum scatters, and is too low where there is hardly a count per
    pixel; with the pilot in its place it is steady and too high there. The way is taken from the mean of both, the
    risk from the first.
    """
    signs = np.random.default_rng(0).choice(np.array([-1.0, 1.0], np.float32), data.shape)
    shift = np.float32(PROBE * np.sqrt(max(float(np.mean(noise.alpha * data + noise.variance)), 1e-30)))

    def change(y: Array, pilot: Array) -> Array:
        return np.asarray(refined(y, pilot, noise) - pilot, np.float64)

    pilot = first_pass(data)
    disturbed = data + shift * signs
    here = change(data, pilot)
    slope = (change(disturbed, first_pass(disturbed)) - here) * signs / float(shift)
    size = float(np.mean(here * here))
    known = np.maximum(pilot, np.float32(0.0))
    steady, plain = (
        float(np.mean((data - pilot) * here - (noise.alpha * level + noise.variance) * slope))
        for level in (known, data)
    )
    way = min(max(0.5 * (steady + plain) / max(size, 1e-30), 0.0), 1.0)
    return way, way * (way * size - 2.0 * plain)
