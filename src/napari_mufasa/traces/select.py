"""Which candidates are single molecules worth keeping; every rejected one keeps its reason (SPEC.md §6)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.traces.steps import Steps, idealise

if TYPE_CHECKING:
    import pandas as pd

LIT = 0.3  # a frame is lit where the idealised trace is above this share of the on level (one of three molecules)
ON = 0.5  # segments above this share of the highest one make up the on level
LEAST_PROMINENCE = 0.2  # of a peak in every direction; isolated spots have 0.3 … 0.7, edges 0.1 ± 0.06
STEP = 0.3  # a drop counts as a bleaching step when it takes this share of the first level


@dataclass(frozen=True)
class Dynamics:
    """What a trace shows, one entry per trace; frames are indices, -1 where there is none.

    on_level, noise, snr : photoelectrons; noise is the sd per frame while lit; snr their ratio
    lit : (trace, frame) whether the idealised trace is on
    bleaching_frame : first frame after which the trace stays dark until the end
    n_steps : bleaching steps (drops of the level that are never recovered)
    n_blinks : dark intervals followed by light
    """

    on_level: NDArray[np.float64]
    noise: NDArray[np.float64]
    snr: NDArray[np.float64]
    lit: NDArray[np.bool_]
    bleaching_frame: NDArray[np.int64]
    n_steps: NDArray[np.int64]
    n_blinks: NDArray[np.int64]


def dynamics(traces: NDArray[np.floating], false_alarm_rate: float = 0.01) -> Dynamics:
    """Levels, steps and bleaching of background-subtracted traces (trace, frame)."""
    n, n_frames = traces.shape
    steps = idealise(traces, false_alarm_rate)
    on_level, noise = np.zeros(n), np.zeros(n)
    lit = np.zeros((n, n_frames), dtype=bool)
    bleaching, n_steps, n_blinks = np.full(n, -1), np.zeros(n, np.int64), np.zeros(n, np.int64)
    for i, step in enumerate(steps):
        ideal = step.idealised
        noise[i] = _noise(traces[i], ideal)
        on_level[i] = _on_level(step, traces[i])
        lit[i] = (ideal > LIT * on_level[i]) & (ideal > noise[i] / np.sqrt(n_frames))
        if lit[i].any():
            last = int(np.flatnonzero(lit[i])[-1])
            if last < n_frames - 1:
                bleaching[i] = last + 1
            n_blinks[i] = np.count_nonzero(np.diff(lit[i].astype(np.int8)) == 1) - (not lit[i, : last + 1][0])
            n_steps[i] = _bleaching_steps(step, on_level[i])
    snr = np.divide(on_level, noise, out=np.zeros(n), where=noise > 0)
    return Dynamics(on_level, noise, snr, lit, bleaching.astype(np.int64), n_steps, n_blinks)


def _noise(trace: NDArray[np.floating], ideal: NDArray[np.float64]) -> float:
    """Sd per frame about the steps (robust against steps missed)."""
    return float(np.std(trace - ideal))


def _on_level(step: Steps, trace: NDArray[np.floating]) -> float:
    """Mean level of the lit segments: those above half of the highest well-supported one."""
    lengths = np.diff(np.append(step.starts, step.n_frames))
    long = lengths >= min(5, lengths.max())
    highest = float(step.levels[long].max())
    if highest <= 0:
        return 0.0
    up = step.levels > ON * highest
    return float(np.average(step.levels[up], weights=lengths[up]))


def _bleaching_steps(step: Steps, on_level: float) -> int:
    """Drops of the highest level still to come: blinking does not count, two molecules bleaching do."""
    future = np.maximum.accumulate(step.levels[::-1])[::-1]
    future = np.append(future, 0.0) if future[-1] <= LIT * on_level else future
    levels = [future[0]]
    for level in future[1:]:  # merge small drifts of level into one plateau
        if levels[-1] - level > STEP * on_level:
            levels.append(level)
    return len(levels) - 1


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Which molecules are wanted. Levels in photoelectrons, None switches a rule off.

    min_snr : on level over noise per frame; min_brightness_e : smallest on level
    min_lit_frames, max_lit_share : never on; always on (1 keeps molecules that never go dark)
    min_steps, max_steps : bleaching steps; width : narrowest axis allowed relative to the PSF, and widest
        relative to the usual spot of this movie
    window : frames just before bleaching that must be lit; best : how many of the best to keep
    """

    min_snr: float = 1.0
    min_brightness_e: float | None = None
    min_lit_frames: int = 3
    max_lit_share: float = 1.0
    min_steps: int | None = None
    max_steps: int | None = None
    width: tuple[float, float] | None = (0.6, 1.3)
    window: int | None = None
    best: int | None = None


