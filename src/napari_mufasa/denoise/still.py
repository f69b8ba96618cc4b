"""What a pixel showed before and after a frame, averaged as far as the scene stood still.

A molecule stays in one state for many frames and then changes at once. Walking through the movie, every pixel keeps
the mean of the frames since its last change; a change is seen when the mean of the last three frames, smoothed to the
size of a spot, leaves that mean by more than its noise allows. One walk forwards and one backwards give the past and
the future of each frame, neither of which holds the frame itself: they enter its risk estimate as known images. Only
the choice between them, next to a change, looks at the frame; the estimate leaves out what that adds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_mufasa.compiled import inlined, vectorised

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from .noise import Noise
    from .reel import Reel

    Array = NDArray[Any]
    #: Mean, number of frames and smoothed mean, each (y, x).
    Side = tuple[Array, Array, Array]

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


@inlined
def _along_row(out: Array, a: Array) -> None:
    """A row smoothed with `TAPS`, the outermost pixels repeated; ``a`` and ``out`` must not overlap."""
    cols = len(a)
    far, near, middle = np.float32(TAPS[0]), np.float32(TAPS[1]), np.float32(TAPS[2])
    if cols > 4:
        inner, a0, a1, a2, a3, a4 = out[2:-2], a[:-4], a[1:-3], a[2:-2], a[3:-1], a[4:]
        for c in range(len(inner)):
            inner[c] = far * (a0[c] + a4[c]) + near * (a1[c] + a3[c]) + middle * a2[c]
    for part in range(2):
        for c in range(min(2, cols)) if part == 0 else range(max(cols - 2, 0), cols):
            total = middle * a[c] + far * (a[max(c - 2, 0)] + a[min(c + 2, cols - 1)])
            out[c] = total + near * (a[max(c - 1, 0)] + a[min(c + 1, cols - 1)])


@inlined
def _across_rows(out: Array, ring: Array, r: int, rows: int) -> None:
    """Row ``r`` of the smoothed image from a ring of five rows that are smoothed along themselves."""
    far, near, middle = np.float32(TAPS[0]), np.float32(TAPS[1]), np.float32(TAPS[2])
    a0, a1, a2 = ring[max(r - 2, 0) % 5], ring[max(r - 1, 0) % 5], ring[r % 5]
    a3, a4 = ring[min(r + 1, rows - 1) % 5], ring[min(r + 2, rows - 1) % 5]
    for c in range(len(out)):
        out[c] = far * (a0[c] + a4[c]) + near * (a1[c] + a3[c]) + middle * a2[c]


@vectorised
def smooth(a: Array) -> Array:
    """``a`` smoothed with `TAPS` along both axes; the outermost pixels are repeated."""
    rows, cols = a.shape
    ring = np.empty((5, cols), a.dtype)
    out = np.empty_like(a)
    for r in range(-2, rows):
        if r + 2 < rows:
            _along_row(ring[(r + 2) % 5], a[r + 2])
        if r >= 0:
            _across_rows(out[r], ring, r, rows)
    return out


@inlined
def _mean_of_recent(out: Array, y: Array, before: Array, earlier: Array, k: int) -> None:
    """Mean of the last ``k`` (1 to 3) frames of a row."""
    second, third = np.float32(k > 1), np.float32(k > 2)
    share = np.float32(1.0 / k)
    for c in range(len(out)):
        out[c] = share * (y[c] + second * before[c] + third * earlier[c])


@inlined
def _believed(out: Array, s_recent: Array, s_mean: Array, number: Array, variance: Array, alpha: float, k: int) -> None:
    """How far a row's longer mean still holds, from 0 to 1."""
    floor, alpha32, share = np.float32(FLOOR * alpha), np.float32(alpha), np.float32(SHARE)
    top, inverse_span = np.float32(BELIEVED**2), np.float32(1.0 / (BELIEVED**2 - DOUBTED**2))
    one, zero, tiny, inverse = np.float32(1.0), np.float32(0.0), np.float32(1e-12), np.float32(1.0 / k)
    for c in range(len(out)):
        apart = s_recent[c] - s_mean[c]
        level = share * (alpha32 * max(s_mean[c], floor) + variance[c]) * (inverse + one / (number[c] + one))
        out[c] = min(max((top - apart * apart / max(level, tiny)) * inverse_span, zero), one)


