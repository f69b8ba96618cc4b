"""One level of the estimator with known weights in a single pass: what a movie spends its time on.

The image is worked on in strips of `WIDTH` blocks, row by row from the top, and all that a row of blocks needs of the
rows above and below stays in the processor's cache, in a ring of rows. Rows of one buffer lie a fixed distance apart:
the compiler sees that they never overlap and works on eight columns at once in loops that do much. The arithmetic is
that of `kernels`, which keeps every candidate for itself, as the risk needs it; a test holds the two together. A sum
made of those candidates takes 5 to 19 times as long: ``python -m benchmarks.denoise --only "single pass"``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from napari_mufasa.compiled import inlined, vectorised

from .kernels import BEYOND, EIGHTH, NARROW, ONE, OWN, PER_GUIDE, SPATIAL, WIDE, ZERO

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

#: Blocks side by side in one strip.
WIDTH = 256
#: Deepest level whose blocks' neighbours fit the buffers; no window of `purelet.windows` holds deeper ones.
DEEPEST = 5
#: Rows of a buffer lie this far apart: a cache line more than a power of two, which would put all of them into the same
#: few places of the cache.
SPAN = WIDTH + 2**DEEPEST * 2 + 16
PITCH = WIDTH + 16
#: A buffer of block sums and details, wider than the strip by the neighbours on both sides.
B_S, B_D0, B_D1, B_D2 = 0, SPAN, 2 * SPAN, 3 * SPAN
#: A row of the ring: block sums, details, sums and squares over three blocks side by side, and what the blocks on both
#: sides make.
S, D0, D1, D2, SUM, SQUARE = 0, PITCH, 2 * PITCH, 3 * PITCH, 4 * PITCH, 5 * PITCH
ACROSS, SIDE0, SIDE1, SIDE2 = 6 * PITCH, 7 * PITCH, 8 * PITCH, 9 * PITCH
RING_ROW = 10 * PITCH
#: The sheet of the row in work: Gaussian variance, blocks side by side, energy of the guides, inverse noise level,
#: classes, the three details of the result, and the inverse noise level without the block's own share.
VARIANCE, COUNT, ENERGY, LEVEL, EMPTY, NEARLY = 0, PITCH, 2 * PITCH, 3 * PITCH, 4 * PITCH, 5 * PITCH
OUT0, OUT1, OUT2, BESIDE = 6 * PITCH, 7 * PITCH, 8 * PITCH, 9 * PITCH
SHEET = 10 * PITCH


@inlined
def _blocks(out: Array, top_left: Array, top_right: Array, low_left: Array, low_right: Array) -> None:
    """Block sums and details from two rows of children."""
    for c in range(len(top_left)):
        left, right = top_left[c] + low_left[c], top_right[c] + low_right[c]
        out[B_S + c] = left + right
        out[B_D0 + c] = left - right
        left, right = top_left[c] - low_left[c], top_right[c] - low_right[c]
        out[B_D1 + c] = left + right
        out[B_D2 + c] = left - right


@inlined
def _copy(out: Array, a: Array) -> None:
    for c in range(len(out)):
        out[c] = a[c]


@inlined
def _beside(out: Array, b: Array, both: Array, far: int) -> None:
    """A row of the ring from a buffer that begins ``far`` blocks before the strip."""
    left, here, right = b, b[far:], b[2 * far :]
    for c in range(WIDTH):
        s_l, s_c, s_r = left[B_S + c], here[B_S + c], right[B_S + c]
        x_l, x_c, x_r = left[B_D0 + c], here[B_D0 + c], right[B_D0 + c]
        y_l, y_c, y_r = left[B_D1 + c], here[B_D1 + c], right[B_D1 + c]
        z_l, z_c, z_r = left[B_D2 + c], here[B_D2 + c], right[B_D2 + c]
        out[S + c] = s_c
        out[D0 + c] = x_c
        out[D1 + c] = y_c
        out[D2 + c] = z_c
        out[SUM + c] = s_l + s_c + s_r
        squares = (x_l * x_l + y_l * y_l + z_l * z_l) + (x_r * x_r + y_r * y_r + z_r * z_r)
        out[SQUARE + c] = squares + (x_c * x_c + y_c * y_c + z_c * z_c)
        out[ACROSS + c] = both[c] * (s_l - s_r)
        out[SIDE0 + c] = both[c] * (x_l + x_r)
        out[SIDE1 + c] = both[c] * (y_l + y_r)
        out[SIDE2 + c] = both[c] * (z_l + z_r)


@inlined
def _enter(slot: Array, wide: Array, both: Array, a: Array, s_out: Array, r: int, first: int, n: int, h: int) -> None:
    """Row ``r`` of the blocks first … first + n - 1 into its place in the ring, and its block sums into ``s_out``."""
    far = 2 * h
    begin, end = max(first - far, 0), min(first + n + far, s_out.shape[1])
    lead, m = far - (first - begin), end - begin
    # What lies outside the image is zero.
    for k in range(4):
        if lead > 0:
            wide[k * SPAN : k * SPAN + lead] = ZERO
        if lead + m < WIDTH + 2 * far:
            wide[k * SPAN + lead + m : k * SPAN + WIDTH + 2 * far] = ZERO
    top, low = a[r], a[r + h]
    _blocks(wide[lead:], top[begin:end], top[begin + h : end + h], low[begin:end], low[begin + h : end + h])
    _copy(s_out[r, first : first + n], wide[far : far + n])
    _beside(slot, wide, both, far)


@inlined
def _energy(t: Array, g: Array, share: Any) -> None:
    """Add a guide's squares to the energy at each block."""
    for c in range(WIDTH):
        x, y, z = g[B_D0 + c], g[B_D1 + c], g[B_D2 + c]
        t[ENERGY + c] += share * (x * x + y * y + z * z)


