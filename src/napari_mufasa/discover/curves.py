"""Curves a reader sees: measured, base model, completed model, with the spread of simulations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.discover.result import Curve
from napari_mufasa.observe import Observation
from napari_mufasa.observe.lone_traces import TraceNumbers
from napari_mufasa.observe.summary import OnStates

Array = NDArray[np.float64]
POINTS = 40


Seen = TypeVar("Seen")
Points = tuple[Array, Array]
Spec = tuple[str, str, str, str, Callable[[Seen], Points]]  # name, title, axes, and how to make it


def draw(
    measured: Observation, before: Sequence[Observation], after: Sequence[Observation], frame_s: float
) -> list[Curve]:
    """All curves of movies, from the measurement and a few simulations of the base and of the completed model."""
    specs: list[Spec[Observation]] = [
        *_of_traces(lambda o: o.spots.light[o.spots.inside & o.spots.isolated], _all_light, frame_s),
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
    return [_curve(spec, measured, before, after) for spec in _of_traces(_light, _light, frame_s)]


def _of_traces(lone: Callable[[Seen], Array], every: Callable[[Seen], Array], frame_s: float) -> list[Spec[Seen]]:
    """What the light (molecule, frame) of `lone` molecules, and of all of them, shows."""

    def states(seen: Seen) -> OnStates:
        return OnStates.of(lone(seen))

    return [
        (
            "autocorrelation", "Trace autocovariance", "lag (frames)", "covariance / level²",
            lambda seen: _autocovariance(states(seen)),
        ),
        (
            "count", "Photoelectrons of a spot per frame", "photoelectrons / level", "density",
            lambda seen: _counts(states(seen)),
        ),
        (
            "ensemble", "Light of all spots", "time (s)", "light / first tenth",
            lambda seen: _ensemble(every(seen).sum(axis=0), frame_s),
        ),
        ("survival", "Spots still to be seen", "time (s)", "fraction", lambda seen: _survival(states(seen), frame_s)),
        (
            "level_spread", "Brightness of spots", "photoelectrons per frame", "cumulative fraction",
            lambda seen: _levels(states(seen)),
        ),
    ]  # fmt: skip


def _curve(spec: Spec[Seen], measured: Seen, before: Sequence[Seen], after: Sequence[Seen]) -> Curve:
    name, title, x_label, y_label, make = spec
    x, y = make(measured)
    ours = [np.interp(x, *make(o)) for o in before]
    theirs = [np.interp(x, *make(o)) for o in after]
    return Curve(
        name, title, x_label, y_label, x, y,
        np.mean(ours, axis=0), np.std(ours, axis=0), np.mean(theirs, axis=0), np.std(theirs, axis=0),
    )  # fmt: skip


def _light(seen: TraceNumbers) -> Array:
    return seen.light


def _all_light(observation: Observation) -> Array:
    light: Array = observation.spots.light[observation.spots.inside]
    return light


def _autocovariance(states: OnStates) -> Points:
    frames = states.light.shape[1]
    lags = np.unique(np.round(np.geomspace(1, max(2, frames // 4), 16)).astype(int))
    t = np.arange(frames)
    span = (t >= states.first[:, None]) & (t <= states.last[:, None])
    deviation = np.where(span, states.light / states.level[:, None] - 1, 0.0)
    y = [(deviation[:, k:] * deviation[:, :-k]).sum() / max(int((span[:, k:] & span[:, :-k]).sum()), 1) for k in lags]
    return lags.astype(float), np.array(y)


def _counts(states: OnStates) -> Points:
    edges = np.linspace(-0.8, 3.2, POINTS + 1)
    relative = states.light / np.median(states.level) if states.light.size else np.zeros(1)
    density = np.histogram(relative, edges, density=True)[0] if relative.size else np.zeros(POINTS)
    return (edges[1:] + edges[:-1]) / 2, np.nan_to_num(density)


def _binned(values: Array, frame_s: float) -> Points:
    n = min(POINTS, len(values))
    edges = np.linspace(0, len(values), n + 1).astype(int)
    y = np.add.reduceat(values, edges[:-1]) / np.diff(edges)
    return (edges[:-1] + edges[1:]) / 2 * frame_s, y


def _ensemble(total: Array, frame_s: float) -> Points:
    first = total[: max(1, len(total) // 10)].mean()
    return _binned(total / max(float(first), 1e-9), frame_s)


def _survival(states: OnStates, frame_s: float) -> Points:
    t = np.linspace(0, states.light.shape[1], POINTS)
    return t * frame_s, np.array([(states.last >= at).mean() if states.last.size else 0.0 for at in t])


def _levels(states: OnStates) -> Points:
    level = np.sort(states.level)
    if not level.size:
        return np.linspace(0, 1, POINTS), np.zeros(POINTS)
    x = np.linspace(0, 2.5 * np.median(level), POINTS)
    return x, np.searchsorted(level, x) / len(level)


def _background(observation: Observation, frame_s: float) -> Points:
    return _binned(observation.course, frame_s)


def _spectrum(observation: Observation) -> Points:
    course = observation.course / max(float(observation.course.mean()), 1e-9) - 1
    power = np.abs(np.fft.rfft(course * np.hanning(len(course))))[1:] ** 2 / len(course)
    return np.asarray(np.fft.rfftfreq(len(course))[1:], dtype=np.float64), power


def _path(observation: Observation, frame_s: float) -> Points:
    path = observation.spots.path_px
    n = observation.spots.light.shape[1]
    return (np.arange(len(path)) + 0.5) * n / len(path) * frame_s, np.hypot(*path.T)


def _own_motion(observation: Observation) -> Points:
    spots = observation.spots
    moved = spots.displacement_px[spots.inside & spots.isolated]
    lags = np.arange(1, max(2, moved.shape[1] - 1))
    y = []
    for k in lags:
        steps = ((moved[:, k:] - moved[:, :-k]) ** 2).sum(axis=2)
        y.append(float(steps[np.isfinite(steps)].mean()) if np.isfinite(steps).any() else 0.0)
    return lags.astype(float), np.array(y)
