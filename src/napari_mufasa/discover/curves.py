"""Curves a reader sees: measured, base model, completed model, with the spread of simulations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.discover.result import Curve
from napari_mufasa.observe import Observation
from napari_mufasa.observe.lone_traces import TraceNumbers
from napari_mufasa.observe.summary import fluctuation
from napari_mufasa.traces.correlation import autocovariance
from napari_mufasa.traces.dynamics import Dynamics

Array = NDArray[np.float64]
Points = tuple[Array, Array]
One = TypeVar("One")
Spec = tuple[str, str, str, str, Callable[[One], Points]]
POINTS = 40


class Seen(Protocol):
    """What shows the light of molecules: a movie or a table of traces, observed."""

    def molecules(self) -> tuple[Array, Dynamics]: ...
    def together(self) -> Array: ...


def draw(
    measured: Observation, before: Sequence[Observation], after: Sequence[Observation], frame_s: float
) -> list[Curve]:
    """All curves of movies: the measurement, a few simulations of the base and of the completed model."""
    specs: list[Spec[Observation]] = [
        *_of_traces(frame_s),
        ("background_time", "Background", "time (s)", "photoelectrons / pixel", lambda o: _background(o, frame_s)),
        ("common_mode", "Spectrum of the background's flicker", "frequency (1/frame)", "power (rel.)", _spectrum),
        ("common_shift", "Common displacement", "time (s)", "pixels", lambda o: _path(o, frame_s)),
        ("individual_shift", "Own displacement² of spots", "lag (blocks)", "pixels²", _own_motion),
    ]
    return [_curve(spec, measured, before, after) for spec in specs]


def draw_traces(
    measured: TraceNumbers, before: Sequence[TraceNumbers], after: Sequence[TraceNumbers], frame_s: float
) -> list[Curve]:
    """All curves of tables of traces."""
    return [_curve(spec, measured, before, after) for spec in _of_traces(frame_s)]


def _of_traces(frame_s: float) -> list[Spec[Seen]]:
    return [
        ("autocorrelation", "Trace autocovariance", "lag (frames)", "covariance / level²", _autocovariance),
        ("count", "Photoelectrons of a spot per frame", "photoelectrons / level", "density", _counts),
        ("ensemble", "Light of all spots", "time (s)", "light / first tenth", lambda o: _ensemble(o, frame_s)),
        ("survival", "Spots still to be seen", "time (s)", "fraction", lambda o: _survival(o, frame_s)),
        ("level_spread", "Brightness of spots", "photoelectrons per frame", "cumulative fraction", _levels),
    ]


def _curve(spec: Spec[One], measured: One, before: Sequence[One], after: Sequence[One]) -> Curve:
    name, title, x_label, y_label, make = spec
    x, y = make(measured)
    ours = [np.interp(x, *make(o)) for o in before]
    theirs = [np.interp(x, *make(o)) for o in after]
    return Curve(
        name, title, x_label, y_label, x, y,
        np.mean(ours, axis=0), np.std(ours, axis=0), np.mean(theirs, axis=0), np.std(theirs, axis=0),
    )  # fmt: skip


def _autocovariance(seen: Seen) -> Points:
    light, states = seen.molecules()
    frames = light.shape[1]
    lags = np.unique(np.round(np.geomspace(1, max(2, frames // 4), 16)).astype(int))
    return lags.astype(float), np.nan_to_num(autocovariance(*fluctuation(light, states), lags))


def _counts(seen: Seen) -> Points:
    light, states = seen.molecules()
    edges = np.linspace(-0.8, 3.2, POINTS + 1)
    density = (
        np.histogram(light / np.median(states.on_level), edges, density=True)[0] if len(light) else np.zeros(POINTS)
    )
    return (edges[1:] + edges[:-1]) / 2, np.nan_to_num(density)


def _binned(values: Array, frame_s: float) -> Points:
    n = min(POINTS, len(values))
    edges = np.linspace(0, len(values), n + 1).astype(int)
    y = np.add.reduceat(values, edges[:-1]) / np.diff(edges)
    return (edges[:-1] + edges[1:]) / 2 * frame_s, y


def _ensemble(seen: Seen, frame_s: float) -> Points:
    total = seen.together()
    first = total[: max(1, len(total) // 10)].mean()
    return _binned(total / max(float(first), 1e-9), frame_s)


def _survival(seen: Seen, frame_s: float) -> Points:
    light, states = seen.molecules()
    t = np.linspace(0, light.shape[1], POINTS)
    return t * frame_s, np.array([(states.last >= at).mean() if states.last.size else 0.0 for at in t])


def _levels(seen: Seen) -> Points:
    level = np.sort(seen.molecules()[1].on_level)
    if not level.size:
        return np.linspace(0, 1, POINTS), np.zeros(POINTS)
    x = np.linspace(0, 2.5 * np.median(level), POINTS)
    return x, np.searchsorted(level, x) / len(level)


def _background(observation: Observation, frame_s: float) -> tuple[Array, Array]:
    return _binned(observation.course, frame_s)


def _spectrum(observation: Observation) -> Points:
    course = observation.course / max(float(observation.course.mean()), 1e-9) - 1
    power = np.abs(np.fft.rfft(course * np.hanning(len(course))))[1:] ** 2 / len(course)
    return np.asarray(np.fft.rfftfreq(len(course))[1:], dtype=np.float64), power


def _path(observation: Observation, frame_s: float) -> tuple[Array, Array]:
    path = observation.spots.path_px
    n = observation.spots.light.shape[1]
    return (np.arange(len(path)) + 0.5) * n / len(path) * frame_s, np.hypot(*path.T)


def _own_motion(observation: Observation) -> tuple[Array, Array]:
    spots = observation.spots
    moved = spots.displacement_px[spots.inside & spots.isolated]
    lags = np.arange(1, max(2, moved.shape[1] - 1))
    y = []
    for k in lags:
        steps = ((moved[:, k:] - moved[:, :-k]) ** 2).sum(axis=2)
        y.append(float(steps[np.isfinite(steps)].mean()) if np.isfinite(steps).any() else 0.0)
    return lags.astype(float), np.array(y)
