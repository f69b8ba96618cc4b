"""When a trace is on and off, how bright, and how it ends: the one classification, from its steps (docs/traces.md).

Traces that a user sees and the numbers that a diagnosis compares both rest on it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.traces.steps import Steps, idealise

LIT = 0.3  # a frame is lit where the idealised trace is above this share of the on level (one of three molecules)
ON = 0.5  # segments above this share of the highest one make up the on level
STEP = 0.3  # a drop counts as a bleaching step when it takes this share of the first level
SUPPORTED = 5  # frames that a segment needs to say what the highest level is, where one of the trace has as many
LEAST_FALLEN, FALLEN_BY_CHANCE = 5, 1e-3  # traces that tell the dark level; of so many where none has a step
DARK_QUANTILE = 0.25  # of their lowest levels: some never go dark, a second molecule shines on or the first is dimmed
AGREE_SD, AGREE = 2.0, 0.75  # standard errors, and the share of lowest levels that agree within them: 0.95 in darkness
TREND_SD = 3.0  # standard errors by which those levels go on to fall or rise: by chance 3 in 1000
WIDE, NARROW = 0.2, 0.5  # on levels that scatter by so much of the fall; the lowest by so much of the scatter of those
STAY_SD = 3.0  # standard errors within which a trace without a step is at the dark level
# As many of those beside the traces that fall there: never lit; where light comes back, level switching has more.
MOST_STAY, MOST_STAY_BLINKING, COME_BACK = 1.0, 0.2, 0.1


@dataclass(frozen=True)
class Dynamics:
    """What a trace shows, one entry per trace; frames are indices, -1 where there is none.

    on_level, noise, snr : photoelectrons; noise is the sd per frame about the steps; snr their ratio
    lit : (trace, frame) whether the idealised trace is on
    first, last : first and last lit frame
    bleaching_frame : first frame after which the trace stays dark until the end
    n_steps : bleaching steps (drops of the level that are never recovered)
    n_blinks : dark intervals followed by light
    """

    on_level: NDArray[np.float64]
    noise: NDArray[np.float64]
    snr: NDArray[np.float64]
    lit: NDArray[np.bool_]
    first: NDArray[np.int64]
    last: NDArray[np.int64]
    bleaching_frame: NDArray[np.int64]
    n_steps: NDArray[np.int64]
    n_blinks: NDArray[np.int64]

    def of(self, rows: NDArray[np.bool_] | NDArray[np.integer]) -> Dynamics:
        """Those of some of the traces."""
        return Dynamics(**{name: values[rows] for name, values in vars(self).items()})


def dynamics(traces: NDArray[np.floating], false_alarm_rate: float = 0.01) -> Dynamics:
    """Levels, steps and bleaching of background-subtracted traces (trace, frame)."""
    n, n_frames = traces.shape
    steps = idealise(traces, false_alarm_rate)
    if n == 0:
        none, no = np.empty(0), np.empty(0, np.int64)
        return Dynamics(none, none, none, np.empty((0, n_frames), bool), no, no, no, no, no)
    lengths = np.concatenate([step.lengths for step in steps])
    levels = np.concatenate([step.levels for step in steps])
    ideal = np.repeat(levels, lengths).reshape(n, n_frames)
    noise = np.std(traces - ideal, axis=1)
    on_level = _on_level(steps, lengths, levels)
    lit = (ideal > LIT * on_level[:, None]) & (ideal > noise[:, None] / np.sqrt(n_frames))
    shines = lit.any(axis=1)
    first = np.where(shines, np.argmax(lit, axis=1), -1)
    last = np.where(shines, n_frames - 1 - np.argmax(lit[:, ::-1], axis=1), -1)
    rises = np.count_nonzero(lit[:, 1:] & ~lit[:, :-1], axis=1)
    n_steps = np.array(
        [_bleaching_steps(s, level) if on else 0 for s, level, on in zip(steps, on_level, shines, strict=True)]
    )
    return Dynamics(
        on_level=on_level,
        noise=noise,
        snr=np.divide(on_level, noise, out=np.zeros(n), where=noise > 0),
        lit=lit,
        first=first,
        last=last,
        bleaching_frame=np.where(shines & (last < n_frames - 1), last + 1, -1),
        n_steps=n_steps,
        n_blinks=np.where(shines, rises - (first > 0), 0),
    )


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


def _on_level(steps: list[Steps], lengths: NDArray[np.int64], levels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean level of the lit segments of each trace: those above half of the highest well-supported one."""
    counts = np.array([len(step.starts) for step in steps])
    begins = np.concatenate([[0], np.cumsum(counts)[:-1]])
    longest = np.repeat(np.maximum.reduceat(lengths, begins), counts)
    supported = np.where(lengths >= np.minimum(SUPPORTED, longest), levels, -np.inf)
    highest = np.maximum.reduceat(supported, begins)
    up = lengths * (levels > ON * np.repeat(highest, counts))
    weight = np.maximum(np.add.reduceat(up, begins), 1)
    return np.asarray(np.where(highest > 0, np.add.reduceat(up * levels, begins) / weight, 0.0))


def _bleaching_steps(step: Steps, on_level: float) -> int:
    """Drops of the highest level still to come: blinking does not count, two molecules bleaching do."""
    if len(step.levels) == 1:
        return 0
    future = np.maximum.accumulate(step.levels[::-1])[::-1]
    future = np.append(future, 0.0) if future[-1] <= LIT * on_level else future
    levels = [future[0]]
    for level in future[1:]:  # merge small drifts of level into one plateau
        if levels[-1] - level > STEP * on_level:
            levels.append(level)
    return len(levels) - 1
