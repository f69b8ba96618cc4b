"""The loops over frames that finding steps takes.

Import this module only where traces are idealised: it needs numba. Functions of a module are compiled once for a
machine (see `camera.kernels`).
"""

from __future__ import annotations

import numpy as np

from napari_mufasa.compiled import inlined, vectorised

FINE = 32  # stretches of more frames than this are tried at lengths of about 1/FINE apart, then frame by frame
TAIL, AT_TAIL = 0.1, 1.2816  # share of the frames beyond the quantiles that tell the noise, and where it begins
SKEWED = 4.5  # skewness over that of the quantiles


@inlined
def extreme_sums(sums, length):  # type: ignore[no-untyped-def]
    """The smallest and the largest sum over `length` successive frames, from the running sums of a trace."""
    ahead, low, high = sums[length:], 0.0, 0.0
    for i in range(sums.size - length):
        value = ahead[i] - sums[i]
        low, high = min(low, value), max(high, value)
    return low, high


@inlined
def most_different(sums, least):  # type: ignore[no-untyped-def]
    """The stretch of a trace whose mean differs most from that of the rest: its first frame, its end, and the variance
    it explains times the frames. `sums` are the running sums of the trace about its mean, from 0; stretch and rest
    have `least` frames or more."""
    m = sums.size - 1
    best, at = 0.0, least
    length = least
    while length <= m - least:
        low, high = extreme_sums(sums, length)
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
            if value > best:
                best, first, end = value, i, i + length
    return first, end, best


@inlined
def brightest(sums, least, most):  # type: ignore[no-untyped-def]
    """The same of the stretches of `least` to `most` frames that are brighter than the rest."""
    m = sums.size - 1
    best, at = -1.0, least
    for length in range(least, min(most, m - least) + 1):
        high = extreme_sums(sums, length)[1]
        value = high * high * m / (length * (m - length))
        if value > best:
            best, at = value, length
    first = 0
    for i in range(1, m + 1 - at):
        if sums[i + at] - sums[i] > sums[first + at] - sums[first]:
            first = i
    return first, first + at, best


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


@inlined
def is_flash(total, bounds, i, bright):  # type: ignore[no-untyped-def]
    """Whether segment i is shorter than `bright` frames and brighter than those beside it."""
    n, a, b = len(bounds) - 1, bounds[i], bounds[i + 1]
    if n == 1 or b - a >= bright:
        return False
    level = (total[b] - total[a]) / (b - a)
    before = i == 0 or (total[a] - total[bounds[i - 1]]) / (a - bounds[i - 1]) < level
    return before and (i == n - 1 or (total[bounds[i + 2]] - total[b]) / (bounds[i + 2] - b) < level)


