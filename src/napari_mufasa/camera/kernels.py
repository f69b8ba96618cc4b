"""The camera's loops: shot noise with multiplication, and read noise, per pixel.

Import this module only where a camera records: it needs numba. Functions of a module are compiled once for a machine;
a function that is made inside another one and calls compiled functions would be compiled anew in every process.
"""

from __future__ import annotations

import math

import numpy as np

from napari_mufasa.camera.register import electrons_after_gain
from napari_mufasa.chance.variates import (
    SMOOTH,
    gamma,
    normal_quantile,
    poisson,
    poisson_quantiles,
    poisson_row,
    stream,
    tails,
    uniforms,
)
from napari_mufasa.compiled import inlined, jit, vectorised


@jit
def detect(expected, shape, kept, frames, key, table, excess, leans):  # type: ignore[no-untyped-def]
    """Photoelectrons times their multiplication noise of mean 1: n electrons become kept·n + (1 − kept)·Gamma(shape·n,
    scale 1/shape), without noise where shape is 0; no electron in, none out. By the quantiles of the register's table,
    for which its excess noise factor and lean are (`camera.register`); where the table is empty, electrons are drawn
    first, a row at once, then their noise, if there is any, number by number."""
    n_frames, height, width = expected.shape
    result = np.empty(expected.shape, dtype=np.float32)
    bits, light, tail = np.empty(width, np.uint64), np.empty(width, np.float32), np.empty(width, np.float32)
    cell, scratch = np.empty(width, np.int32), np.empty((3, width), np.float32)
    u, mean, none, below, counts = np.empty(width), np.empty(width), np.empty(width), np.empty(width), np.empty(width)
    for f in range(n_frames):
        for y in range(height):
            if table.size > 0:
                tails(key, frames[f], y * width, bits, tail)
                for x in range(width):
                    light[x] = max(expected[f, y, x], np.float32(0.0))
                electrons_after_gain(light, tail, table, excess, leans, cell, scratch, result[f, y])
                continue
            if expected[f, y].min() >= SMOOTH:
                tails(key, frames[f], y * width, bits, tail)
                poisson_quantiles(expected[f, y], tail, result[f, y])
            else:
                uniforms(key, frames[f], y * width, 1, u)
                # The row at once up to twice its mean, the few brighter pixels one by one.
                total = 0.0
                for x in range(width):
                    total += max(expected[f, y, x], 0.0)
                bright = min(2.0 * total / width + 2.0, 29.9)
                top = 0.0
                for x in range(width):
                    mean[x] = max(expected[f, y, x], 0.0) if expected[f, y, x] <= bright else 0.0
                    top = max(top, mean[x])
                poisson_row(mean, u, int(top + 8.0 * math.sqrt(top) + 9.0), none, below, counts)
                for x in range(width):
                    result[f, y, x] = counts[x]
                    if expected[f, y, x] > bright:
                        result[f, y, x], _ = poisson(expected[f, y, x], stream(key, frames[f], y * width + x))
            for x in range(width if shape != 0.0 else 0):
                n = result[f, y, x]
                if n > 0:
                    amplified, _ = gamma(shape * n, stream(key + np.uint64(1), frames[f], y * width + x))
                    result[f, y, x] = kept * n + (1.0 - kept) * amplified / shape
    return result


@vectorised
def mix_rows(values, weights, wraps, mixed):  # type: ignore[no-untyped-def]
    """Each pixel of `values` (frame, y, x) as the sum of itself and of those before it in its row, with `weights`
    (lag,); before a row comes its first pixel again, or where it `wraps` its end."""
    n_frames, height, width = values.shape
    before = weights.size - 1
    line = np.empty(before + width, np.float32)
    for f in range(n_frames):
        for y in range(height):
            row, total = values[f, y], mixed[f, y]
            for x in range(before):
                line[x] = row[(x - before) % width] if wraps else row[0]
            for x in range(width):
                line[before + x] = row[x]
                total[x] = weights[0] * row[x]
            for lag in range(1, before + 1):
                weight, earlier = weights[lag], line[before - lag : before - lag + width]
                for x in range(width):
                    total[x] += weight * earlier[x]


@jit
def read_out(electrons, sigma, mean, frames, key):  # type: ignore[no-untyped-def]
    n_frames, height, width = electrons.shape
    bits, tail = np.empty(width, np.uint64), np.empty(width, np.float32)
    for f in range(n_frames):
        for y in range(height):
            tails(key, frames[f], y * width, bits, tail)
            add_normal(electrons[f, y], np.float32(mean), sigma[y], tail)


@inlined
def add_normal(values, mean, sigma, tail):  # type: ignore[no-untyped-def]
    for x in range(values.size):
        values[x] += mean + sigma[x] * normal_quantile(tail[x])


@jit
def digitise(electrons, electrons_per_adu, baseline, most):  # type: ignore[no-untyped-def]
    """min(⌊electrons / electrons_per_adu + baseline⌋, most), never below 0; baseline (y, x) float32."""
    n_frames, height, width = electrons.shape
    counts = np.empty(electrons.shape, np.uint16)
    top = np.float32(most)
    for f in range(n_frames):
        for y in range(height):
            for x in range(width):
                adu = np.floor(electrons[f, y, x] / electrons_per_adu + baseline[y, x])
                counts[f, y, x] = np.int32(min(max(adu, np.float32(0.0)), top))
    return counts


FINE = 64  # cells per ADU in the table of codes; a code narrower than a cell is missed


@jit
def digitise_unevenly(electrons, electrons_per_adu, baseline, most, begins):  # type: ignore[no-untyped-def]
    """Like `digitise`, but code k begins at begins[k] (ascending, float64) instead of k, and so on periodically."""
    n_frames, height, _ = electrons.shape
    period = begins.size
    code = np.zeros(period * FINE, np.float32)  # the code at the beginning of a cell,
    turn = np.full(period * FINE, np.float32(period))  # where in the period it ends, if it does within the cell,
    step = np.zeros(period * FINE, np.float32)  # and how many codes begin there
    k = 0
    for cell in range(period * FINE):
        code[cell] = k
        while k + 1 < period and (begins[k + 1] - begins[0]) * FINE < cell + 1:
            turn[cell] = min(turn[cell], begins[k + 1] - begins[0])
            step[cell] += 1
            k += 1
    counts = np.empty(electrons.shape, np.uint16)
    for f in range(n_frames):
        for y in range(height):
            number_row(electrons[f, y], electrons_per_adu, baseline[y], begins[0], most, code, turn, step, counts[f, y])
    return counts


@inlined
def number_row(electrons, electrons_per_adu, baseline, first, most, code, turn, step, counts):  # type: ignore[no-untyped-def]
    period, top = np.float32(code.size // FINE), np.float32(most)
    cells, last = np.float32(FINE), np.int32(code.size - 1)
    for x in range(electrons.size):
        adu = electrons[x] / electrons_per_adu + baseline[x] - np.float32(first)
        whole = np.floor(adu / period) * period
        rest = adu - whole
        cell = min(np.int32(rest * cells), last)
        k = code[cell] + (step[cell] if rest >= turn[cell] else np.float32(0.0))
        counts[x] = np.int32(min(max(whole + k, np.float32(0.0)), top))
