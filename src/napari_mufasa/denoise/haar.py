"""Undecimated, unnormalised Haar transform that never looks past the border.

A coefficient of level j is a signed sum over a block of 2^j pixels along each transformed axis, so sums of Poisson
counts stay Poisson counts. Only blocks that lie wholly inside the image are used, and the synthesis averages over the
blocks that exist: reconstruction is exact for every shape, and no pixel is ever invented outside the image.

Level arrays shrink: along an axis of length n, level j has n - 2^j + 1 blocks, one for each start pixel.
``flat=True`` transforms rows only (axis 1): every row is then a trace of its own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from napari_mufasa.compiled import inlined, vectorised

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

#: Signs of the children (top left, top right, bottom left, bottom right) in each detail band.
SIGNS_2D = np.array([[1, -1, 1, -1], [1, 1, -1, -1], [1, -1, -1, 1]], dtype=np.float32)
#: The same for rows only; the two lower children do not exist.
SIGNS_1D = np.array([[1, -1, 0, 0]], dtype=np.float32)
LOW_2D = np.ones(4, dtype=np.float32)
LOW_1D = np.array([1, 1, 0, 0], dtype=np.float32)


def levels_for(shape: tuple[int, ...], wanted: int) -> int:
    """Deepest level, at most ``wanted``, at which every block of ``shape`` has a neighbour it shares no pixel with."""
    level = 0
    while level < wanted and min(shape) >= 6 * 2**level - 1:
        level += 1
    return level


@vectorised
def analyse(a: Array, h: int, flat: bool) -> tuple[Array, Array]:
    """One level (half block ``h``): scaling coefficients (rows, cols) and detail bands (1 or 3, rows, cols)."""
    cols = a.shape[1] - h
    rows = a.shape[0] if flat else a.shape[0] - h
    s = np.empty((rows, cols), a.dtype)
    d = np.empty((1 if flat else 3, rows, cols), a.dtype)
    if flat:
        for r in range(rows):
            for c in range(cols):
                s[r, c] = a[r, c] + a[r, c + h]
                d[0, r, c] = a[r, c] - a[r, c + h]
        return s, d
    for r in range(rows):
        for c in range(cols):
            top_left, top_right = a[r, c], a[r, c + h]
            low_left, low_right = a[r + h, c], a[r + h, c + h]
            left, right = top_left + low_left, top_right + low_right
            s[r, c] = left + right
            d[0, r, c] = left - right
            d[1, r, c] = (top_left + top_right) - (low_left + low_right)
            d[2, r, c] = (top_left - top_right) - (low_left - low_right)
    return s, d


@vectorised
def children_sum(a: Array, h: int, flat: bool) -> Array:
    """Sum over the children of every block."""
    cols = a.shape[1] - h
    rows = a.shape[0] if flat else a.shape[0] - h
    out = np.zeros((rows, cols), a.dtype)
    for r in range(rows):
        for c in range(cols):
            out[r, c] += a[r, c]
        for c in range(cols):
            out[r, c] += a[r, c + h]
        if not flat:
            for c in range(cols):
                out[r, c] += a[r + h, c]
            for c in range(cols):
                out[r, c] += a[r + h, c + h]
    return out


@vectorised
def covered(b: Array, h: int, flat: bool) -> Array:
    """``b`` over the number of children per block and of blocks that cover each place: the synthesis's weights."""
    rows, cols = b.shape
    out = np.empty_like(b)
    for r in range(rows):
        row_count = 1.0 if flat else 2.0 * ((1.0 if r < rows - h else 0.0) + (1.0 if r >= h else 0.0))
        single = 0.5 / row_count
        double = 0.25 / row_count
        for c in range(cols):
            out[r, c] = b[r, c] * (double if h <= c < cols - h else single)
    return out


@vectorised
def spread(band: Array, h: int, signs: Array, out: Array) -> None:
    """Add a band of rows with its children's signs to ``out`` (the level below), not yet divided by the coverage."""
    rows, cols = band.shape
    for r in range(rows):
        for c in range(cols):
            out[r, c] += signs[0] * band[r, c]
        for c in range(cols):
            out[r, c + h] += signs[1] * band[r, c]


@inlined
def _shared(out: Array, h: int) -> None:
    """Divide each place by the number of children per block and of blocks that cover it."""
    rows, cols = out.shape
    for r in range(rows):
        shares = 2.0 * ((1.0 if r < rows - h else 0.0) + (1.0 if r >= h else 0.0))
        single, double = np.float32(0.5 / shares), np.float32(0.25 / shares)
        for c in range(min(h, cols)):
            out[r, c] *= single
        for c in range(h, max(cols - h, h)):
            out[r, c] *= double
        for c in range(max(cols - h, h), cols):
            out[r, c] *= single


