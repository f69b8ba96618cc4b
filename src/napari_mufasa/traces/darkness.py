"""What traces that hold their background fall to where their molecules go dark."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.traces.dynamics import SUPPORTED
from napari_mufasa.traces.steps import Steps, idealise

LEAST_FALLEN, FALLEN_BY_CHANCE = 5, 1e-3  # traces that tell the dark level; of so many where none has a step
DARK_QUANTILE = 0.25  # of their lowest levels: some never go dark, a second molecule shines on or the first is dimmed
AGREE_SD, AGREE = 2.0, 0.75  # standard errors, and the share of lowest levels that agree within them: 0.95 in darkness
TREND_SD = 3.0  # standard errors by which those levels go on to fall or rise: by chance 3 in 1000
WIDE, NARROW = 0.2, 0.5  # on levels that scatter by so much of the fall; the lowest by so much of the scatter of those
STAY_SD = 3.0  # standard errors within which a trace without a step is at the dark level
# As many of those beside the traces that fall there: never lit; where light comes back, level switching has more.
MOST_STAY, MOST_STAY_BLINKING, COME_BACK = 1.0, 0.2, 0.1


def dark_level(traces: NDArray[np.floating], false_alarm_rate: float = 0.01) -> float | None:
    """The level, in the traces' unit, that traces (trace, frame) fall to where their molecules bleach or blink: the
    background that they hold. None where too few fall, or not into darkness, as the light of a drifting laser or of
    molecules of several levels.

    Darkness is common to all, dimness goes with each molecule's own brightness: the lowest levels agree within their
    standard errors and stay what they are, or scatter little beside on levels that scatter widely (the background is
    not the same all over); and few traces stay at that level all along, as single molecules do at what pairs fall to
    when one of them bleaches.
    """
    from scipy.stats import binom

    fallen, steady = _fallen(traces, idealise(traces, false_alarm_rate))
    if len(fallen.lowest) < max(LEAST_FALLEN, binom.isf(FALLEN_BY_CHANCE, len(traces), false_alarm_rate) + 1):
        return None
    dark = float(np.quantile(fallen.lowest, DARK_QUANTILE))
    noise = max(float(np.median(fallen.noise)), 1e-6 * abs(dark))  # none, where a camera is saturated
    errors = noise / np.sqrt(fallen.frames)
    there = np.abs(fallen.lowest - dark) <= AGREE_SD * errors
    dark = float(np.median(fallen.lowest[there])) if there.any() else dark
    there = np.abs(fallen.lowest - dark) <= AGREE_SD * errors
    scatter, of_on = _scatter(fallen.lowest, errors), _scatter(fallen.highest, fallen.highest_errors)
    n = max(int(there.sum()), 1)
    agree = there.mean() >= AGREE and abs(fallen.trend[there].sum()) <= TREND_SD * noise * np.sqrt(n)
    beside_on = of_on >= WIDE * (np.median(fallen.highest) - dark) and scatter <= NARROW * of_on
    if not (agree or beside_on):
        return None
    stay = np.count_nonzero(np.abs(steady - dark) < STAY_SD * np.hypot(noise / np.sqrt(traces.shape[1]), scatter))
    comes_back = fallen.comes_back[there].sum() > COME_BACK * n
    return None if stay > (MOST_STAY_BLINKING if comes_back else MOST_STAY) * n else dark


@dataclass(frozen=True)
class _Fallen:
    """Of each trace with a step: its lowest and its highest level, what they are known to, how the lowest goes on
    (`_trend`), and whether light comes back after it."""

    lowest: NDArray[np.float64]
    frames: NDArray[np.float64]  # of the lowest level
    noise: NDArray[np.float64]  # in them
    highest: NDArray[np.float64]
    highest_errors: NDArray[np.float64]
    trend: NDArray[np.float64]
    comes_back: NDArray[np.float64]


def _fallen(traces: NDArray[np.floating], steps: list[Steps]) -> tuple[_Fallen, NDArray[np.float64]]:
    """The traces that have well-supported levels of different heights, and the means of the others."""
    rows, steady = [], []
    for trace, step in zip(traces, steps, strict=True):
        of = np.flatnonzero(step.lengths >= min(SUPPORTED, step.lengths.max()))
        if len(of) < 2:
            steady.append(float(np.mean(trace)))
            continue
        low, high = of[np.argmin(step.levels[of])], of[np.argmax(step.levels[of])]
        noise = [
            float(np.std(trace[step.starts[i] : step.starts[i] + step.lengths[i]], ddof=int(step.lengths[i] > 1)))
            for i in (low, high)
        ]
        rows.append(
            (
                step.levels[low], step.lengths[low], noise[0], step.levels[high],
                noise[1] / np.sqrt(step.lengths[high]),
                _trend(trace[step.starts[low] : step.starts[low] + step.lengths[low]]), low < len(step.levels) - 1,
            )
        )  # fmt: skip
    return _Fallen(*np.array(rows, dtype=np.float64).reshape(-1, 7).T), np.array(steady)


def _trend(frames: NDArray[np.floating]) -> float:
    """Second half less first half of a level's frames but the outer ones, which may be lit in part, scaled to the noise
    of a frame."""
    half = (len(frames) - 2) // 2
    if half < 1:
        return 0.0
    return float(np.sqrt(half / 2) * (np.mean(frames[-1 - half : -1]) - np.mean(frames[1 : 1 + half])))


def _scatter(levels: NDArray[np.float64], errors: NDArray[np.float64]) -> float:
    """Standard deviation of levels beyond their errors, by their quartiles."""
    low, high = np.quantile(levels, [0.25, 0.75])
    return float(np.sqrt(max(((high - low) / 1.349) ** 2 - np.median(errors) ** 2, 0.0)))
