"""Which candidates are single molecules worth keeping; every rejected one keeps its reason (docs/traces.md)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.spots.find import LEAST_PROMINENCE
from napari_mufasa.traces.dynamics import Dynamics

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Which molecules are wanted. Levels in photoelectrons, None switches a rule off.

    min_snr : on level over noise per frame; min_brightness_e : smallest on level
    min_lit_frames, max_lit_share : never on (of a shorter movie all frames); always on (1 keeps molecules that never
        go dark)
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


def judge(
    table: pd.DataFrame, rules: Rules, shape: tuple[int, int, int], sigma_px: float, edge_px: NDArray[np.float64],
    lost: NDArray[np.bool_] | None = None,
) -> None:  # fmt: skip
    """Fill `kept` and `reason` of the molecule table; the first rule broken is the reason.

    edge_px : (candidate,) how near each comes to the edge of the field; lost : which leave the acceptor's channel
    """
    reason = np.full(len(table), "", dtype=object)

    def reject(broken: NDArray[np.bool_], text: object) -> None:
        texts = np.broadcast_to(np.asarray(text, dtype=object), broken.shape)
        new = broken & (reason == "")
        reason[new] = texts[new]

    def column(name: str) -> NDArray[np.float64]:
        return np.asarray(table[name], dtype=np.float64)

    reject(~table["in_roi"].to_numpy(dtype=bool), "outside the region of interest")
    reject(edge_px < rules.border_px, "border")
    if lost is not None:
        reject(lost, "outside the acceptor's channel")
    reject(column("prominence") < LEAST_PROMINENCE, "edge or line, no spot")
    near = column("neighbour_px")
    reject(near < rules.isolation_px, [f"neighbour at {d:.1f} px" for d in near])
    lit = column("lit_frames")
    reject(lit < min(rules.min_lit_frames, shape[0]), "never on")
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
        order = np.argsort(-np.where(reason == "", np.nan_to_num(snr), -np.inf), kind="stable")
        worse = np.ones(len(table), dtype=bool)
        worse[order[: rules.best]] = False
        reject(worse, f"not among the {rules.best} best")
    table["kept"] = reason == ""
    table["reason"] = reason
