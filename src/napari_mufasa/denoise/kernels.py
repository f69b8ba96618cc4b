"""The loops of PURE-LET over one level's blocks: thresholds, their risk terms, and their weighted sum.

Details come as (3, rows, cols): horizontal, vertical, diagonal; a transform of rows only leaves the last two zero.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from napari_mufasa.compiled import inlined, vectorised

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
#: A further one of the last guide: what it shows beyond its own noise, of which so many variances are taken for noise.
BEYOND = 8.0
ZERO, ONE, EIGHTH = np.float32(0.0), np.float32(1.0), np.float32(0.125)
NARROW, WIDE = np.float32(1.0 / CLASS_NARROW), np.float32(1.0 / CLASS_WIDE)


def per_level(guides: int) -> int:
    """Candidates of one level with so many guides: the spatial ones, those of each guide, and one more of the last."""
    return SPATIAL + PER_GUIDE * guides + (1 if guides else 0)


@inlined
def _class_weight(energy: Any) -> Any:
    """Smoothly 1 where the neighbourhood is empty, 0 where it is full: a cheap stand-in for exp(-energy)."""
    rest = max(ZERO, ONE - EIGHTH * energy)
    rest *= rest
    rest *= rest
    return rest * rest


@vectorised
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


@vectorised
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


@vectorised
def linear_terms(d: Array, y: Array, v: Array, step_mean: float, bands: float) -> Array:
    """Risk terms of the details themselves, per block; ``y`` and ``v`` (child, rows, cols) as in `threshold_terms`.

    ``bands`` 0: details made of other pixels, which have no noise in common with the data.
    """
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


@inlined
def _threshold_term(
    out: Array, block: Array, s: Array, rest: Array, yk: Array, vk: Array, step: Any, share: Any, sign_a: Any,
    sign_b: Any, own: Any, scale: Any, bands: Any,
) -> None:  # fmt: skip
    """Add one child's term, with ``step`` more in it, to a row of blocks; ``block`` holds the three details."""
    sign_e = sign_a * sign_b
    n = len(out)
    first, second, third = block[0], block[1], block[2]
    four, two = np.float32(4.0), np.float32(2.0)
    # Rows only have one detail: the other two stay zero.
    other = step if bands > ONE else ZERO
    for c in range(n):
        p, q, t = first[c] + sign_a * step, second[c] + sign_b * other, third[c] + sign_e * other
        level = ONE / (rest[c] + own * max(s[c] + step, ZERO))
        signed = sign_a * p + sign_b * q + sign_e * t
        x = scale * (p * p + q * q + t * t) * level
        left = max(ZERO, ONE - x)
        cube = left * left * left
        slope = two * scale * signed * level - (x * own * level if s[c] + step > ZERO else ZERO)
        # Every detail changes by its sign; the signs' squares sum to the number of bands.
        change = cube * left * bands - four * cube * slope * signed
        out[c] += share * (yk[c] * (cube * left * signed) - vk[c] * change)


@vectorised
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
    out = np.zeros((rows, cols), d.dtype)
    own32, scale, bands32 = np.float32(own), np.float32(0.25 / width), np.float32(bands)
    block = np.empty((3, cols), d.dtype)
    children = 2 if bands == 1.0 else 4
    for r in range(rows):
        for o in range(3):
            detail, known, row = d[o, r], guide[o, r], block[o]
            for c in range(cols):
                row[c] = detail[c] - known[c]
        for k in range(children):
            sign_a, sign_b = np.float32(1.0 - 2.0 * (k & 1)), np.float32(1.0 - (k & 2))
            for side in range(3):
                share = np.float32(stencil[side + 1])
                if share != ZERO:
                    step = np.float32(stencil[0] * (side - 1))
                    _threshold_term(
                        out[r], block, s[r], rest[r], y[k, r], v[k, r], step, share, sign_a, sign_b, own32, scale,
                        bands32,
                    )  # fmt: skip
    return out


def predictions(d: Array, s: Array, length: int, flat: bool) -> Array:
    """Predictions of the details from the blocks one ``length`` away, (prediction, band, rows, cols).

    Across scales: the difference of the block sums on both sides, a detail of the next coarser kind. Within the band:
    the details along the edge that a detail means, and those across it. None contains a pixel of the block itself;
    where a side is missing it is 0.
    """
    rows, cols = s.shape
    out = np.zeros((PREDICTIONS, 3, rows, cols), d.dtype)
    across, along, beside = out
    left, inner, right = _sides(cols, length)
    across[0][:, inner] = s[:, left] - s[:, right]
    beside[0][:, inner] = d[0][:, left] + d[0][:, right]
    if flat:
        return out
    up, middle, down = _sides(rows, length)
    across[1][middle] = s[up] - s[down]
    across[2][middle, inner] = (s[up, left] - s[up, right]) - (s[down, left] - s[down, right])
    along[0][middle] = d[0][up] + d[0][down]
    along[1][:, inner] = d[1][:, left] + d[1][:, right]
    e = d[2]
    along[2][middle, inner] = (e[up, left] + e[up, right]) + (e[down, left] + e[down, right])
    beside[1][middle] = d[1][up] + d[1][down]
    beside[2][middle] = e[up] + e[down]
    beside[2][:, inner] += e[:, left] + e[:, right]
    return out


def _sides(n: int, length: int) -> tuple[slice, slice, slice]:
    """What lies before, at and behind the places that have a block one ``length`` away on both sides."""
    inner = max(n - 2 * length, 0)
    return slice(0, inner), slice(length, length + inner), slice(2 * length, 2 * length + inner)


#: Values of each row that are multiplied while they lie in the cache.
CHUNK = 512


@vectorised
def gram(rows: Array) -> Array:
    """Products of all rows with each other, float64.

    As fast as the usual library on one processor, and unlike it content with that one: windows are worked on side by
    side, and a library that starts threads of its own in each has them wait for each other.
    """
    n, size = rows.shape
    out, work = np.zeros((n, n), np.float64), np.zeros((n, n), np.float32)
    for start in range(0, size, CHUNK):
        stop = min(start + CHUNK, size)
        for i in range(0, n, 2):
            i1 = min(i + 1, n - 1)
            a, b = rows[i, start:stop], rows[i1, start:stop]
            for j in range(i, n, 4):
                j1, j2, j3 = min(j + 1, n - 1), min(j + 2, n - 1), min(j + 3, n - 1)
                p, q, r, s = rows[j, start:stop], rows[j1, start:stop], rows[j2, start:stop], rows[j3, start:stop]
                ap = aq = ar = at = bp = bq = br = bt = ZERO
                for c in range(len(a)):
                    x, y = a[c], b[c]
                    ap += x * p[c]
                    aq += x * q[c]
                    ar += x * r[c]
                    at += x * s[c]
                    bp += y * p[c]
                    bq += y * q[c]
                    br += y * r[c]
                    bt += y * s[c]
                # Where rows are missing the last one stood in for them, and the same value is written twice.
                work[i, j], work[i, j1], work[i, j2], work[i, j3] = ap, aq, ar, at
                work[i1, j], work[i1, j1], work[i1, j2], work[i1, j3] = bp, bq, br, bt
        for i in range(n):
            for k in range(i, n):
                out[i, k] += work[i, k]
    for i in range(n):
        for k in range(i):
            out[i, k] = out[k, i]
    return out
