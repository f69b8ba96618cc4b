"""What a comparison shows beside one number: distributions of measured and simulated traces (docs/comparison.md)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.traces.correlation import autocovariance
from napari_mufasa.traces.dynamics import Dynamics

MAX_LAG = 50  # frames
SHOWN = (0.2, 99.5)  # per cent of all values: one bright molecule does not squeeze the others into a bin


@dataclass(frozen=True)
class Distribution:
    """One curve, measured and simulated on the same x. `curves` maps a model's name to (x,) values."""

    name: str
    x: NDArray[np.float64]
    x_label: str
    y_label: str
    curves: dict[str, NDArray[np.float64]]

    def as_dict(self) -> dict[str, Any]:
        curves = {name: values.tolist() for name, values in self.curves.items()}
        return {"x": self.x.tolist(), "x_label": self.x_label, "y_label": self.y_label, **curves}


@dataclass(frozen=True)
class Sample:
    """Traces (molecule, frame) of one origin with what they show; rows agree."""

    traces: NDArray[np.floating]
    dynamics: Dynamics


def distributions(samples: dict[str, Sample], unit: str, interval_s: float = 1.0) -> dict[str, Distribution]:
    """All distributions of the named samples ("measured" first), each on one common x axis.

    counts (density), autocorrelation (of lit frames), on_times and off_times (share of intervals longer
    than t), survival (share not yet bleached), levels (density of on levels).
    """
    counts = {name: s.traces.ravel() for name, s in samples.items()}
    levels = {name: s.dynamics.on_level for name, s in samples.items()}
    n_frames = max(s.traces.shape[1] for s in samples.values())
    lags = np.arange(min(MAX_LAG, n_frames - 1) + 1)
    frames = np.arange(n_frames)
    result = [
        _histograms("counts", counts, f"signal per frame ({unit})"),
        Distribution(
            "autocorrelation", lags * interval_s, "lag (s)", "autocorrelation",
            {name: until_bleaching(s, len(lags)) for name, s in samples.items()},
        ),
        Distribution(
            "on_times", frames * interval_s, "on time (s)", "share longer",
            {name: _longer(dwell_frames(s.dynamics.lit, True), n_frames) for name, s in samples.items()},
        ),
        Distribution(
            "off_times", frames * interval_s, "off time (s)", "share longer",
            {name: _longer(dwell_frames(s.dynamics.lit, False), n_frames) for name, s in samples.items()},
        ),
        Distribution(
            "survival", frames * interval_s, "time (s)", "share not bleached",
            {name: survival(s.dynamics, n_frames) for name, s in samples.items()},
        ),
        _histograms("levels", levels, f"on level ({unit})"),
    ]  # fmt: skip
    return {d.name: d for d in result}


def until_bleaching(sample: Sample, n_lags: int) -> NDArray[np.float64]:
    """Autocorrelation of the traces until bleaching at lags 0 … n_lags − 1, weighted by their length.

    Each trace's mean is taken off; the bias this makes (−1/T) is the same in measurement and simulation.
    """
    traces = np.asarray(sample.traces, dtype=np.float64)
    n_frames = traces.shape[1]
    ends = np.where(sample.dynamics.bleaching_frame >= 0, sample.dynamics.bleaching_frame, n_frames)
    lit = np.arange(n_frames) < ends[:, None]
    length = np.maximum(ends, 1)[:, None]
    about = np.where(lit, traces - np.where(lit, traces, 0.0).sum(axis=1, keepdims=True) / length, 0.0)
    sd = np.sqrt((about**2).sum(axis=1, keepdims=True) / length)
    usable = (ends >= 3) & (sd[:, 0] > 0)
    inside = lit[usable]
    return autocovariance(about[usable] / sd[usable], inside, range(n_lags))


def dwell_frames(lit: NDArray[np.bool_], state: bool) -> NDArray[np.int64]:
    """Lengths in frames of complete intervals in a state (both ends seen); (interval,)."""
    found = []
    for row in lit:
        edges = np.flatnonzero(np.diff(row.astype(np.int8))) + 1
        if len(edges) >= 2:
            lengths, values = np.diff(edges), row[edges[:-1]]
            found.append(lengths[values == state])
    return np.concatenate(found).astype(np.int64) if found else np.empty(0, np.int64)


def survival(dynamics: Dynamics, n_frames: int) -> NDArray[np.float64]:
    """Share of molecules not bleached in each frame, of those that shone: of others nobody knows whether they had."""
    bleached = dynamics.bleaching_frame[dynamics.first >= 0]
    end = np.where(bleached >= 0, bleached, n_frames + 1)
    return np.asarray((end[:, None] > np.arange(n_frames)).mean(axis=0)) if len(end) else np.full(n_frames, np.nan)


def _longer(lengths: NDArray[np.int64], n_frames: int) -> NDArray[np.float64]:
    if len(lengths) == 0:
        return np.full(n_frames, np.nan)
    return np.asarray((lengths[:, None] > np.arange(n_frames)).mean(axis=0))


def _histograms(name: str, values: Mapping[str, NDArray[np.floating]], x_label: str) -> Distribution:
    together = np.concatenate([v for v in values.values() if len(v)])
    low, high = np.percentile(together, SHOWN)
    first = next(iter(values.values()))
    n_bins = int(np.clip(2 * len(first) ** (1 / 3), 10, 80))  # Rice's rule on the measurement
    edges = np.linspace(low, high if high > low else low + 1.0, n_bins + 1)
    width = edges[1] - edges[0]
    curves = {k: np.histogram(v, edges)[0] / max(len(v), 1) / width for k, v in values.items()}
    return Distribution(name, (edges[:-1] + edges[1:]) / 2, x_label, "density", curves)
