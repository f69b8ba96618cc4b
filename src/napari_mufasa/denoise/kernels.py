"""The loops of PURE-LET over one level's blocks: thresholds, their risk terms, and their weighted sum.

Details come as (3, rows, cols): horizontal, vertical, diagonal; a transform of rows only leaves the last two zero.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

#: Width of the threshold bump in noise variances, per orientation.
BUMP = 4.0
#: Widths of the neighbour classes: an empty surrounding, and one that is not quite empty.
CLASS_NARROW, CLASS_WIDE = 1.0, 4.0
#: Share of a coefficient's own block in its noise level; the rest comes from the blocks beside it.
OWN = 0.5
#: Candidates per level: {coefficient, thresholded} x {everywhere, empty surrounding, nearly empty surrounding}, and
#: {three predictions from the blocks beside} x {everywhere, empty surrounding}.
OWN_CANDIDATES = 6
PREDICTIONS = 3
SPATIAL = OWN_CANDIDATES + 2 * PREDICTIONS
#: Candidates per level and guide: {prediction} x {everywhere, empty surrounding, nearly empty surrounding} and
#: {thresholded difference from it} x {everywhere, empty surrounding}.
PER_GUIDE = 5
ZERO, ONE, EIGHTH = np.float32(0.0), np.float32(1.0), np.float32(0.125)
NARROW, WIDE = np.float32(1.0 / CLASS_NARROW), np.float32(1.0 / CLASS_WIDE)


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
        beside_row, energy_row, base_row, spread = s_beside[r], energy[r], rest[r], variance[r]
        narrow_row, wide_row = narrow[r], wide[r]
        for c in range(cols):
            base_row[c] = spread[c] + other * max(beside_row[c], ZERO) + floor
        for c in range(cols):
            narrow_row[c] = energy_row[c] / (base_row[c] + own * max(beside_row[c], ZERO))
        for c in range(cols):
            wide_row[c] = _class_weight(narrow_row[c] * WIDE)
        for c in range(cols):
            narrow_row[c] = _class_weight(narrow_row[c] * NARROW)
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
                    if bands == 1.0:
                        q = t = 0.0
                    signed = sign_a * p + sign_b * q + sign_e * t
                    x = 0.25 / width * (p * p + q * q + t * t) / level
                    left = max(0.0, 1.0 - x)
                    cube = left * left * left
                    slope = 0.5 / width * signed / level - (x * own / level if block > 0.0 else 0.0)
                    value = cube * left * signed
                    # Every detail changes by its sign; the signs' squares sum to the number of bands.
                    change = cube * left * bands - 4.0 * cube * slope * signed
                    total += share * (yk * value - vk * change)
            out[r, c] = total
    return out


@njit(cache=True, inline="always", fastmath=True)
def _predict(
    d: Array, s: Array, r: int, c: int, up: int, down: int, left: int, right: int, fv: Any, fh: Any, flat: bool
) -> tuple[Any, Any, Any, Any, Any, Any, Any, Any, Any]:
    """Three predictions of each of the three details at one block; ``fv``, ``fh`` are 0 where a side is missing."""
    across_a = fh * (s[r, left] - s[r, right])
    beside_a = fh * (d[0, r, left] + d[0, r, right])
    if flat:
        return across_a, ZERO, ZERO, ZERO, ZERO, ZERO, beside_a, ZERO, ZERO
    both = fv * fh
    across_b = fv * (s[up, c] - s[down, c])
    across_e = both * (s[up, left] + s[down, right] - s[up, right] - s[down, left])
    along_a = fv * (d[0, up, c] + d[0, down, c])
    along_b = fh * (d[1, r, left] + d[1, r, right])
    along_e = both * (d[2, up, left] + d[2, down, right] + d[2, up, right] + d[2, down, left])
    beside_b = fv * (d[1, up, c] + d[1, down, c])
    beside_e = fv * (d[2, up, c] + d[2, down, c]) + fh * (d[2, r, left] + d[2, r, right])
    return across_a, across_b, across_e, along_a, along_b, along_e, beside_a, beside_b, beside_e


@njit(cache=True, fastmath=True, nogil=True)
def predictions(d: Array, s: Array, length: int, flat: bool) -> Array:
    """Predictions of the details from the blocks one ``length`` away, (prediction, band, rows, cols).

    Across scales: the difference of the block sums on both sides, a detail of the next coarser kind. Within the band:
    the details along the edge that a detail means, and those across it. None contains a pixel of the block itself.
    """
    rows, cols = s.shape
    out = np.zeros((PREDICTIONS, 3, rows, cols), d.dtype)
    for r in range(rows):
        fv = ONE if length <= r < rows - length else ZERO
        up, down = max(r - length, 0), min(r + length, rows - 1)
        for c in range(cols):
            fh = ONE if length <= c < cols - length else ZERO
            left, right = max(c - length, 0), min(c + length, cols - 1)
            p = _predict(d, s, r, c, up, down, left, right, fv, fh, flat)
            for o in range(3):
                out[0, o, r, c], out[1, o, r, c], out[2, o, r, c] = p[o], p[3 + o], p[6 + o]
    return out


@njit(cache=True, fastmath=True, nogil=True)
def _kept(a: Array, b: Array, e: Array, sums: Array, base: Array, own: Any, scale: Any, out: Array) -> None:
    """Share of each block's details in one row that the threshold keeps."""
    for c in range(len(out)):
        energy = a[c] * a[c] + b[c] * b[c] + e[c] * e[c]
        left = max(ZERO, ONE - scale * energy / (base[c] + own * max(sums[c], ZERO)))
        left *= left
        out[c] = left * left


