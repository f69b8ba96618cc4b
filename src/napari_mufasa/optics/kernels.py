"""The loop that draws spots on a detector.

Import this module only where a movie is drawn: it needs numba. Functions of a module are compiled once for a machine
(see `camera_kernels`).
"""

from __future__ import annotations

import math

import numpy as np
from scipy import stats

from napari_mufasa.compiled import jit
from napari_mufasa.optics.gaussian import REACH_SIGMA

UNKNOWN = -1
FINE = 128  # places of the table in a standard deviation
END = math.ceil(REACH_SIGMA) + 1
PLACES = np.arange(-END * FINE, END * FINE + 1) / FINE
BELOW, DENSITY = stats.norm.cdf(PLACES), stats.norm.pdf(PLACES)


@jit
def below(z):  # type: ignore[no-untyped-def]
    """The standard normal law below z, by its derivatives at the nearest place of a table: to 4e-9, and faster
    than an error function, of which moving spots need a dozen in every frame."""
    k = min(max(int(np.rint((z + END) * FINE)), 0), BELOW.size - 1)
    d = min(max(z, -END), END) - PLACES[k]
    return BELOW[k] + DENSITY[k] * d * (1.0 - 0.5 * PLACES[k] * d)


@jit
def shares(at, sigma, length, share):  # type: ignore[no-untyped-def]
    """The share of a Gaussian at `at` that each of `length` pixels in a line gets: the first pixel, how many."""
    start = max(0, math.floor(at + 0.5 - REACH_SIGMA * sigma))
    stop = min(length, math.ceil(at + 0.5 + REACH_SIGMA * sigma))
    before = below((start - 0.5 - at) / sigma)
    for i in range(start, stop):
        after = below((i + 0.5 - at) / sigma)
        share[i - start] = after - before
        before = after
    return start, max(stop - start, 0)


@jit
def draw_spots(images, photons, positions, sigma):  # type: ignore[no-untyped-def]
    """Add spots to images (frame, y, x); arguments as in `optics.spot_images`. Of spots at rest the shares are made
    once."""
    n_frames, height, width = images.shape
    n_molecules = photons.shape[1]
    at_rest = positions.shape[0] == 1 and sigma.shape[0] == 1
    size = 2 * math.ceil(REACH_SIGMA * sigma.max()) + 3
    y_share, x_share = np.empty((n_molecules, size), np.float32), np.empty((n_molecules, size), np.float32)
    where = np.full((n_molecules, 4), UNKNOWN)  # first row, rows, first column, columns
    for f in range(n_frames):
        fp, fs = min(f, positions.shape[0] - 1), min(f, sigma.shape[0] - 1)
        for m in range(n_molecules):
            n = np.float32(photons[f, m])
            if n == 0.0:
                continue
            if not at_rest or where[m, 0] == UNKNOWN:
                where[m, 0], where[m, 1] = shares(positions[fp, m, 0], sigma[fs, 0], height, y_share[m])
                where[m, 2], where[m, 3] = shares(positions[fp, m, 1], sigma[fs, 1], width, x_share[m])
            y0, rows, x0, columns = where[m]
            share = x_share[m, :columns]
            for i in range(rows):
                row, line = n * y_share[m, i], images[f, y0 + i, x0 : x0 + columns]
                for j in range(columns):
                    line[j] += row * share[j]


@jit
def add_pattern(images, course, pattern):  # type: ignore[no-untyped-def]
    """Add a pattern (y, x) to images (frame, y, x), each times its course (frame,)."""
    n_frames, height, width = images.shape
    for f in range(n_frames):
        for y in range(height):
            for x in range(width):
                images[f, y, x] += course[f] * pattern[y, x]
