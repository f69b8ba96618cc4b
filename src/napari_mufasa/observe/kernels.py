"""The loops over all pixels of a movie that observing takes.

Import this module only where a movie is observed: it needs numba. Functions of a module are compiled once for a
machine (see `camera_kernels`).
"""

from __future__ import annotations

import numpy as np

from napari_mufasa.compiled import inlined, vectorised
from napari_mufasa.observe.table import COMB
from napari_mufasa.spots.kernels import blurred

NONE_YET = -1e300
ROW = 1048  # numbers from one row of scratch to the next: known when compiled, so that compilers see the rows apart
BEFORE = 2  # frames before those at once, for lags
LINE_OUTLIER = 6.0  # standard deviations
AT_ONCE = 4  # frames: sums are then read and written a quarter as often


@vectorised
def in_time(movie, baseline):  # type: ignore[no-untyped-def]
    """Sums over frames of every pixel, row by row, so that they stay close to the processor.

    (sum, y, x) of v, v², v³, products of frames 1 and 2 apart, squared steps in each half of the movie, products with
    the next pixel along x and along y (none at the far edge); and (3, y, x) the largest value, its frame, and the next
    largest, neither next to the other in time. v is counts above the baseline.
    """
    n, height, width = movie.shape
    sums, ranks = np.zeros((9, height, width)), np.empty((3, height, width))
    v, under = np.zeros((BEFORE + AT_ONCE) * ROW), np.zeros(AT_ONCE * ROW)
    mine, best = np.empty(8 * ROW), np.empty(3 * ROW)
    there, absent = np.empty(AT_ONCE), np.empty(AT_ONCE)
    for left in range(0, width, ROW - 1):
        w = min(ROW - 1, width - left)
        wider = min(w + 1, width - left)  # with the next pixel
        for y in range(height):
            v[:], mine[:] = 0.0, 0.0
            best[:ROW], best[ROW : 2 * ROW], best[2 * ROW :] = NONE_YET, 0.0, NONE_YET
            for half in range(2):
                middle = (n + 1) // 2
                begin, end = (0, middle) if half == 0 else (middle, n)
                for t in range(begin, end, AT_ONCE):
                    k = min(AT_ONCE, end - t)
                    if k < AT_ONCE:
                        v[BEFORE * ROW :], under[:] = 0.0, 0.0
                    for i in range(k):
                        above(movie[t + i, y, left : left + wider], baseline, v[(BEFORE + i) * ROW :])
                        if y + 1 < height:
                            above(movie[t + i, y + 1, left : left + w], baseline, under[i * ROW :])
                    for i in range(AT_ONCE):
                        there[i] = 1.0 if i < k and t + i > 0 else 0.0
                        absent[i] = 0.0 if i < k else NONE_YET
                    add_up(w, v, under, there, mine)
                    rank(w, v, float(t), absent, best)
                    for i in range(BEFORE):
                        v[i * ROW : i * ROW + wider] = v[(k + i) * ROW : (k + i) * ROW + wider]
                sums[5 + half, y, left : left + w] = mine[5 * ROW : 5 * ROW + w]
                mine[5 * ROW : 6 * ROW] = 0.0
            for i in range(5):
                sums[i, y, left : left + w] = mine[i * ROW : i * ROW + w]
            for i in range(2):
                sums[7 + i, y, left : left + w] = mine[(6 + i) * ROW : (6 + i) * ROW + w]
            for i in range(3):
                ranks[i, y, left : left + w] = best[i * ROW : i * ROW + w]
    return sums, ranks


@inlined
def above(counts, baseline, values):  # type: ignore[no-untyped-def]
    for x in range(counts.size):
        values[x] = counts[x] - baseline


@inlined
def add_up(w, v, under, there, sums):  # type: ignore[no-untyped-def]
    """Add four frames of a row `v`, the two before them first, and of the row `under` it; steps where `there` is 1."""
    one, two, three, four = there[0], there[1], there[2], there[3]
    for x in range(w):
        y, z = v[x], v[ROW + x]
        a, b, c, d = v[2 * ROW + x], v[3 * ROW + x], v[4 * ROW + x], v[5 * ROW + x]
        aa, bb, cc, dd = a * a, b * b, c * c, d * d
        sums[x] += a + b + c + d
        sums[ROW + x] += aa + bb + cc + dd
        sums[2 * ROW + x] += aa * a + bb * b + cc * c + dd * d
        sums[3 * ROW + x] += z * a + a * b + b * c + c * d
        sums[4 * ROW + x] += y * a + z * b + a * c + b * d
        sums[5 * ROW + x] += one * (a - z) ** 2 + two * (b - a) ** 2 + three * (c - b) ** 2 + four * (d - c) ** 2
    for x in range(w):
        a, b, c, d = v[2 * ROW + x], v[3 * ROW + x], v[4 * ROW + x], v[5 * ROW + x]
        right = v[2 * ROW + x + 1], v[3 * ROW + x + 1], v[4 * ROW + x + 1], v[5 * ROW + x + 1]
        sums[6 * ROW + x] += a * right[0] + b * right[1] + c * right[2] + d * right[3]
        sums[7 * ROW + x] += a * under[x] + b * under[ROW + x] + c * under[2 * ROW + x] + d * under[3 * ROW + x]