@inlined
def _classed(t: Array, up: Array, here: Array, down: Array, alpha: float, n_rows: int, share_beside: Any) -> None:
    """Inverse noise level of each block, and how empty its surroundings are."""
    own, other = np.float32(OWN * alpha), np.float32((1.0 - OWN) * alpha)
    floor, height = np.float32(0.25 * alpha * alpha + 1e-9), np.float32(n_rows)
    for c in range(WIDTH):
        x, y, z = here[D0 + c], here[D1 + c], here[D2 + c]
        share = ONE / max(height * t[COUNT + c] - ONE, ONE)
        beside = max(share * (up[SUM + c] + here[SUM + c] + down[SUM + c] - here[S + c]), ZERO)
        squares = up[SQUARE + c] + here[SQUARE + c] + down[SQUARE + c] - (x * x + y * y + z * z)
        energy = share_beside * max(share * squares, ZERO) + t[ENERGY + c]
        rest = t[VARIANCE + c] + other * beside + floor
        t[BESIDE + c] = ONE / (rest + own * beside)
        ratio = EIGHTH * energy * t[BESIDE + c]
        t[LEVEL + c] = ONE / (rest + own * max(here[S + c], ZERO))
        left = max(ZERO, ONE - NARROW * ratio)
        left *= left
        left *= left
        t[EMPTY + c] = left * left
        left = max(ZERO, ONE - WIDE * ratio)
        left *= left
        left *= left
        t[NEARLY + c] = left * left


