"""How something may change over a movie, and how a movie shows it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from napari_mufasa.effects.base import parameter

if TYPE_CHECKING:
    from napari_mufasa.observe import Observation

VALUES, FEWEST = 60, 5  # most values of a course that is read off, and frames for each: a walk is a walk, not flicker
SLOW = 0.36  # mean square of a course's steps over its variance: of random walks 97 % have less, of 1/f noise 1.5 %
SEEN = 5.0  # variance over that of its noise which shows a course: white noise passes this less than twice in 10⁴


def course(
    form: str, progress: NDArray[np.float64], rng: np.random.Generator, step_at: float = 0.5, step_frames: float = 0.0,
    seen: tuple[float, ...] = (),
) -> NDArray[np.float64]:  # fmt: skip
    """A change over the movie from 0 (first frame) to about 1 (last): linear, curved, stepwise or wandering.

    What wanders follows `seen`, values at equal times, where they are given; else it is a random walk.
    """
    if form == "linear":
        return progress
    if form == "saturating":
        path: NDArray[np.float64] = (1 - np.exp(-4 * progress)) / (1 - np.exp(-4))
    elif form == "accelerating":
        path = progress**2
    elif form == "step":
        path = _step(np.arange(len(progress)), step_at * (len(progress) - 1), step_frames)
    elif seen:
        path = np.interp(progress, (np.arange(len(seen)) + 0.5) / len(seen), seen)
    else:
        walk = np.cumsum(rng.standard_normal(len(progress)))
        walk -= walk[0]
        path = walk / max(np.abs(walk).max(), 1e-12)
    return path


def drifted(
    size: float, form: str, progress: NDArray[np.float64], rng: np.random.Generator, step_at: float, step_frames: float,
    seen: tuple[float, ...],
) -> NDArray[np.float64]:  # fmt: skip
    """`size` times the course of what drifts; of a course that was seen, `size` is where it is farthest from 0."""
    path = course(form, progress, rng, step_at, step_frames, seen)
    if form == "wandering" and seen:
        path = path * np.sign(max(seen, key=abs))
    return path * size


def seen_path(forms: tuple[str, ...] = ("wandering",)) -> Any:
    """The field `course` of effects that may wander, in all or some of their forms."""
    return Field(
        (),
        description="values at equal times, 0 first, ±1 at most; () at random",
        json_schema_extra={"forms": list(forms)},
    )


def seen_course(readings: NDArray[np.float64]) -> dict[str, Any]:
    """`course` from independent readings (reading, time) of it; () where they do not agree that anything changed."""
    mean = readings.mean(axis=0)
    noise = readings.var(axis=0, ddof=1).mean() / len(readings)
    if not np.isfinite(mean).all() or mean.var() < SEEN * noise:
        return {"course": ()}
    mean = mean - mean[0]
    return {"course": tuple((mean / np.abs(mean).max()).round(4).tolist())}


def seen_light(observation: Observation) -> dict[str, Any]:
    """`course` of the background, if it changes slowly: what flickers is no drift."""
    n = min(VALUES, len(observation.course) // FEWEST)
    if n < FEWEST:
        return {"course": ()}
    frames = len(observation.course) // n
    readings = observation.course[: frames * n].reshape(n, frames).T
    mean = readings.mean(axis=0)
    slow = np.mean(np.diff(mean) ** 2) < SLOW * mean.var()
    return seen_course(readings) if slow else {"course": ()}


def _step(frame: NDArray[Any], at: float, rise: float) -> NDArray[np.float64]:
    """From 0 to 1 at frame `at`, logistic with 10 to 90 % within `rise` frames."""
    if rise <= 0:
        return (frame >= at).astype(np.float64)
    result: NDArray[np.float64] = 1 / (1 + np.exp(np.clip(-(frame - at) * 4.4 / rise, -700, 700)))
    return result


def step_time() -> Any:
    """The field `step_at` of effects with a stepwise course."""
    return parameter(
        0.5, ge=0, le=1, plausible=(0.1, 0.9), unit="of the movie", description="when it happens", forms=("step",)
    )


def step_length() -> Any:
    """The field `step_frames` of effects with a stepwise course."""
    return parameter(
        0.0, ge=0, plausible=(0, 20), unit="frames", description="how long it takes (10 to 90 %)", forms=("step",)
    )


def seen_step(observation: Observation) -> dict[str, float]:
    """`step_at` and `step_frames` as the background shows them.

    The split of the movie whose two means differ most beyond noise, then least squares around it.
    """
    light = observation.course
    n = len(light)
    before = np.arange(1, n)
    total = np.cumsum(light)[:-1]
    difference = total / before - (light.sum() - total) / (n - before)
    evidence = np.abs(difference) * np.sqrt(before * (n - before) / n)
    inner = slice(n // 20, n - n // 20)
    rough = np.argmax(evidence[inner]) + n // 20 + 0.5
    frame = np.arange(n)
    trials = [(at, rise) for at in rough + np.arange(-4, 5) * 0.5 for rise in (0.0, 2.0, 4.0, 8.0, 16.0, 32.0)]

    def misfit(trial: tuple[float, float]) -> float:
        design = np.stack([np.ones(n), _step(frame, *trial)], axis=1)
        return float(((light - design @ np.linalg.lstsq(design, light, rcond=None)[0]) ** 2).sum())

    at, rise = min(trials, key=misfit)
    return {"step_at": float(np.clip(at / max(n - 1, 1), 0, 1)), "step_frames": float(rise)}