@inlined
def _followed(out: Array, kept: Array, number: Array, mean: Array, y: Array, recent: Array) -> None:
    """The mean with the new frame where it still holds, else that of the recent frames."""
    one = np.float32(1.0)
    for c in range(len(out)):
        longer = (number[c] * mean[c] + y[c]) / (number[c] + one)
        out[c] = recent[c] + kept[c] * (longer - recent[c])


@inlined
def _counted(out: Array, kept: Array, number: Array, k: int, most: float) -> None:
    one, limit, after = np.float32(1.0), np.float32(most), np.float32(min(k, 2))
    for c in range(len(out)):
        out[c] = after + kept[c] * (min(number[c] + one, limit) - after)


@vectorised
def _step(
    y: Array, before: Array, earlier: Array, k: int, mean: Array, number: Array, variance: Array, alpha: float,
    most: float,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Smoothed mean before frame ``y``, and mean and number of frames after it; ``k`` frames were seen of late.

    One pass: every row is read once, and what its neighbours need of it stays in the cache.
    """
    rows, cols = y.shape
    s_mean, new_mean, new_number = np.empty_like(mean), np.empty_like(mean), np.empty_like(number)
    ring_mean, ring_recent = np.empty((5, cols), mean.dtype), np.empty((5, cols), mean.dtype)
    recents, s_recent, kept = np.empty((5, cols), mean.dtype), np.empty(cols, mean.dtype), np.empty(cols, mean.dtype)
    for r in range(-2, rows):
        ahead = r + 2
        if ahead < rows:
            _along_row(ring_mean[ahead % 5], mean[ahead])
            _mean_of_recent(recents[ahead % 5], y[ahead], before[ahead], earlier[ahead], k)
            _along_row(ring_recent[ahead % 5], recents[ahead % 5])
        if r >= 0:
            _across_rows(s_mean[r], ring_mean, r, rows)
            _across_rows(s_recent, ring_recent, r, rows)
            _believed(kept, s_recent, s_mean[r], number[r], variance[r], alpha, k)
            _followed(new_mean[r], kept, number[r], mean[r], y[r], recents[r % 5])
            _counted(new_number[r], kept, number[r], k, most)
    return s_mean, new_mean, new_number


@vectorised
def _joined(
    past: Array, n_past: Array, s_past: Array, future: Array, n_future: Array, s_future: Array, s_now: Array,
    variance: Array, alpha: float, trust: float,
) -> tuple[Array, float]:  # fmt: skip
    """Mean of past and future by their frames where they agree, and its mean noise variance.

    Where they differ, a change lies just before or just after the frame: the one that the frame, smoothed, looks like
    counts, by the odds of the two. With ``trust`` 0 rather than 1 the frame is not asked, and both count the same.
    """
    rows, cols = past.shape
    out = np.empty_like(past)
    total = 0.0
    for r in range(rows):
        total += _joined_row(
            out[r],
            past[r],
            n_past[r],
            s_past[r],
            future[r],
            n_future[r],
            s_future[r],
            s_now[r],
            variance[r],
            alpha,
            trust,
        )
    return out, total / (rows * cols)


@inlined
def _joined_row(
    out: Array, past: Array, n_past: Array, s_past: Array, future: Array, n_future: Array, s_future: Array,
    s_now: Array, variance: Array, alpha: float, trust: float,
) -> Any:  # fmt: skip
    floor = np.float32(FLOOR * alpha)
    top, inverse_span = np.float32(UNLIKE**2), np.float32(1.0 / (UNLIKE**2 - ALIKE**2))
    alpha32, share, half, tiny = np.float32(alpha), np.float32(SHARE), np.float32(0.5), np.float32(1e-12)
    zero, one, most, step = np.float32(0.0), np.float32(1.0), np.float32(20.0), np.float32(1.0 / 256.0)
    inverse_sum, asked = zero, np.float32(trust)
    for c in range(len(out)):
        n, m, p, f, s, q = n_past[c], n_future[c], past[c], future[c], s_past[c], s_future[c]
        inverse = one / (n + m)
        by_frames = (n * p + m * f) * inverse
        one_frame = max(share * (alpha32 * max((n * s + m * q) * inverse, floor) + variance[c]), tiny)
        apart = s - q
        nearer = asked * apart * (s_now[c] - half * (s + q)) / one_frame
        # exp(-nearer) as a power of 256, which the processor takes of eight columns at once.
        power = one - step * min(max(nearer, -most), most)
        power *= power
        power *= power
        power *= power
        power *= power
        power *= power
        power *= power
        power *= power
        power *= power
        plain = f + (p - f) / (one + power)
        agree = min(max((top - apart * apart * n * m * inverse / one_frame) * inverse_span, zero), one)
        out[c] = plain + agree * (by_frames - plain)
        inverse_sum += inverse
    return inverse_sum


@dataclass
class Walk:
    """What the frames met so far show; ``most`` of them count at most. No array is changed once it is there.

    ``variance`` (y, x) and ``alpha`` are those of their noise.
    """

    variance: Array
    alpha: float
    most: int
    mean: Array | None = None
    number: Array | None = None
    #: The last frames met, the latest first.
    last: tuple[Array, ...] = ()

    def meet(self, y: Array) -> Side | None:
        """What was shown before frame ``y`` (y, x), nothing before the first one; from then on ``y`` counts too."""
        seen = (y, *self.last)[:RECENT]
        self.last = seen[: RECENT - 1]
        if self.mean is None or self.number is None:
            self.mean, self.number = y, np.ones_like(y)
            return None
        before, earlier = seen[min(1, len(seen) - 1)], seen[-1]
        mean, number = self.mean, self.number
        smoothed, self.mean, self.number = _step(
            y, before, earlier, len(seen), mean, number, self.variance, self.alpha, float(self.most)
        )
        return mean, number, smoothed


def past_and_future(
    data: Array | Reel, first: int, stop: int, noise: Noise, most: int, piece: int | None = None
) -> Iterator[tuple[int, Side | None, Side | None]]:
    """For the frames first … stop - 1 of ``data``: what their past and their future show, where they have one.

    ``most`` frames on either side count at most; ``data`` should reach that far. The futures of ``piece`` frames (None:
    of all) are held at once: the walk back through all of them comes first and leaves a mark at the end of each piece,
    from which it is taken up again.
    """
    size = piece or stop - first
    pieces = [(a, min(a + size, stop)) for a in range(first, stop, size)]
    variance = np.ascontiguousarray(np.broadcast_to(noise.variance, data.shape[1:]), np.float32)
    ahead, back = Walk(variance, noise.alpha, most), Walk(variance, noise.alpha, most)
    marks = []
    t = min(data.shape[0], stop + most)
    for _, end in reversed(pieces):
        while t > end:
            t -= 1
            back.meet(data[t])
        marks.append(replace(back))
    for t in range(max(0, first - most), first):
        ahead.meet(data[t])
    for begin, end in pieces:
        back = marks.pop()
        futures = [back.meet(data[t]) for t in range(end - 1, begin - 1, -1)]
        del back
        for t in range(begin, end):
            yield t, ahead.meet(data[t]), futures.pop()


def shown(frame: Array, past: Side | None, future: Side | None, noise: Noise, trust: float) -> tuple[Array, float]:
    """What past and future together show of ``frame``, and its noise variance relative to the frame's.

    ``trust`` 1: where the two differ, the frame says which of them counts; 0: both count the same.
    """
    if past is None or future is None:
        mean, number, _ = past or future or (frame, np.ones_like(frame), frame)
        return mean, float(np.mean(1.0 / number))
    variance = np.ascontiguousarray(np.broadcast_to(noise.variance, frame.shape), np.float32)
    together: tuple[Array, float] = _joined(*past, *future, smooth(frame), variance, noise.alpha, trust)
    return together
