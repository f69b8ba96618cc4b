"""Whether frames that should be dark are: light in them would be taken off the movie as if it were the baseline."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

FRAMES = 16  # of each that are looked at, spread evenly
SMOOTH_PX = 9  # wider structure is the camera's own: glow, tilted offsets
ALARM_SD = 6.0  # of a correlation that is normal without light: a false alarm in 10⁹


def light_in_dark(movie: Any, dark: Any) -> str | None:
    """What speaks for light in the dark frames, as a sentence; None where nothing does. Both (frame, y, x), in ADU.

    They are brighter than the movie, or show what the movie shows. A camera's own patterns do not count: pixels, rows
    and columns of one colour are seen in both, so each pixel is compared with its neighbours along the diagonals only,
    where light is nearly the same and patterns are not.
    """
    lit, unlit = _mean(movie), _mean(dark)
    if unlit.mean() > lit.mean():
        return (
            f"the dark frames are brighter than the movie ({unlit.mean():.6g} and {lit.mean():.6g} ADU): is there "
            "light in them, or are they of other settings?"
        )
    if min(lit.shape) < 2 * SMOOTH_PX:
        return None
    a, b = _fine(lit), _fine(unlit)
    alike = float(np.mean([_correlation(x, y) for x, y in _diagonals(a, b)]))
    if alike * np.sqrt(b.size) > ALARM_SD:
        return f"the dark frames show what the movie shows (correlation {alike:.2f}): is there light in them?"
    return None


def share_shown(before: Any, beside: Any, after: Any) -> tuple[float, float]:
    """How much of what they show is common to frames `before` and `beside` is in those `after`, and its sd: 1 where the
    light stays, 0 without light; infinitely unsure where they show nothing. Of bright things it is too much rather than
    too little (`_fine`)."""
    a, b, c = (_fine(_mean(part)) for part in (before, beside, after))
    if min(a.shape) < 2 * SMOOTH_PX:
        return 0.0, np.inf
    common, left = (float(np.mean([np.mean(x * y) for x, y in _diagonals(a, other)])) for other in (b, c))
    if common <= ALARM_SD * float(a.std() * b.std()) / np.sqrt(a.size):
        return 0.0, np.inf
    return left / common, float(a.std() * c.std()) / np.sqrt(a.size) / common


def _diagonals(a: NDArray[np.float64], b: NDArray[np.float64]) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Each pixel of one image beside its neighbours along the diagonals in the other."""
    return [(a[1:, 1:], b[:-1, :-1]), (a[:-1, :-1], b[1:, 1:]), (a[1:, :-1], b[:-1, 1:]), (a[:-1, 1:], b[1:, :-1])]


def _mean(stack: Any) -> NDArray[np.float64]:
    """(y, x) mean of some frames."""
    if len(stack.shape) == 2:
        return np.asarray(stack, np.float64)
    chosen = np.unique(np.linspace(0, stack.shape[0] - 1, FRAMES).astype(int))
    total = np.zeros(stack.shape[1:])
    for t in chosen:
        total += np.asarray(stack[int(t) : int(t) + 1])[0]
    return total / len(chosen)


def _fine(image: NDArray[np.float64]) -> NDArray[np.float64]:
    from scipy.ndimage import uniform_filter

    for _ in range(2):  # hot pixels would outweigh all others, and by what they add to a smooth image their neighbours
        smooth = uniform_filter(image, SMOOTH_PX)
        fine = image - smooth
        most = 6 * 1.4826 * np.median(np.abs(fine - np.median(fine)))
        fine = np.clip(fine, -most, most) if most > 0 else fine
        image = smooth + fine
    return np.asarray(fine)


def _correlation(x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    sd = float(x.std() * y.std())
    return float(np.mean((x - x.mean()) * (y - y.mean()))) / sd if sd > 0 else 0.0