@njit(cache=True, fastmath=True, nogil=True)
def _added(out: Array, factor: Array, d: Array, empty: Array, p: Array, q: Array, w0: Any, w1: Any) -> None:
    for c in range(len(out)):
        out[c] = factor[c] * d[c] + (w0 + w1 * empty[c]) * (p[c] - q[c])


@njit(cache=True, fastmath=True, nogil=True)
def _more(out: Array, empty: Array, p: Array, q: Array, w0: Any, w1: Any, sign: Any = ONE) -> None:
    for c in range(len(out)):
        out[c] += (w0 + w1 * empty[c]) * (p[c] + sign * q[c])


@njit(cache=True, fastmath=True, nogil=True)
def _combine_run(
    out: Array, d: Array, s: Array, rest: Array, narrow: Array, wide: Array, own: Any, scale: Any, w: Array,
    rows3: Array, r: int, up: int, down: int, first: int, last: int, reach: int, fv: Any, fh: Any, flat: bool,
) -> None:  # fmt: skip
    """`combine` for the columns first … last - 1 of one row, all of which have the same neighbours."""
    w0, w1, w2, w3, w4, w5 = w[0], w[1], w[2], w[3], w[4], w[5]
    a0, a1, b0, b1, c0, c1 = w[6], w[7], w[8], w[9], w[10], w[11]
    n = last - first
    # Views that all start at 0, and loops that write one row from few others: only so does the compiler work on many
    # columns at once.
    d_a, d_b, d_e = d[0, r, first:last], d[1, r, first:last], d[2, r, first:last]
    sums, base, empty, nearly = s[r, first:last], rest[r, first:last], narrow[r, first:last], wide[r, first:last]
    factor, here = rows3[0, :n], rows3[1, :n]
    _kept(d_a, d_b, d_e, sums, base, own, scale, here)
    for c in range(n):
        factor[c] = (w0 + w1 * empty[c] + nearly[c] * w2) + here[c] * (w3 + w4 * empty[c] + nearly[c] * w5)
    to_left, to_right = first - reach, first + reach
    left, right, ahead = slice(to_left, to_left + n), slice(to_right, to_right + n), slice(first, last)
    # Across scales: a difference of block sums.
    _added(out[0, r, ahead], factor, d_a, empty, s[r, left], s[r, right], a0 * fh, a1 * fh)
    if flat:
        _more(out[0, r, ahead], empty, d[0, r, left], d[0, r, right], c0 * fh, c1 * fh)
        out[1, r, ahead] = ZERO
        out[2, r, ahead] = ZERO
        return
    _added(out[1, r, ahead], factor, d_b, empty, s[up, ahead], s[down, ahead], a0 * fv, a1 * fv)
    both = fv * fh
    _added(out[2, r, ahead], factor, d_e, empty, s[up, left], s[up, right], a0 * both, a1 * both)
    _more(out[2, r, ahead], empty, s[down, right], s[down, left], a0 * both, a1 * both, -ONE)
    # Within the band: along the edge that a detail means, and across it.
    _more(out[0, r, ahead], empty, d[0, up, ahead], d[0, down, ahead], b0 * fv, b1 * fv)
    _more(out[1, r, ahead], empty, d[1, r, left], d[1, r, right], b0 * fh, b1 * fh)
    _more(out[2, r, ahead], empty, d[2, up, left], d[2, down, right], b0 * both, b1 * both)
    _more(out[2, r, ahead], empty, d[2, up, right], d[2, down, left], b0 * both, b1 * both)
    _more(out[0, r, ahead], empty, d[0, r, left], d[0, r, right], c0 * fh, c1 * fh)
    _more(out[1, r, ahead], empty, d[1, up, ahead], d[1, down, ahead], c0 * fv, c1 * fv)
    _more(out[2, r, ahead], empty, d[2, up, ahead], d[2, down, ahead], c0 * fv, c1 * fv)
    _more(out[2, r, ahead], empty, d[2, r, left], d[2, r, right], c0 * fh, c1 * fh)