@inlined
def rank(w, v, t, absent, ranks):  # type: ignore[no-untyped-def]
    """Take four frames of a row from frame t on into its largest values, their frames, and the next largest."""
    two, three, four = absent[1], absent[2], absent[3]
    for x in range(w):
        best = ranks[x], ranks[ROW + x], ranks[2 * ROW + x]
        best = ranked(v[2 * ROW + x], t, best)
        best = ranked(v[3 * ROW + x] + two, t + 1.0, best)
        best = ranked(v[4 * ROW + x] + three, t + 2.0, best)
        best = ranked(v[5 * ROW + x] + four, t + 3.0, best)
        ranks[x], ranks[ROW + x], ranks[2 * ROW + x] = best


@inlined
def ranked(now, t, best):  # type: ignore[no-untyped-def]
    top, at, second = best
    apart = t - at > 1.0
    overtaken = top if apart or at == 0.0 else NONE_YET
    beside = now if apart else NONE_YET
    return max(top, now), t if now > top else at, max(second, overtaken if now > top else beside)


@vectorised
def in_space(movie, baseline, label, parts):  # type: ignore[no-untyped-def]
    """Frame by frame: sums over rows and columns of each part, how far its pixels are from the frame before, and its
    digits. Sums of counts are whole numbers; 65 537 pixels in a line are the most that they hold."""
    n, height, width = movie.shape
    rows, columns = np.zeros((parts + 1, n, height)), np.zeros((parts + 1, n, width))
    steps = np.zeros((parts + 1, n))
    of_rows, of_columns = np.zeros((parts + 1, height)), np.zeros((parts + 1, width))
    mine, bins = np.zeros((parts + 1, height, width), np.uint32), np.empty((height, width), np.uint64)
    for y in range(height):
        for x in range(width):
            part = label[y, x]
            mine[part, y, x] = 0xFFFFFFFF
            of_rows[part, y] += baseline
            of_columns[part, x] += baseline
            bins[y, x] = ((x & 3) * (parts + 1) + part) * COMB
    comb = np.zeros(4 * (parts + 1) * COMB, dtype=np.int64)  # neighbours count apart: none waits for another
    down = np.empty((parts + 1, width), np.uint32)
    for t in range(n):
        down[:] = 0
        for y in range(height):
            counts, before, place = movie[t, y], movie[max(t - 1, 0), y], bins[y]
            for part in range(parts + 1):
                total, apart = add_line(counts, before, mine[part, y], down[part])
                rows[part, t, y] = total - of_rows[part, y]
                steps[part, t] += apart
            for x in range(width):
                comb[place[x] + np.uint64(counts[x] % COMB)] += 1
        for part in range(parts + 1):
            for x in range(width):
                columns[part, t, x] = down[part, x] - of_columns[part, x]
    return rows, columns, steps, comb.reshape(4, parts + 1, COMB).sum(axis=0)


@inlined
def add_line(counts, before, mine, down):  # type: ignore[no-untyped-def]
    """Add the counts of a line under a mask of bits to the sums of columns; their own sum, and that of how far they are
    from the counts before."""
    total, apart = np.uint32(0), np.uint32(0)
    for x in range(counts.size):
        now, then = np.uint32(counts[x]), np.uint32(before[x])
        v = np.uint32(now & mine[x])
        down[x] = np.uint32(down[x] + v)
        total = np.uint32(total + v)
        apart = np.uint32(apart + np.uint32(np.uint32(max(now, then) - min(now, then)) & mine[x]))
    return total, apart


@vectorised
def line_noise(sums, labels, count):  # type: ignore[no-untyped-def]
    """Variance of line means about frame and line means, each times its number of pixels, of the sums (part, frame,
    line) of some parts; lines of fewer than four pixels do not count: NaN where no two others are left. A line counts
    in no frame for more than `LINE_OUTLIER` standard deviations: one hit of a particle would outweigh all others."""
    n = sums.shape[1]
    lines = np.flatnonzero(count >= 4)
    if lines.size < 2 or n < 3:
        return np.nan
    means = np.zeros((n, lines.size))
    for t in range(n):
        for part in labels:
            for i in range(lines.size):
                means[t, i] += sums[part, t, lines[i]]
        for i in range(lines.size):
            means[t, i] /= count[lines[i]]
    steady = np.zeros(lines.size)
    for t in range(n):
        steady += means[t] / n
    for t in range(n):
        means[t] -= steady
        means[t] = (means[t] - means[t].mean()) ** 2 * count[lines]
    found = means.mean()
    for _ in range(2):  # the first time outliers have still widened the spread by which they are told
        found = np.minimum(means, LINE_OUTLIER**2 * found).mean()
    return found


@vectorised
def blur(maps, weights, rows, columns):  # type: ignore[no-untyped-def]
    """Maps (map, y, x) blurred by half of symmetric weights (centre first); rows, columns: see `spots.spot_filter`."""
    n, height, width = maps.shape
    margin = weights.size - 1
    result = np.empty(maps.shape)
    shape = (rows.size, columns.size)
    field, across, down = np.empty(shape), np.zeros(shape), np.zeros(shape)
    for i in range(n):
        for y in range(rows.size):
            for x in range(columns.size):
                field[y, x] = maps[i, rows[y], columns[x]]
        blurred(field.ravel(), weights, 1, across.ravel())
        blurred(across.ravel(), weights, columns.size, down.ravel())
        result[i] = down[margin : margin + height, margin : margin + width]
    return result
