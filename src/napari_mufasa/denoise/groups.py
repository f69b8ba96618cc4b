"""Groups of like patches: found, transformed, weakened, put back. The loops of `patches`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from napari_mufasa.compiled import inlined, vectorised

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

SIDE = 8
GROUP = 16
#: Like patches are looked for this many pixels away in either direction.
REACH = 9
#: Patches that differ by more than this many noise variances per pixel are not alike.
MATCH = 2.0


def _cosines() -> NDArray[np.float32]:
    k, n = np.mgrid[:SIDE, :SIDE]
    basis = np.sqrt(2.0 / SIDE) * np.cos(np.pi * (n + 0.5) * k / SIDE)
    basis[0] /= np.sqrt(2.0)
    return np.asarray(basis, np.float32)


COSINES = _cosines()
#: Pixels of a patch.
AREA = SIDE * SIDE


@inlined
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


@inlined
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


@inlined
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


@inlined
def _pairs(out: Array, a: Array, first: int, last: int, step: int) -> None:
    target, here, ahead = out[first:last], a[first:last], a[first + step : last + step]
    for c in range(len(target)):
        target[c] = here[c] + ahead[c]


@inlined
def _squares(out: Array, a0: Array, a1: Array, b0: Array, b1: Array, fresh: bool) -> None:
    kept = np.float32(0.0) if fresh else np.float32(1.0)
    for c in range(len(out)):
        x, y = a0[c] - b0[c], a1[c] - b1[c]
        out[c] = kept * out[c] + (x * x + y * y)


@inlined
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


@inlined
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


@inlined
def _weakened(data: Array, guess: Array) -> Any:
    """Wiener filter of one spectrum, in place; returns the noise that it lets through."""
    power = np.float32(0.0)
    for p in range(AREA):
        gain = guess[p] * guess[p]
        gain /= gain + np.float32(1.0)
        power += gain * gain
        data[p] *= gain
    return power


@vectorised
def filtered(z: Array, pilot: Array, window: Array, basis: Array, step: int, begin: int, end: int) -> Array:
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