@inlined
def _spatial(t: Array, up: Array, here: Array, down: Array, w: Array, scale: Any, inside: Any) -> None:
    """The weighted sum of the candidates made of the frame alone; ``inside`` is 0 without a row above or below."""
    w0, w1, w2, w3, w4, w5 = w[0], w[1], w[2], w[3], w[4], w[5]
    a0, a1, b0, b1, c0, c1 = w[6], w[7], w[8], w[9], w[10], w[11]
    for c in range(WIDTH):
        x, y, z = here[D0 + c], here[D1 + c], here[D2 + c]
        empty, nearly = t[EMPTY + c], t[NEARLY + c]
        kept = max(ZERO, ONE - scale * (x * x + y * y + z * z) * t[LEVEL + c])
        kept *= kept
        kept *= kept
        factor = (w0 + w1 * empty + w2 * nearly) + kept * (w3 + w4 * empty + w5 * nearly)
        across, along, beside = a0 + a1 * empty, b0 + b1 * empty, c0 + c1 * empty
        p = across * here[ACROSS + c] + beside * here[SIDE0 + c] + inside * along * (up[D0 + c] + down[D0 + c])
        q = inside * (across * (up[S + c] - down[S + c]) + beside * (up[D1 + c] + down[D1 + c]))
        e = across * (up[ACROSS + c] - down[ACROSS + c]) + along * (up[SIDE2 + c] + down[SIDE2 + c])
        t[OUT0 + c] = factor * x + p
        t[OUT1 + c] = factor * y + along * here[SIDE1 + c] + q
        t[OUT2 + c] = factor * z + beside * here[SIDE2 + c] + inside * (e + beside * (up[D2 + c] + down[D2 + c]))


@inlined
def _guided(t: Array, here: Array, g: Array, w: Array, scale: Any) -> None:
    """Add the weighted candidates of one guide."""
    w0, w1, w2, w3, w4 = w[0], w[1], w[2], w[3], w[4]
    for c in range(WIDTH):
        x, y, z = g[B_D0 + c], g[B_D1 + c], g[B_D2 + c]
        p, q, e = here[D0 + c] - x, here[D1 + c] - y, here[D2 + c] - z
        kept = max(ZERO, ONE - scale * (p * p + q * q + e * e) * t[LEVEL + c])
        kept *= kept
        kept *= kept
        kept *= w3 + w4 * t[EMPTY + c]
        direct = w0 + w1 * t[EMPTY + c] + w2 * t[NEARLY + c]
        t[OUT0 + c] += direct * x + kept * p
        t[OUT1 + c] += direct * y + kept * q
        t[OUT2 + c] += direct * z + kept * e


@inlined
def _beyond(t: Array, g: Array, weight: Any, scale: Any) -> None:
    """Add what a guide shows beyond its own noise."""
    for c in range(WIDTH):
        x, y, z = g[B_D0 + c], g[B_D1 + c], g[B_D2 + c]
        noise_like = max(ZERO, ONE - scale * (x * x + y * y + z * z) * t[BESIDE + c])
        noise_like *= noise_like
        noise_like *= noise_like
        share = weight * (ONE - noise_like)
        t[OUT0 + c] += share * x
        t[OUT1 + c] += share * y
        t[OUT2 + c] += share * z


@inlined
def _gather(t: Array, top_left: Array, top_right: Array, low_left: Array, low_right: Array) -> None:
    """Add a row of details to its blocks' four children."""
    for c in range(len(top_left)):
        top_left[c] += t[OUT1 + c] + (t[OUT0 + c] + t[OUT2 + c])
    for c in range(len(top_right)):
        top_right[c] += t[OUT1 + c] - (t[OUT0 + c] + t[OUT2 + c])
    for c in range(len(low_left)):
        low_left[c] += (t[OUT0 + c] - t[OUT2 + c]) - t[OUT1 + c]
    for c in range(len(low_right)):
        low_right[c] += (t[OUT2 + c] - t[OUT0 + c]) - t[OUT1 + c]


