"""The loops over frames that finding steps takes.

Import this module only where traces are idealised: it needs numba. Functions of a module are compiled once for a
machine (see `camera.kernels`).
"""

from __future__ import annotations

import numpy as np

from napari_mufasa.compiled import inlined, vectorised

FINE = 32  # stretches of more frames than this are tried at lengths of about 1/FINE apart, then frame by frame


@inlined
def extreme_sums(sums, length):  # type: ignore[no-untyped-def]
    """The smallest and the largest sum over `length` successive frames, from the running sums of a trace."""
    ahead, low, high = sums[length:], 0.0, 0.0
    for i in range(sums.size - length):
        value = ahead[i] - sums[i]
        low, high = min(low, value), max(high, value)
    return low, high


@inlined
def most_different(sums, least, bright):  # type: ignore[no-untyped-def]
    """The stretch of a trace whose mean differs most from that of the rest: its first frame, its end, and the variance
    it explains times the frames. `sums` are the running sums of the trace about its mean, from 0; stretch and rest
    have `least` frames or more, the brighter of the two `bright` or more."""
    m = sums.size - 1
    best, at = 0.0, least
    length = least
    while length <= m - least:
        low, high = extreme_sums(sums, length)
        # Brighter is either the stretch or the rest.
        high = high if length >= bright else 0.0
        low = low if m - length >= bright else 0.0
        value = max(-low, high) ** 2 * m / (length * (m - length))
        if value > best:
            best, at = value, length
        length += max(1, min(length, m - length) // FINE)
    step = max(1, min(at, m - at) // FINE)
    best, first, end = -1.0, 0, m
    for length in range(max(least, at - step), min(m - least, at + step) + 1):
        scale = m / (length * (m - length))
        for i in range(m + 1 - length):
            difference = sums[i + length] - sums[i]
            value = difference**2 * scale
            if value > best and (length if difference > 0.0 else m - length) >= bright:
                best, first, end = value, i, i + length
    return first, end, best


@inlined
def deviate(explained, within, df):  # type: ignore[no-untyped-def]
    """A normal deviate as improbable as the difference of two means: Student's heavier tails taken off."""
    within = max(within, 1e-12 * explained + 1e-300)
    return np.sqrt(df * np.log1p(explained / within)) * (1.0 - 0.75 / df)


@inlined
def between(total, squares, a, c, b):  # type: ignore[no-untyped-def]
    """The deviate of the difference of the means of the frames a … c − 1 and c … b − 1, from running sums."""
    left, right = (total[c] - total[a]) / (c - a), (total[b] - total[c]) / (b - c)
    explained = (left - right) ** 2 * (c - a) * (b - c) / (b - a)
    about = squares[b] - squares[a] - (total[b] - total[a]) ** 2 / (b - a)
    return deviate(explained, about - explained, b - a - 2.0)


@vectorised
def first_frames(trace, lengths, arcs, splits, least, bright):  # type: ignore[no-untyped-def]
    """First frames of the segments of a trace. `arcs` and `splits` are the deviates that a stretch against the rest,
    and a step between two segments, must reach in as many frames as `lengths` says."""
    n = trace.size
    total, squares = np.zeros(n + 1), np.zeros(n + 1)
    for i in range(n):
        total[i + 1] = total[i] + trace[i]
        squares[i + 1] = squares[i] + trace[i] * trace[i]
    sums = np.empty(n + 1)
    bounds = [0, n]
    todo = [(0, n)]
    while len(todo) > 0:
        a, b = todo.pop()
        m = b - a
        if m < 2 * least:
            continue
        mean = (total[b] - total[a]) / m
        for i in range(m + 1):
            sums[i] = total[a + i] - total[a] - i * mean
        first, end, explained = most_different(sums[: m + 1], least, bright)
        within = squares[b] - squares[a] - m * mean * mean - explained
        if deviate(explained, within, m - 2.0) <= np.interp(float(m), lengths, arcs):
            continue
        parts = [a]
        if first >= least:
            parts.append(a + first)
        if m - end >= least:
            parts.append(a + end)
        parts.append(b)
        if len(parts) == 2:
            continue
        for i in range(1, len(parts) - 1):
            bounds.append(parts[i])
        for i in range(len(parts) - 1):
            todo.append((parts[i], parts[i + 1]))
    bounds.sort()
    # One end of a stretch may be chance, and a later split may have taken an earlier one's place: the weakest step
    # goes until all stand out between their own two segments.
    while len(bounds) > 2:
        weakest, where = np.inf, 0
        for i in range(1, len(bounds) - 1):
            a, c, b = bounds[i - 1], bounds[i], bounds[i + 1]
            excess = between(total, squares, a, c, b) / np.interp(float(b - a), lengths, splits)
            if excess < weakest:
                weakest, where = excess, i
        if weakest > 1.0:
            break
        bounds.pop(where)
    return np.array(bounds[:-1])