@vectorised
def _gathered(s: Array, a: Array, b: Array, e: Array, h: int, rows: int, cols: int) -> Array:
    """`synthesise` of all bands at once: each row of blocks is spread over its two rows of children.

    One row of ``s`` stands for all.
    """
    out = np.zeros((rows, cols), s.dtype)
    n = s.shape[1]
    for r in range(a.shape[0]):
        top_left, top_right = out[r, :n], out[r, h : h + n]
        low_left, low_right = out[r + h, :n], out[r + h, h : h + n]
        row_s, row_a, row_b, row_e = s[min(r, s.shape[0] - 1)], a[r], b[r], e[r]
        for c in range(n):
            top_left[c] += (row_s[c] + row_b[c]) + (row_a[c] + row_e[c])
        for c in range(n):
            top_right[c] += (row_s[c] + row_b[c]) - (row_a[c] + row_e[c])
        for c in range(n):
            low_left[c] += (row_s[c] - row_b[c]) + (row_a[c] - row_e[c])
        for c in range(n):
            low_right[c] += (row_s[c] - row_b[c]) - (row_a[c] - row_e[c])
    _shared(out, h)
    return out


@vectorised
def _lifted(s: Array, h: int, rows: int, cols: int) -> Array:
    """`synthesise` of scaling coefficients alone."""
    out = np.empty((rows, cols), s.dtype)
    n_rows, n = s.shape
    both = np.empty(n, s.dtype)
    edge = min(h, n)
    for r in range(rows):
        inside = h <= r < n_rows
        line, other = s[min(r, n_rows - 1) if inside or r < h else r - h], s[max(r - h, 0)]
        if inside:
            for c in range(n):
                both[c] = line[c] + other[c]
        else:
            for c in range(n):
                both[c] = line[c]
        # Divided by the number of children per block and of blocks that cover each place.
        single, double = np.float32(0.125 if inside else 0.25), np.float32(0.0625 if inside else 0.125)
        left, middle, right = out[r, :edge], out[r, h:n], out[r, max(n, h) :]
        for c in range(edge):
            left[c] = single * both[c]
        ahead = both[h:]
        for c in range(len(middle)):
            middle[c] = double * (ahead[c] + both[c])
        end = both[n - len(right) :]
        for c in range(len(right)):
            right[c] = single * end[c]
    return out


def synthesise(low: Array | None, bands: Array | None, h: int, flat: bool) -> Array:
    """The level below from scaling coefficients and detail bands; ``None`` stands for zeros."""
    like = low if low is not None else bands
    assert like is not None
    rows, cols = like.shape[-2] + (0 if flat else h), like.shape[-1] + h
    if not flat:
        if bands is None:
            return np.asarray(_lifted(like, h, rows, cols))
        sums = np.zeros((1, bands.shape[2]), bands.dtype) if low is None else low
        return np.asarray(_gathered(sums, bands[0], bands[1], bands[2], h, rows, cols))
    out = np.zeros((rows, cols), like.dtype)
    if low is not None:
        spread(low, h, LOW_1D, out)
    if bands is not None:
        for band, signs in zip(bands, SIGNS_1D, strict=True):
            spread(band, h, signs, out)
    level_below: Array = covered(out, h, True)
    return level_below


@inlined
def _add_shifted(total: Array, a: Array, dr: int, dc: int) -> None:
    rows, cols = a.shape
    first, last = max(0, -dc), min(cols, cols - dc)
    for r in range(max(0, -dr), min(rows, rows - dr)):
        here, there = total[r, first:last], a[r + dr, first + dc : last + dc]
        for c in range(last - first):
            here[c] += there[c]


@vectorised
def mean_beside(a: Array, distance: int, flat: bool) -> Array:
    """Mean over the (two or eight) blocks ``distance`` away; 0 where there are none.

    With ``distance`` = the block length these neighbours share no pixel with the block itself, which is what lets
    functions of them enter the risk estimate as constants.
    """
    rows, cols = a.shape
    # The 3 x 3 sum is separable: along the row, then across rows; the block itself is taken off at the end.
    along = a.copy()
    _add_shifted(along, a, 0, distance)
    _add_shifted(along, a, 0, -distance)
    total = along
    if not flat:
        total = along.copy()
        _add_shifted(total, along, distance, 0)
        _add_shifted(total, along, -distance, 0)
    for r in range(rows):
        n_r = 1
        if not flat:
            n_r += (1 if r >= distance else 0) + (1 if r < rows - distance else 0)
        edge = min(distance, cols)
        inner = max(cols - distance, edge)
        for part in range(3):
            first = (0, edge, inner)[part]
            last = (edge, inner, cols)[part]
            n_c = 1 + (1 if first >= distance else 0) + (1 if first < cols - distance else 0)
            share = np.float32(1.0 / max(n_r * n_c - 1, 1))
            run, own = total[r, first:last], a[r, first:last]
            for c in range(last - first):
                run[c] = share * (run[c] - own[c])
    return total


@vectorised
def _squares(d: Array, scale: float) -> Array:
    bands, rows, cols = d.shape
    out = np.zeros((rows, cols), d.dtype)
    factor = np.float32(scale)
    for o in range(bands):
        for r in range(rows):
            for c in range(cols):
                out[r, c] += factor * d[o, r, c] * d[o, r, c]
    return out


def energy_beside(d: Array, distance: int, flat: bool) -> Array:
    """Mean square of the details (bands, rows, cols) of the blocks beside each block."""
    energy: Array = np.maximum(mean_beside(_squares(d, 1.0 / d.shape[0]), distance, flat), np.float32(0.0))
    return energy


def add_energy(energy: Array, d: Array, scale: float) -> None:
    """Add ``scale`` times the sum of squares of the details at the block itself."""
    energy += _squares(d, scale)