@vectorised
def level_pass(
    a: Array, guides: Array, variance: Array, alpha: float, width: float, guide_noise: Array, w: Array, h: int
) -> tuple[Array, Array, Array]:
    """Block sums of ``a`` and of the ``guides``, and the estimated details gathered into the level below.

    ``variance`` is that of the blocks, one row standing for all; ``w`` the level's weights. What is gathered is not
    yet divided by the number of blocks that cover a place: `settle` does so.
    """
    n_guides = guides.shape[0]
    rows, cols = a.shape[0] - h, a.shape[1] - h
    far = 2 * h
    s_out = np.empty((rows, cols), np.float32)
    g_out = np.empty((n_guides, rows, cols), np.float32)
    out = np.zeros(a.shape, np.float32)
    size = 2 * far + 1
    ring = np.zeros((size + 1, RING_ROW), np.float32)
    outside = ring[size]
    wide = np.zeros(4 * SPAN, np.float32)
    seen = np.zeros((n_guides, 4 * SPAN), np.float32)
    t = np.zeros(SHEET, np.float32)
    both = np.zeros(WIDTH, np.float32)
    scale = np.float32(0.25 / width)
    beyond = np.float32(0.25 / (3.0 * BEYOND * max(guide_noise[-1], 1e-6))) if n_guides else ZERO
    # A guide shows the coefficient itself: its square weighs as much as the whole neighbourhood.
    share_beside = np.float32((0.5 if n_guides else 1.0) / 3.0)
    for first in range(0, cols, WIDTH):
        n = min(WIDTH, cols - first)
        last = first + n
        for c in range(n):
            left, right = first + c >= far, first + c < cols - far
            both[c] = ONE if left and right else ZERO
            t[COUNT + c] = ONE + (ONE if left else ZERO) + (ONE if right else ZERO)
        for r in range(min(far, rows)):
            _enter(ring[r % size], wide, both, a, s_out, r, first, n, h)
        for r in range(rows):
            if r + far < rows:
                _enter(ring[(r + far) % size], wide, both, a, s_out, r + far, first, n, h)
            above, below = r >= far, r < rows - far
            here = ring[r % size]
            up = ring[(r - far) % size] if above else outside
            down = ring[(r + far) % size] if below else outside
            if r < variance.shape[0]:
                _copy(t[VARIANCE : VARIANCE + n], variance[r, first:last])
            t[ENERGY : ENERGY + WIDTH] = ZERO
            for k in range(n_guides):
                top, low, g = guides[k, r], guides[k, r + h], seen[k]
                _blocks(g, top[first:last], top[first + h : last + h], low[first:last], low[first + h : last + h])
                _copy(g_out[k, r, first:last], g[:n])
                _energy(t, g, np.float32(0.5 / n_guides / max(guide_noise[k], 0.05) / 3.0))
            _classed(t, up, here, down, alpha, 1 + above + below, share_beside)
            _spatial(t, up, here, down, w, scale, ONE if above and below else ZERO)
            for k in range(n_guides):
                start = SPATIAL + PER_GUIDE * k
                _guided(t, here, seen[k], w[start : start + PER_GUIDE], np.float32(scale / (1.0 + guide_noise[k])))
            if n_guides:
                _beyond(t, seen[n_guides - 1], w[SPATIAL + PER_GUIDE * n_guides], beyond)
            top, low = out[r], out[r + h]
            _gather(t, top[first:last], top[first + h : last + h], low[first:last], low[first + h : last + h])
    return s_out, g_out, out


@vectorised
def settle(s: Array, out: Array, h: int) -> None:
    """Add the scaling coefficients ``s`` to the gathered details and divide by what covers each place, in place."""
    rows, cols = out.shape
    n_rows, n = s.shape
    for r in range(rows):
        row = out[r]
        for k in range(2):
            if 0 <= r - k * h < n_rows:
                line, left, right = s[r - k * h], row[:n], row[h : h + n]
                for c in range(n):
                    left[c] += line[c]
                for c in range(n):
                    right[c] += line[c]
        shares = 2.0 * ((1.0 if r < rows - h else 0.0) + (1.0 if r >= h else 0.0))
        single, double = np.float32(0.5 / shares), np.float32(0.25 / shares)
        for c in range(min(h, cols)):
            row[c] *= single
        for c in range(h, max(cols - h, h)):
            row[c] *= double
        for c in range(max(cols - h, h), cols):
            row[c] *= single
