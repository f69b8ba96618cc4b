"""A second pass over one image: like patches of a first estimate are filtered together.

The first estimate (the pilot) says which patches look alike, how noisy each pixel is, and, in the second round, how
strong each frequency of a group is. The noise is made white by the tangent, at the pilot, of the root that would
stabilise it: that is linear in the data, so no bias is made at low counts that an inverse would have to take back.

How much of the result is taken is decided by its risk, estimated as for the first pass; as the filter is no sum of
known functions, its derivative is measured by disturbing the data a little along a random sign pattern.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any
from zlib import crc32

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from .noise import Noise

    Array = NDArray[Any]

SIDE = 8
GROUP = 16
#: Like patches are looked for this many pixels away in either direction.
REACH = 9
#: Distance between reference patches.
STEP = 4
#: Parts of the image that are filtered at the same time; always as many, so that results do not depend on the machine.
PARTS = 2
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
#: Pixels of a patch.
AREA = SIDE * SIDE


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def _times(out: Array, a: Array, b: Array) -> None:
    """``out = a @ b`` of square matrices in rows of `SIDE`.

    Eight sums by name: so the compiler keeps a row of the product in one register.
    """
    for i in range(SIDE):
        s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = np.float32(0.0)
        for k in range(SIDE):
            w = a[i * SIDE + k]
            s0 += w * b[k * SIDE]
            s1 += w * b[k * SIDE + 1]
            s2 += w * b[k * SIDE + 2]
            s3 += w * b[k * SIDE + 3]
            s4 += w * b[k * SIDE + 4]
            s5 += w * b[k * SIDE + 5]
            s6 += w * b[k * SIDE + 6]
            s7 += w * b[k * SIDE + 7]
        j = i * SIDE
        out[j], out[j + 1], out[j + 2], out[j + 3] = s0, s1, s2, s3
        out[j + 4], out[j + 5], out[j + 6], out[j + 7] = s4, s5, s6, s7


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def _along(group: Array, n: int, work: Array, inverse: bool) -> None:
    """Orthonormal Haar transform in place along the first axis of ``group`` (n, 64); n is a power of two."""
    root = np.float32(np.sqrt(0.5))
    size = 2 if inverse else n
    while 2 <= size <= n:
        half = size // 2
        for k in range(half):
            into = (2 * k, 2 * k + 1) if inverse else (k, half + k)
            first, second = work[into[0]], work[into[1]]
            a, b = (group[k], group[half + k]) if inverse else (group[2 * k], group[2 * k + 1])
            for p in range(AREA):
                first[p] = root * (a[p] + b[p])
                second[p] = root * (a[p] - b[p])
        for k in range(size):
            here, there = group[k], work[k]
            for p in range(AREA):
                here[p] = there[p]
        size = size * 2 if inverse else half


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def _apart(line: Array, pilot: Array, r: int, i: int, shift: int, first: int, last: int) -> None:
    """Squared distances, for the columns first … last - 1, of the patches at row ``r`` from those at ``i``, shifted.

    Patches begin at the column; the result is the second row of ``line``.
    """
    out = line[0]
    for half in range(0, SIDE, 4):
        a0, a1, a2, a3 = pilot[r + half], pilot[r + half + 1], pilot[r + half + 2], pilot[r + half + 3]
        b0, b1, b2, b3 = pilot[i + half], pilot[i + half + 1], pilot[i + half + 2], pilot[i + half + 3]
        begin, end = first + shift, last + shift
        _squares(out[first:last], a0[first:last], a1[first:last], b0[begin:end], b1[begin:end], half == 0)
        _squares(out[first:last], a2[first:last], a3[first:last], b2[begin:end], b3[begin:end], False)
    # Sums of two, four and eight places, from one line to the other and back.
    _pairs(line[1], line[0], first, last - 1, 1)
    _pairs(line[0], line[1], first, last - 3, 2)
    _pairs(line[1], line[0], first, last - 7, 4)


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def _pairs(out: Array, a: Array, first: int, last: int, step: int) -> None:
    target, here, ahead = out[first:last], a[first:last], a[first + step : last + step]
    for c in range(len(target)):
        target[c] = here[c] + ahead[c]


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def _squares(out: Array, a0: Array, a1: Array, b0: Array, b1: Array, fresh: bool) -> None:
    kept = np.float32(0.0) if fresh else np.float32(1.0)
    for c in range(len(out)):
        x, y = a0[c] - b0[c], a1[c] - b1[c]
        out[c] = kept * out[c] + (x * x + y * y)


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def _nearest(pilot: Array, r: int, columns: Array, places: Array, far: Array, found: Array, line: Array) -> None:
    """For each patch of row ``r``: the places of the ``GROUP`` patches of the pilot most like it, the nearest first."""
    rows, cols = pilot.shape
    found[:] = 0
    for i in range(max(0, r - REACH), min(rows - SIDE, r + REACH) + 1):
        for shift in range(-REACH, REACH + 1):
            first, last = max(0, -shift), min(cols, cols - shift)
            if last - first < SIDE:
                continue
            _apart(line, pilot, r, i, shift, first, last)
            for m in range(len(columns)):
                c = columns[m]
                if c < first or c + SIDE > last:
                    continue
                n = found[m]
                distance = line[1, c] if i != r or shift != 0 else np.float32(-1.0)
                if distance > MATCH * AREA or (n == GROUP and distance >= far[m, GROUP - 1]):
                    continue
                k = min(n, GROUP - 1)
                while k > 0 and far[m, k - 1] > distance:
                    far[m, k] = far[m, k - 1]
                    places[m, k, 0], places[m, k, 1] = places[m, k - 1, 0], places[m, k - 1, 1]
                    k -= 1
                far[m, k] = distance
                places[m, k, 0], places[m, k, 1] = i, c + shift
                found[m] = min(n + 1, GROUP)


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def _spectra(
    image: Array, places: Array, n: int, basis: Array, back: Array, out: Array, block: Array, work: Array
) -> None:
    """Cosine transform of the ``n`` patches, then Haar across them, into ``out``."""
    half = work[0]
    for k in range(n):
        i, j = places[k, 0], places[k, 1]
        for a in range(SIDE):
            for b in range(SIDE):
                block[a * SIDE + b] = image[i + a, j + b]
        _times(half, block, back)
        _times(out[k], basis, half)
    _along(out, n, work, False)


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def _weakened(data: Array, guess: Array) -> Any:
    """Wiener filter of one spectrum, in place; returns the noise that it lets through."""
    power = np.float32(0.0)
    for p in range(AREA):
        gain = guess[p] * guess[p]
        gain /= gain + np.float32(1.0)
        power += gain * gain
        data[p] *= gain
    return power


@njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def _filtered(z: Array, pilot: Array, window: Array, basis: Array, step: int, begin: int, end: int) -> Array:
    """White data ``z`` filtered group by group; ``pilot`` in the same units.

    Returns two planes: the weighted sum of all filtered patches of the reference rows ``begin`` … ``end`` - 1, and of
    their weights.
    """
    rows, cols = z.shape
    sums = np.zeros((2, rows, cols), np.float32)
    total, weight = sums
    columns = np.minimum(np.arange(-(-(cols - SIDE) // step) + 1) * step, cols - SIDE)
    places = np.zeros((len(columns), GROUP, 2), np.int64)
    far = np.zeros((len(columns), GROUP), np.float32)
    found = np.zeros(len(columns), np.int64)
    line = np.zeros((2, cols), np.float32)
    data = np.empty((GROUP, AREA), np.float32)
    guess = np.empty((GROUP, AREA), np.float32)
    work = np.empty((GROUP, AREA), np.float32)
    block, half = np.empty(AREA, np.float32), np.empty(AREA, np.float32)
    back = basis.reshape(SIDE, SIDE).T.copy().reshape(AREA)
    for ri in range(begin, end):
        _nearest(pilot, min(ri * step, rows - SIDE), columns, places, far, found, line)
        for m in range(len(columns)):
            n = 1
            while 2 * n <= found[m]:
                n *= 2
            _spectra(z, places[m], n, basis, back, data, block, work)
            _spectra(pilot, places[m], n, basis, back, guess, block, work)
            power = np.float32(1e-3)
            for k in range(n):
                power += _weakened(data[k], guess[k])
            _along(data, n, work, True)
            # The noise that a group lets through is its weight's inverse.
            share = np.float32(1.0) / power
            for k in range(n):
                i, j = places[m, k, 0], places[m, k, 1]
                _times(half, data[k], basis)
                _times(block, back, half)
                for a in range(SIDE):
                    for b in range(SIDE):
                        w = share * window[a, b]
                        total[i + a, j + b] += w * block[a * SIDE + b]
                        weight[i + a, j + b] += w
    return sums


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
    references = -(-(data.shape[0] - SIDE) // step) + 1

    def rows(part: int) -> Array:
        begin, end = part * references // PARTS, (part + 1) * references // PARTS
        return np.asarray(_filtered(white, known, WINDOW, COSINES.ravel(), step, begin, end))

    with ThreadPoolExecutor(PARTS) as pool:
        total, weight = np.sum(list(pool.map(rows, range(PARTS))), axis=0)
    return np.asarray(pilot + level * (total / weight - known))


def refined(data: Array, pilot: Array, noise: Noise) -> Array:
    """Mean of two rounds, the first's result being the second's pilot."""
    first = collaborate(data, pilot, noise)
    out: Array = np.float32(0.5) * (first + collaborate(data, first, noise))
    return out


def towards(data: Array, pilot: Array, noise: Noise, way: float) -> Array:
    """The pilot moved by the share ``way`` to `refined`, with the pilot's mean."""
    return moved(pilot, refined(data, pilot, noise) - pilot, way)


