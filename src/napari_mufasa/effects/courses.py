"""How something may change over a movie."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from napari_mufasa.model.effect import parameter
from napari_mufasa.simulate.scene import Scene

SETTLING = 0.25  # of the movie


def course(
    form: str, scene: Scene, rng: np.random.Generator, step_at: float = 0.5, step_frames: float = 0.0,
    settling_time: float = SETTLING, seen: tuple[float, ...] = (),
) -> NDArray[np.float64]:  # fmt: skip
    """A change over the movie (frame,) from 0 (first frame) to about 1 (last): linear, curved, stepwise or wandering.
    Before the movie (progress below 0: dark frames) a law goes on backwards.

    What saturates settles exponentially, within `settling_time` of the movie by all but 1/e; it began to twice
    that before the movie, and is held until then. What wanders follows `seen`, values at equal times, where they are
    given; else it is a random walk.
    """
    progress = scene.progress
    if form == "linear":
        return progress
    if form == "saturating":
        since = np.maximum(progress, -2 * settling_time)
        path: NDArray[np.float64] = np.expm1(-since / settling_time) / np.expm1(-1 / settling_time)
    elif form == "accelerating":
        path = progress**2
    elif form == "step":
        last = (len(progress) - 1) / max(float(np.ptp(progress)), 1e-12)  # frame of progress 1
        path = stepwise(np.round(progress * last, 6), step_at * last, step_frames)
    elif seen:
        path = told(seen, scene.elapsed)
    else:
        walk = np.cumsum(rng.standard_normal(len(progress)))
        walk -= walk[0]
        as_long_as_the_movie = int(np.searchsorted(progress, progress[0] + 1 + 1e-9))
        path = walk / max(np.abs(walk[:as_long_as_the_movie]).max(), 1e-12)
    return path


def told(values: Sequence[float] | NDArray[np.float64], elapsed: NDArray[np.float64]) -> NDArray[np.float64]:
    """Means over equal times, on lines from one's middle to the next: as many as frames are those of the frames."""
    middles = (np.arange(len(values)) + 0.5) / len(values)
    path: NDArray[np.float64] = np.interp(elapsed, middles, values)
    return path


def drifted(
    size: float, form: str, scene: Scene, rng: np.random.Generator, step_at: float, step_frames: float,
    settling_time: float, seen: tuple[float, ...],
) -> NDArray[np.float64]:  # fmt: skip
    """`size` times the course of what drifts; of a course that was seen, `size` is where it is farthest from 0."""
    path = course(form, scene, rng, step_at, step_frames, settling_time, seen)
    if form == "wandering" and seen:
        path = path * np.sign(max(seen, key=abs))
    return path * size


def seen_path(
    forms: tuple[str, ...] = ("wandering",), values: str = "values at equal times, 0 first, ±1 at most"
) -> Any:
    """The field `course` of effects that may follow one that was seen, in all or some of their forms."""
    return Field((), description=f"{values}; () at random", json_schema_extra={"forms": list(forms)})


def stepwise(frame: NDArray[Any], at: float, rise: float) -> NDArray[np.float64]:
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


def settling() -> Any:
    """The field `settling_time` of effects whose course may saturate."""
    return parameter(
        SETTLING, gt=0.01, plausible=(0.1, 1.5), log=True, unit="of the movie", description="time constant",
        forms=("saturating",),
    )  # fmt: skip


def step_length() -> Any:
    """The field `step_frames` of effects with a stepwise course."""
    return parameter(
        0.0, ge=0, plausible=(0, 20), unit="frames", description="how long it takes (10 to 90 %)", forms=("step",)
    )
