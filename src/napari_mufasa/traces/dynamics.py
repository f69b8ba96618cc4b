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


@dataclass(frozen=True)
class Dynamics:
    """What a trace shows, one entry per trace; frames are indices, -1 where there is none.

    on_level, noise, snr : photoelectrons; noise is the sd per frame about the steps; snr their ratio,
        nan of one frame
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
    on_level = _on_level(steps, lengths, levels, noise)
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
        snr=np.divide(on_level, noise, out=np.full(n, 0.0 if n_frames > 1 else np.nan), where=noise > 0),
        lit=lit,
        first=first,
        last=last,
        bleaching_frame=np.where(shines & (last < n_frames - 1), last + 1, -1),
        n_steps=n_steps,
        n_blinks=np.where(shines, rises - (first > 0), 0),
    )


def _on_level(
    steps: list[Steps], lengths: NDArray[np.int64], levels: NDArray[np.float64], noise: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Mean level of the lit segments of each trace: those above half of the highest well-supported one, or, where none
    of these is brighter than the noise of a frame, of the highest."""
    counts = np.array([len(step.starts) for step in steps])
    begins = np.concatenate([[0], np.cumsum(counts)[:-1]])
    longest = np.repeat(np.maximum.reduceat(lengths, begins), counts)
    supported = np.where(lengths >= np.minimum(SUPPORTED, longest), levels, -np.inf)
    highest = np.maximum.reduceat(supported, begins)
    highest = np.where(highest > noise, highest, np.maximum.reduceat(levels, begins))
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
