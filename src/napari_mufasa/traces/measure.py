"""The light of molecules, frame by frame, in their places or along their paths (docs/traces.md)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.camera.frames import Frames, Stack
from napari_mufasa.spots import aperture, drift
from napari_mufasa.spots.shape import LitImages, Shapes, light_around
from napari_mufasa.traces.options import Options


@dataclass(frozen=True)
class Measured:
    """traces, background (candidate, frame) photoelectrons, per pixel the latter; shapes : of the lit images; noise_e,
    mean_e : of the movie, per pixel and frame."""

    traces: NDArray[np.float32]
    background: NDArray[np.float32]
    shapes: Shapes
    noise_e: float
    mean_e: float


def measure(
    frames: Frames, positions: NDArray[np.float64], sigma: float, options: Options,
    motion: NDArray[np.float64] | None, report: Callable[[int], None], cancel: Callable[[], bool] | None,
) -> Measured:  # fmt: skip
    """The second pass: traces, local backgrounds, lit images, noise."""
    shape = frames.shape[1:]
    share = options.profile, options.subtract_background
    opening = aperture.aperture(positions, shape, sigma, share[0], subtract_background=share[1])
    lit_images = LitImages(opening.window.shape)
    traces = np.empty((len(positions), frames.n_frames), np.float32)
    background = np.empty_like(traces)
    level = _Level()
    for start, stack in frames.blocks(report=report, cancel=cancel):
        for first, last in drift.still_parts(motion, start, start + len(stack)):
            if motion is not None:
                moved = positions + motion[first:last].mean(axis=0)
                opening = aperture.aperture(moved, shape, sigma, share[0], subtract_background=share[1])
            span, part = slice(first, last), stack[first - start : last - start]
            traces[:, span], background[:, span] = opening.traces(part)
            near = light_around(traces[:, span])
            lit_images.add(opening, part, near, background[:, span])
        level.add(stack)
    return Measured(traces, background, lit_images.measure(sigma), level.noise_e(), level.mean_e())


def measure_along(
    frames: Frames, path_px: NDArray[np.float64], seen: NDArray[np.bool_], sigma: float, options: Options,
    report: Callable[[int], None] | None, cancel: Callable[[], bool] | None,
) -> Measured:  # fmt: skip
    """The same along paths (molecule, frame, 2); the lit image is that of the frames in which each was `seen`
    (molecule, frame)."""
    traces = np.empty(path_px.shape[:2], np.float32)
    background = np.empty_like(traces)
    lit_images: LitImages | None = None
    level = _Level()
    for start, stack in frames.blocks(report=report, cancel=cancel):
        readings = []
        for t in range(len(stack)):
            reading = aperture.read_frame(
                stack[t], path_px[:, start + t], sigma, options.profile, subtract_background=options.subtract_background
            )
            traces[:, start + t], background[:, start + t] = reading.trace, reading.background
            readings.append(reading)
        near = light_around(traces[:, start : start + len(stack)]) * seen[:, start : start + len(stack)]
        lit_images = lit_images or LitImages(readings[0].window.shape)
        for t, reading in enumerate(readings):
            lit_images.add(reading, stack[t : t + 1], near[:, t : t + 1], background[:, start + t : start + t + 1])
        level.add(stack)
    assert lit_images is not None  # a movie has frames
    return Measured(traces, background, lit_images.measure(sigma), level.noise_e(), level.mean_e())


class _Level:
    """Mean and temporal noise of a movie, block by block."""

    def __init__(self) -> None:
        self.means: list[float] = []
        self.variances: list[float] = []

    def add(self, stack: Stack) -> None:
        self.means.append(float(stack.mean(dtype=np.float64)))
        if len(stack) > 1:
            self.variances.append(float(np.median(np.mean(np.diff(stack, axis=0) ** 2, axis=0))) / 2)

    def noise_e(self) -> float:
        return float(np.sqrt(np.mean(self.variances))) if self.variances else float("nan")

    def mean_e(self) -> float:
        return float(np.mean(self.means))
