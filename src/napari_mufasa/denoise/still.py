"""What a pixel showed before and after a frame, averaged as far as the scene stood still.

A molecule stays in one state for many frames and then changes at once. Walking through the movie, every pixel keeps
the mean of the frames since its last change; a change is seen when the mean of the last three frames, smoothed to the
size of a spot, leaves that mean by more than its noise allows. One walk forwards and one backwards give the past and
the future of each frame, neither of which holds the frame itself: they enter its risk estimate as known images. Only
the choice between them, next to a change, looks at the frame; the estimate leaves out what that adds.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from numpy.typing import NDArray

    from .let import Noise

    Array = NDArray[Any]

#: Frames whose mean is compared with the longer one.
RECENT = 3
#: Standard deviations at which a change begins to be believed and is believed entirely.
DOUBTED, BELIEVED = 3.0, 4.0
#: The same for past and future to show different scenes.
ALIKE, UNLIKE = 2.0, 5.0
#: Smallest signal, in units of alpha, that the noise level is computed from.
FLOOR = 0.01
#: Smoothing along each axis, and what it leaves of white noise's variance over both.
TAPS = (1.0 / 9.0, 2.0 / 9.0, 3.0 / 9.0)
SHARE = (2 * TAPS[0] ** 2 + 2 * TAPS[1] ** 2 + TAPS[2] ** 2) ** 2


@njit(cache=True, fastmath=True, nogil=True)
def smooth(a: Array) -> Array:
    """``a`` smoothed with `TAPS` along both axes; the outermost pixels are repeated."""
    rows, cols = a.shape
    far, near, here = np.float32(TAPS[0]), np.float32(TAPS[1]), np.float32(TAPS[2])
    down = np.empty_like(a)
    out = np.empty_like(a)
    for r in range(rows):
        r0, r1, r3, r4 = max(r - 2, 0), max(r - 1, 0), min(r + 1, rows - 1), min(r + 2, rows - 1)
        for c in range(cols):
            down[r, c] = far * (a[r0, c] + a[r4, c]) + near * (a[r1, c] + a[r3, c]) + here * a[r, c]
    for r in range(rows):
        for c in range(2, cols - 2):
            out[r, c] = far * (down[r, c - 2] + down[r, c + 2]) + here * down[r, c]
            out[r, c] += near * (down[r, c - 1] + down[r, c + 1])
        for part in range(2):
            for c in range(min(2, cols)) if part == 0 else range(max(cols - 2, 0), cols):
                total = here * down[r, c]
                total += far * (down[r, max(c - 2, 0)] + down[r, min(c + 2, cols - 1)])
                out[r, c] = total + near * (down[r, max(c - 1, 0)] + down[r, min(c + 1, cols - 1)])
    return out


@njit(cache=True, fastmath=True, nogil=True)
def _step(
    y: Array, recent: Array, s_recent: Array, k: float, mean: Array, number: Array, s_mean: Array, variance: Array,
    alpha: float, most: float,
) -> tuple[Array, Array]:  # fmt: skip
    """Mean and number of frames after frame ``y``; ``recent`` is the mean of the last ``k`` frames with ``y``."""
    rows, cols = y.shape
    new_mean, new_number = np.empty_like(mean), np.empty_like(number)
    floor = np.float32(FLOOR * alpha)
    top, span = np.float32(BELIEVED**2), np.float32(BELIEVED**2 - DOUBTED**2)
    alpha32, share, inverse = np.float32(alpha), np.float32(SHARE), np.float32(1.0 / k)
    one, after = np.float32(1.0), np.float32(min(k, 2.0))
    limit = np.float32(most)
    for r in range(rows):
        for c in range(cols):
            n = number[r, c]
            before = (n * mean[r, c] + y[r, c]) / (n + one)
            apart = s_recent[r, c] - s_mean[r, c]
            level = share * (alpha32 * max(s_mean[r, c], floor) + variance[r, c]) * (inverse + one / (n + one))
            kept = min(max((top - apart * apart / max(level, np.float32(1e-12))) / span, np.float32(0.0)), one)
            new_mean[r, c] = kept * before + (one - kept) * recent[r, c]
            new_number[r, c] = kept * min(n + one, limit) + (one - kept) * after
    return new_mean, new_number


@njit(cache=True, fastmath=True, nogil=True)
def _joined(
    past: Array, n_past: Array, s_past: Array, future: Array, n_future: Array, s_future: Array, s_now: Array,
    variance: Array, alpha: float,
) -> tuple[Array, float]:  # fmt: skip
    """Mean of past and future by their frames where they agree, and its mean noise variance.

    Where they differ, a change lies just before or just after the frame: the one that the frame, smoothed, looks like
    counts, by the odds of the two.
    """
    rows, cols = past.shape
    out = np.empty_like(past)
    floor = np.float32(FLOOR * alpha)
    top, span = np.float32(UNLIKE**2), np.float32(UNLIKE**2 - ALIKE**2)
    alpha32, share, one, half = np.float32(alpha), np.float32(SHARE), np.float32(1.0), np.float32(0.5)
    total = 0.0
    for r in range(rows):
        row_total: Any = np.float32(0.0)
        for c in range(cols):
            n, m = n_past[r, c], n_future[r, c]
            by_frames = (n * past[r, c] + m * future[r, c]) / (n + m)
            s_mean = (n * s_past[r, c] + m * s_future[r, c]) / (n + m)
            one_frame = max(share * (alpha32 * max(s_mean, floor) + variance[r, c]), np.float32(1e-12))
            level = one_frame * (one / n + one / m)
            apart = s_past[r, c] - s_future[r, c]
            nearer = apart * (s_now[r, c] - half * (s_past[r, c] + s_future[r, c])) / one_frame
            odds = one / (one + np.exp(-min(max(nearer, np.float32(-20.0)), np.float32(20.0))))
            plain = future[r, c] + odds * (past[r, c] - future[r, c])
            agree = min(max((top - apart * apart / level) / span, np.float32(0.0)), one)
            out[r, c] = plain + agree * (by_frames - plain)
            row_total += one / (n + m)
        total += row_total
    return out, total / (rows * cols)


def walk(data: Array, order: Iterable[int], noise: Noise, most: int) -> Iterator[tuple[int, Array, Array, Array]]:
    """For each frame of ``order`` but the first: mean, number of frames and smoothed mean of those walked before."""
    variance = np.ascontiguousarray(np.broadcast_to(noise.variance, data.shape[1:]), np.float32)
    mean = number = None
    last: list[Array] = []
    for t in order:
        y = data[t]
        if mean is None or number is None:
            mean, number, last = y, np.ones_like(y), [y]
            continue
        s_mean = smooth(mean)
        yield t, mean, number, s_mean
        last = [*last, y][-RECENT:]
        recent = sum(last[1:], last[0]) * np.float32(1.0 / len(last))
        mean, number = _step(
            y, recent, smooth(recent), float(len(last)), mean, number, s_mean, variance, noise.alpha, float(most)
        )


def past_and_future(data: Array, first: int, stop: int, noise: Noise, most: int) -> Iterator[tuple[int, Array, float]]:
    """For the frames first … stop - 1 of ``data``: what their past and future show, and its relative noise variance.

    ``most`` frames on either side count at most; ``data`` should reach that far.
    """
    n = data.shape[0]
    variance = np.ascontiguousarray(np.broadcast_to(noise.variance, data.shape[1:]), np.float32)
    end, start = min(n, stop + most), max(0, first - most)
    future = {t: (a, b, c) for t, a, b, c in walk(data, range(end - 1, first - 1, -1), noise, most) if t < stop}
    if start == first:
        mean, number, _ = future.pop(first)
        yield first, mean, float(np.mean(1.0 / number))
    for t, mean, number, s_mean in walk(data, range(start, stop), noise, most):
        if t < first:
            continue
        if t in future:
            seen, relative = _joined(mean, number, s_mean, *future.pop(t), smooth(data[t]), variance, noise.alpha)
        else:
            seen, relative = mean, float(np.mean(1.0 / number))
        yield t, seen, relative