@njit(cache=True, fastmath=True, nogil=True)
def combine(
    d: Array, s: Array, rest: Array, narrow: Array, wide: Array, own: float, width: float, w: Array, length: int,
    flat: bool,
) -> Array:  # fmt: skip
    """The weighted sum of a level's spatial candidates, (3, rows, cols)."""
    rows, cols = s.shape
    out = np.empty((3, rows, cols), d.dtype)
    own32, scale = np.float32(own), np.float32(0.25 / width)
    start = min(length, cols)
    inner = min(max(cols - length, start), cols)
    rows3 = np.empty((3, cols), d.dtype)
    for r in range(rows):
        fv = ONE if length <= r < rows - length else ZERO
        up, down = max(r - length, 0), min(r + length, rows - 1)
        _combine_run(out, d, s, rest, narrow, wide, own32, scale, w, rows3, r, up, down, 0, start, 0, fv, ZERO, flat)
        _combine_run(
            out, d, s, rest, narrow, wide, own32, scale, w, rows3, r, up, down, start, inner, length, fv, ONE, flat
        )
        _combine_run(out, d, s, rest, narrow, wide, own32, scale, w, rows3, r, up, down, inner, cols, 0, fv, ZERO, flat)
    return out


@njit(cache=True, fastmath=True, nogil=True)
def combine_guide(
    out: Array, d: Array, s: Array, rest: Array, guide: Array, narrow: Array, wide: Array, own: float, width: float,
    w: Array,
) -> None:  # fmt: skip
    """Add the weighted candidates of one guide."""
    rows, cols = s.shape
    w0, w1, w2, w3, w4 = w[0], w[1], w[2], w[3], w[4]
    own32, scale = np.float32(own), np.float32(0.25 / width)
    apart = np.empty((3, cols), d.dtype)
    kept, direct = np.empty(cols, d.dtype), np.empty(cols, d.dtype)
    for r in range(rows):
        for o in range(3):
            row, detail, known = apart[o], d[o, r], guide[o, r]
            for c in range(cols):
                row[c] = detail[c] - known[c]
        _kept(apart[0], apart[1], apart[2], s[r], rest[r], own32, scale, kept)
        empty, nearly = narrow[r], wide[r]
        for c in range(cols):
            direct[c] = (w0 + w1 * empty[c]) + w2 * nearly[c]
        for c in range(cols):
            kept[c] *= w3 + w4 * empty[c]
        for o in range(3):
            row, target, known = apart[o], out[o, r], guide[o, r]
            for c in range(cols):
                target[c] += direct[c] * known[c] + kept[c] * row[c]
