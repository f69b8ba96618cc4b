"""What a table of traces shows without an image: named numbers, the same for measured and simulated tables.

Beside the numbers that the spots of a movie have (`summary`), quantiles of the signal in single frames and in whole
traces, and of differences between successive means over 1, 2, 4 … frames: what W1 at these time scales is made of.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from napari_mufasa.observe import PARTS
from napari_mufasa.observe.summary import telling, trace_kinetics, trace_levels
from napari_mufasa.observe.table import Meaning, Table
from napari_mufasa.traces.dynamics import Dynamics, dynamics

Array = NDArray[np.float64]
RUN = 8  # neighbouring molecules that stay together when the table is split: they often share light
MEANS, STEPS = (0.05, 0.25, 0.5, 0.75, 0.95), (0.05, 0.5, 0.95)  # quantiles


@dataclass(frozen=True)
class Eyes:
    """How a table is looked at, the measured and every simulated one alike: what is taken off each value, and what
    counts as one. Both in photoelectrons per frame."""

    background_e: float
    level_e: float

    @classmethod
    def of(cls, traces: Array, background_subtracted: bool) -> Eyes:
        """For traces (molecule, frame): what is nearly always there is no molecule's."""
        steady = ndimage.uniform_filter1d(traces, 5, axis=1, mode="nearest")
        background = 0.0 if background_subtracted else float(np.quantile(steady, 0.02))
        return cls(background, max(float(np.quantile(steady, 0.9)) - background, 1e-6))


@dataclass(frozen=True)
class TraceNumbers:
    """Observables of a table: (part, observable) values in a fixed order; traces (molecule, frame), photoelectrons, and
    the same seen through the eyes (`light`), and when they are on (`states`)."""

    values: Array
    names: tuple[str, ...]
    meanings: dict[str, Meaning]
    traces: Array
    light: Array
    states: Dynamics

    def molecules(self) -> tuple[Array, Dynamics]:
        """Light (molecule, frame) and dynamics of the molecules whose traces count."""
        seen = telling(self.states)
        return self.light[seen], self.states.of(seen)

    def together(self) -> Array:
        """(frame,) the light of all of them."""
        total: Array = self.light.sum(axis=0)
        return total


def observe_traces(traces: Array, eyes: Eyes) -> TraceNumbers:
    """Observables of traces (molecule, frame), photoelectrons: of all, and of two halves made of runs of neighbours."""
    light = traces - eyes.background_e
    states = dynamics(light)
    side = np.arange(len(traces)) // RUN % 2
    tables = []
    for part in PARTS:
        mine = np.ones(len(light), bool) if part == "all" else side == ("white", "black").index(part)
        seen = mine & telling(states)
        chosen, table = light[mine], Table()
        trace_levels(table, states.of(seen))
        trace_kinetics(table, light[seen], states.of(seen))
        _signal(table, chosen / eyes.level_e)
        _together(table, chosen.mean(axis=0) / eyes.level_e)
        tables.append(table)
    values = np.array([list(table.values.values()) for table in tables])
    return TraceNumbers(values, tuple(tables[0].values), tables[0].meanings, traces, light, states)


def views(traces: Array) -> Iterator[tuple[int, Array, Array]]:
    """Time scale (1, 2, 4 … frames), means over it (molecule, mean), differences of successive means; last the whole
    table, which has no differences."""
    values, scale = np.asarray(traces, dtype=np.float64), 1
    while values.shape[1] >= 2:
        yield scale, values, np.diff(values, axis=1)
        even = values.shape[1] // 2 * 2
        values, scale = values[:, :even].reshape(len(values), -1, 2).mean(axis=2), 2 * scale
    yield np.shape(traces)[1], np.mean(traces, axis=1, keepdims=True), np.zeros((len(values), 0))


def _signal(table: Table, signal: Array) -> None:
    """Quantiles of single frames and of whole traces, and of the change from one stretch to the next at every scale:
    quantiles of means in between would tell the same spread of molecules again and again."""
    for scale, means, steps in views(signal):
        if scale in (1, signal.shape[1]):
            _quantiles(table, f"signal_mean_{scale}", means, MEANS, "means over", scale)
        if steps.shape[1]:
            _quantiles(table, f"signal_step_{scale}", steps, STEPS, "differences of successive means over", scale)


def _quantiles(table: Table, name: str, values: Array, shares: Sequence[float], words: str, scale: int) -> None:
    ordered = np.sort(values, axis=None)
    for share in shares:
        table.add(
            f"{name}_{round(100 * share):02d}", float(ordered[int(share * ordered.size)]),
            f"{share:.0%} quantile of {words} {scale} frames", "level", f"time scale of {scale} frames",
        )  # fmt: skip


def _together(table: Table, course: Array) -> None:
    """What all molecules do together from frame to frame: the light's doing."""
    fast = course - ndimage.uniform_filter1d(course, 31, mode="nearest")
    power = float((fast**2).sum())
    lag = float((fast[1:] * fast[:-1]).sum()) / power if power > 0 else 0.0
    spectrum = np.abs(np.fft.rfft(fast * np.hanning(len(fast))))[1:] ** 2
    line = float(spectrum.max() / max(float(np.median(spectrum)), 1e-12))
    where = "all molecules, frame to frame"
    table.log("common_mode_variance", float(fast.var()), "flicker of all molecules²", where)
    table.add("common_mode_lag", lag, "its correlation with the last frame", "", where)
    table.log("common_mode_line", line, "strongest line / median of its spectrum", where)