def moved(pilot: Array, change: Array, way: float) -> Array:
    """The pilot and the share ``way`` of a change, with the pilot's mean."""
    level = change.mean(dtype=np.float64)
    return np.asarray(pilot + np.float32(way) * (change - level), np.float32)


def big_enough(shape: tuple[int, ...]) -> bool:
    """Whether patches fit a plane."""
    return min(shape) >= 2 * SIDE


def judge(data: Array, noise: Noise, first_pass: Callable[[Array], Array]) -> tuple[float, float, Array]:
    """How far to go from the pilot, made by ``first_pass``, to `refined`: from 0 to 1; what that adds to the risk.

    Also returns the whole way, `refined` less the pilot.

    To first order E[x F(y)] = E[y F(y) - (alpha y + variance) F'(y)]; one disturbed run of both passes measures the
    sum of the derivatives. With alpha y itself the sum scatters, and is too low where there is hardly a count per
    pixel; with the pilot in its place it is steady and too high there: the mean of both is taken. The risk of a way
    on the data that chose it is too low: each quarter of the image is judged with the way that the others choose.
    """
    # Other signs for other data: the chance in them must not be the same for all.
    rng = np.random.default_rng(crc32(np.ascontiguousarray(data).tobytes()))
    signs = rng.choice(np.array([-1.0, 1.0], np.float32), data.shape)
    shift = np.float32(PROBE * np.sqrt(max(float(np.mean(noise.alpha * data + noise.variance)), 1e-30)))

    def change(y: Array, pilot: Array) -> Array:
        return np.asarray(refined(y, pilot, noise) - pilot, np.float64)

    pilot = first_pass(data)
    disturbed = data + shift * signs
    here = change(data, pilot)
    slope = (change(disturbed, first_pass(disturbed)) - here) * signs / float(shift)
    level = noise.alpha * 0.5 * (np.maximum(pilot, np.float32(0.0)) + data) + noise.variance
    gain = _quarters((data - pilot) * here - level * slope)
    size = _quarters(here * here)

    def best(gains: float, sizes: float) -> float:
        return min(max(gains / max(sizes, 1e-30), 0.0), 1.0)

    added = 0.0
    for g, n in zip(gain, size, strict=True):
        way = best(float(gain.sum() - g), float(size.sum() - n))
        added += way * (way * n - 2.0 * g)
    return best(float(gain.sum()), float(size.sum())), added / data.size, here


def _quarters(a: Array) -> NDArray[np.float64]:
    """Sums over the four quarters of an image."""
    rows, cols = a.shape[0] // 2, a.shape[1] // 2
    return np.add.reduceat(np.add.reduceat(a, [0, rows], axis=0), [0, cols], axis=1).ravel().astype(np.float64)