@dataclass(frozen=True, kw_only=True)
class Rules(Choice):
    """What is kept. border_px : distance from the edge; isolation_px : distance to the nearest other candidate."""

    border_px: float
    isolation_px: float


def windows(dyn: Dynamics, window: int, min_share: float = 0.9) -> NDArray[np.int64]:
    """First frame of the `window` frames before bleaching (or the movie's end) in which each trace is active.

    Active: lit in `min_share` of the frames. -1 where there is no such window.
    """
    n, n_frames = dyn.lit.shape
    end = np.where(dyn.bleaching_frame >= 0, dyn.bleaching_frame, n_frames)
    start = end - window
    result = np.full(n, -1, dtype=np.int64)
    for i in np.flatnonzero(start >= 0):
        if dyn.lit[i, start[i] : end[i]].mean() >= min_share:
            result[i] = start[i]
    return result


def usual_width(sigma_major_px: NDArray[np.float64], sigma_px: float) -> float:
    """Width of the usual spot: the median candidate, since the PSF is never known to the percent.

    At most 1.3 times the PSF, so that a crowded field does not make overlap usual.
    """
    if len(sigma_major_px) < 10:
        return 1.05 * sigma_px
    return float(np.clip(np.median(sigma_major_px), sigma_px, 1.3 * sigma_px))


def judge(table: pd.DataFrame, rules: Rules, shape: tuple[int, int, int], sigma_px: float) -> None:
    """Fill `kept` and `reason` of the molecule table; the first rule broken is the reason."""
    reason = np.full(len(table), "", dtype=object)

    def reject(broken: NDArray[np.bool_], text: object) -> None:
        texts = np.broadcast_to(np.asarray(text, dtype=object), broken.shape)
        new = broken & (reason == "")
        reason[new] = texts[new]

    def column(name: str) -> NDArray[np.float64]:
        return np.asarray(table[name], dtype=np.float64)

    y, x = column("y_px"), column("x_px")
    edge = np.minimum.reduce([y + 0.5, x + 0.5, shape[1] - 0.5 - y, shape[2] - 0.5 - x])
    reject(~table["in_roi"].to_numpy(dtype=bool), "outside the region of interest")
    reject(edge < rules.border_px, "border")
    reject(column("prominence") < LEAST_PROMINENCE, "edge or line, no spot")
    near = column("neighbour_px")
    reject(near < rules.isolation_px, [f"neighbour at {d:.1f} px" for d in near])
    lit = column("lit_frames")
    reject(lit < rules.min_lit_frames, "never on")
    snr = column("snr")
    reject(snr < rules.min_snr, [f"SNR {s:.2f} below {rules.min_snr:g}" for s in snr])
    if rules.min_brightness_e is not None:
        reject(column("brightness") < rules.min_brightness_e, f"dimmer than {rules.min_brightness_e:g} e")
    if rules.width is not None:
        narrow, wide = rules.width
        minor, major = column("sigma_minor_px"), column("sigma_major_px")
        usual = usual_width(major, sigma_px)
        reject(minor < narrow * sigma_px, "narrower than the PSF")
        reject(major > wide * usual, "wider than the PSF")
    reject(lit > rules.max_lit_share * shape[0], "always on")
    steps = column("n_steps")
    if rules.max_steps is not None:
        reject(steps > rules.max_steps, [f"{int(s)} bleaching steps" for s in steps])
    if rules.min_steps is not None:
        reject(steps < rules.min_steps, "no bleaching" if rules.min_steps == 1 else "too few bleaching steps")
    if rules.window is not None:
        reject(column("window_start") < 0, f"no {rules.window} active frames before bleaching")
    if rules.best is not None:
        order = np.argsort(-np.where(reason == "", snr, -np.inf), kind="stable")
        worse = np.ones(len(table), dtype=bool)
        worse[order[: rules.best]] = False
        reject(worse, f"not among the {rules.best} best")
    table["kept"] = reason == ""
    table["reason"] = reason
