"""The loops over all pixels of a movie that observing takes.

Import this module only where a movie is observed: it needs numba. Functions of a module are compiled once for a
machine (see `camera_kernels`).
"""

from __future__ import annotations

import numpy as np

from napari_mufasa.compiled import inlined, vectorised
from napari_mufasa.observe.table import COMB

NONE_YET = -1e300


@inlined
def rank(now, t, peak, at, second):  # type: ignore[no-untyped-def]
    """Take frame t of a row into its largest values and the next largest; neither next to the other in time."""
    for x in range(now.size):
        v, top = now[x], peak[x]
        apart = t - at[x] > 1.0
        overtaken = top if apart or at[x] == 0.0 else NONE_YET
        beside = v if apart else NONE_YET
        second[x] = max(second[x], overtaken if v > top else beside)
        peak[x] = max(top, v)
        at[x] = t if v > top else at[x]


@vectorised
def in_time(movie, baseline):  # type: ignore[no-untyped-def]
    """Row by row through all frames, so that a row's sums stay close to the processor."""
    n, height, width = movie.shape
    shape = (height, width)
    s1, s2, s3 = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    step, l1, l2 = np.zeros((2, height, width)), np.zeros(shape), np.zeros(shape)
    right, below = np.zeros(shape), np.zeros(shape)
    peak, second = np.full(shape, NONE_YET), np.full(shape, NONE_YET)
    peak_frame = np.zeros(shape)
    now, before, earlier, next_row = np.zeros(width), np.zeros(width), np.zeros(width), np.zeros(width)
    for y in range(height):
        before[:], earlier[:] = 0.0, 0.0
        for t in range(n):
            # Without branches, so that these loops become vector instructions.
            for x in range(width):
                now[x] = movie[t, y, x] - baseline
            for x in range(width):
                v = now[x]
                s1[y, x] += v
                s2[y, x] += v * v
                s3[y, x] += v * v * v
            for x in range(width):
                v = now[x]
                l1[y, x] += v * before[x]
                l2[y, x] += v * earlier[x]
            for x in range(width - 1):
                right[y, x] += now[x] * now[x + 1]
            if y + 1 < height:
                for x in range(width):
                    next_row[x] = movie[t, y + 1, x] - baseline
                for x in range(width):
                    below[y, x] += now[x] * next_row[x]
            if t > 0:
                half = 2 * t // n
                for x in range(width):
                    difference = now[x] - before[x]
                    step[half, y, x] += difference * difference
            rank(now, float(t), peak[y], peak_frame[y], second[y])
            now, before, earlier = earlier, now, before
    return s1, s2, s3, step, l1, l2, right, below, peak, peak_frame.astype(np.int64), second


@vectorised
def in_space(movie, baseline, label, parts):  # type: ignore[no-untyped-def]
    """Frame by frame: sums over rows and columns of each part, and its digits."""
    n, height, width = movie.shape
    rows, columns = np.zeros((parts + 1, n, height)), np.zeros((parts + 1, n, width))
    comb = np.zeros((4, parts + 1, COMB), dtype=np.int64)  # neighbours count apart: none waits for another
    mine = np.zeros((parts + 1, height, width))
    for part in range(parts + 1):
        mine[part] = label == part
    value = np.empty(width)
    for t in range(n):
        for y in range(height):
            for x in range(width):
                value[x] = movie[t, y, x] - baseline
            for part in range(parts + 1):
                total = 0.0
                for x in range(width):
                    v = mine[part, y, x] * value[x]
                    columns[part, t, x] += v
                    total += v
                rows[part, t, y] = total
            for x in range(width):
                comb[x & 3, label[y, x], movie[t, y, x] % COMB] += 1
    return rows, columns, comb.sum(axis=0)