@inlined
def noise(frames):  # type: ignore[no-untyped-def]
    """Standard deviation and skewness of frames about their levels: by quantiles, so that flashes among them do not
    count as noise, and those of a gamma distribution that has them, as electron-multiplied noise nearly is; by moments
    where so many frames are the same that quantiles show nothing."""
    n = frames.size
    ordered = np.sort(frames)
    k = int(TAIL * (n - 1) + 0.5)
    low, high, middle = ordered[k], ordered[n - 1 - k], 0.5 * (ordered[(n - 1) // 2] + ordered[n // 2])
    wide = high - low
    if middle - low > 1e-6 * wide:
        skewness = max((high + low - 2.0 * middle) / wide * SKEWED, 0.0)
        return wide / (of_gamma(AT_TAIL, skewness) - of_gamma(-AT_TAIL, skewness)), skewness
    mean, second, third = ordered.mean(), 0.0, 0.0
    for value in ordered:
        second += (value - mean) ** 2 / n
        third += (value - mean) ** 3 / n
    return np.sqrt(second), max(third, 0.0) / max(second, 1e-300) ** 1.5


@inlined
def beside(total, bounds, i):  # type: ignore[no-untyped-def]
    """Frames of the segments beside segment i, and their sum."""
    first, last = bounds[max(i - 1, 0)], bounds[min(i + 2, len(bounds) - 1)]
    a, b = bounds[i], bounds[i + 1]
    return last - first - (b - a), total[last] - total[first] - (total[b] - total[a])


@inlined
def noise_about(trace, total, bounds, least, bright):  # type: ignore[no-untyped-def]
    """The `noise` of a trace without its flashes and its degrees of freedom; and the sums of the squares and cubes of
    what is about the levels, with flashes of fewer than `least` frames: single hits, where light is sparse."""
    about, levels, n, squares, cubes = np.empty(trace.size), 0, 0, 0.0, 0.0
    for i in range(len(bounds) - 1):
        a, b = bounds[i], bounds[i + 1]
        flash = is_flash(total, bounds, i, bright)
        if flash and b - a >= least:
            continue
        if flash:
            frames, light = beside(total, bounds, i)
            height = (total[b] - total[a]) / (b - a) - light / frames
            squares += (b - a) * height**2
            cubes += (b - a) * height**3
            continue
        for j in range(a, b):
            about[n] = trace[j] - (total[b] - total[a]) / (b - a)
            squares += about[n] ** 2
            cubes += about[n] ** 3
            n += 1
        levels += 1
    sd, skewness = noise(about[:n])
    df = float(max(n - levels, 2))
    return sd * np.sqrt(n / df), skewness, df, squares, cubes


@inlined
def of_gamma(z, skewness):  # type: ignore[no-untyped-def]
    """The deviate of a gamma distribution as improbable as a normal one (Wilson and Hilferty 1931)."""
    if skewness < 1e-3:
        return z
    return 2.0 / skewness * (max(1.0 + skewness * z / 6.0 - skewness**2 / 36.0, 0.0) ** 3 - 1.0)


@inlined
def of_normal(z, skewness):  # type: ignore[no-untyped-def]
    """The normal deviate as improbable as that of a gamma distribution."""
    if skewness < 1e-3:
        return z
    return 6.0 / skewness * (np.cbrt(1.0 + 0.5 * skewness * z) - 1.0) + skewness / 6.0


@inlined
def weakest_flash(total, squares, bounds, least, bright, known):  # type: ignore[no-untyped-def]
    """The flash that stands out least from the frames beside it, and by which normal deviate; −1 without one. `known`
    is what `noise_about` tells; the noise is that of the frames beside it where that is more, and one of fewer than
    `least` frames stands out of all others like it, too."""
    sd, skewness, df, all_squares, all_cubes = known
    n = len(bounds) - 1
    where, weakest = -1, np.inf
    for i in range(n):
        if not is_flash(total, bounds, i, bright):
            continue
        a, b = bounds[i], bounds[i + 1]
        length = float(b - a)
        frames, light = beside(total, bounds, i)
        height = (total[b] - total[a]) / length - light / frames
        about = 0.0
        for j in (i - 1, i + 1):
            if 0 <= j < n:
                c, d = bounds[j], bounds[j + 1]
                about += squares[d] - squares[c] - (total[d] - total[c]) ** 2 / (d - c)
        variance, skewed = max(sd * sd, about / frames), skewness
        if length < least:
            others = max(all_squares - length * height**2, 0.0) / df
            cubes = max(all_cubes - length * height**3, 0.0) / df
            variance, skewed = max(variance, others), max(skewed, cubes / max(others, 1e-300) ** 1.5)
        z = deviate(height * height * length * frames / (length + frames), variance * df, df)
        z = of_normal(z, skewed / np.sqrt(length)) if length > 1.0 else 0.0  # no frame alone is told from a single hit
        if z < weakest:
            where, weakest = i, z
    return where, weakest


@inlined
def brightest_part(sums, first, end):  # type: ignore[no-untyped-def]
    """First frame and end of the part of a stretch that differs most from the rest of the trace."""
    best, at, to = 0.0, first, end
    for a in range(first, end):
        for b in range(a + 1, end + 1):
            light = sums[b] - sums[a]
            if light > 0.0 and light * light / (b - a) > best:
                best, at, to = light * light / (b - a), a, b
    return at, to


@vectorised
def first_frames(trace, lengths, arcs, splits, least, bright):  # type: ignore[no-untyped-def]
    """First frames of the segments of a trace. `arcs` and `splits` are the deviates that a stretch against the rest,
    and a step between two segments, must reach in as many frames as `lengths` says; what is shorter than `bright`
    frames and brighter than the rest must reach them after skewness is taken off."""
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
        first, end, explained = most_different(sums[: m + 1], least)
        within = squares[b] - squares[a] - m * mean * mean - explained
        limit = np.interp(float(m), lengths, arcs)
        if deviate(explained, within, m - 2.0) <= limit:
            # Many flashes hide each other in what the frames scatter by.
            first, end, explained = brightest(sums[: m + 1], least, bright - 1)
            sd, skewness = noise(trace[a:b])
            z = deviate(explained, sd * sd * (m - 2.0), m - 2.0)
            if of_normal(z, skewness / np.sqrt(max(end - first, 1.0))) <= limit:
                continue
        if end - first == least:
            first, end = brightest_part(sums, first, end)
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
    # goes until all stand out between their own two segments, and then the weakest flash.
    whole, known = np.interp(float(n), lengths, arcs), (-1.0, 0.0, 0.0, 0.0, 0.0)
    while len(bounds) > 2:
        weakest, where = np.inf, 0
        for i in range(1, len(bounds) - 1):
            a, c, b = bounds[i - 1], bounds[i], bounds[i + 1]
            excess = between(total, squares, a, c, b) / np.interp(float(b - a), lengths, splits)
            if excess < weakest:
                weakest, where = excess, i
        if weakest > 1.0:
            if known[0] < 0.0:
                known = noise_about(trace, total, bounds, least, bright)
            flash, stands_out = weakest_flash(total, squares, bounds, least, bright, known)
            if flash < 0 or stands_out > whole:
                break
            where = flash if flash > 0 else 1  # the end towards the brighter side goes
            if 0 < flash < len(bounds) - 2:
                a, c, d, b = bounds[flash - 1], bounds[flash], bounds[flash + 1], bounds[flash + 2]
                if (total[b] - total[d]) / (b - d) > (total[c] - total[a]) / (c - a):
                    where = flash + 1
        bounds.pop(where)
    return np.array(bounds[:-1])
