"""The light of molecules, frame by frame, in their places or along their paths (docs/traces.md)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.camera.frames import Frames, Stack
from napari_mufasa.spots import aperture, drift
from napari_mufasa.spots.shape import LitImages, Shapes, light_around
from napari_mufasa.traces.options import Options


@dataclass(frozen=True)
class Measured:
    """traces, background (candidate, frame) photoelectrons, per pixel the latter; weight (candidate,) pixels' worth of
    background that a trace holds where none is subtracted; shapes : of the lit images; noise_e, mean_e : of the movie,
    per pixel and frame; saturated (candidate,) frames in which a pixel of its window is at the camera's end."""

    traces: NDArray[np.float32]
    background: NDArray[np.float32]
    weight: NDArray[np.float64]
    shapes: Shapes
    noise_e: float
    mean_e: float
    saturated: NDArray[np.int64]


def measure(
    frames: Frames, positions: NDArray[np.float64], sigma: float, options: Options,
    motion: NDArray[np.float64] | None, report: Callable[[int], None], cancel: Callable[[], bool] | None,
) -> Measured:  # fmt: skip
    """The second pass: traces, local backgrounds, lit images, noise."""
    return _measured(
        frames, _InPlace(positions, sigma, _Kind.of(options), motion, frames._full()), sigma, report, cancel
    )


def measure_along(
    frames: Frames, path_px: NDArray[np.float64], seen: NDArray[np.bool_], sigma: float, options: Options,
    report: Callable[[int], None] | None, cancel: Callable[[], bool] | None,
) -> Measured:  # fmt: skip
    """The same along paths (molecule, frame, 2); the lit image is that of the frames in which each was `seen`
    (molecule, frame)."""

    def of(span: slice) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        return path_px[:, span], seen[:, span]

    return _measured(frames, _Along(sigma, _Kind.of(options), frames._full()), sigma, report, cancel, of)


def _measured(
    frames: Frames, reads: _InPlace | _Along, sigma: float, report: Callable[[int], None] | None,
    cancel: Callable[[], bool] | None, beside: Callable[[slice], Any] = lambda span: None,
) -> Measured:  # fmt: skip
    traces, backgrounds, weights = [], [], []
    lit_images: LitImages | None = None
    means: list[float] = []
    saturated: NDArray[np.int64] | int = 0
    squares, steps = np.zeros(frames.shape[1:]), 0
    # Two frames at least, however large they are: noise is told by how they differ.
    for _, block in frames.worked(reads, beside, multiple=2, report=report, cancel=cancel):
        traces.append(block.traces)
        backgrounds.append(block.background)
        weights.append(block.weight)
        # A block's lit images are many times larger than its traces: they are added up as they come.
        if lit_images is None:
            lit_images = block.lit_images
        else:
            lit_images.include(block.lit_images)
        means.append(block.mean)
        saturated = saturated + block.saturated
        squares += block.squares
        steps += traces[-1].shape[1] - 1
    assert lit_images is not None  # a movie has frames
    return Measured(
        np.concatenate(traces, axis=1),
        np.concatenate(backgrounds, axis=1),
        np.average(weights, axis=0, weights=[part.shape[1] for part in traces]),
        lit_images.measure(sigma),
        float(np.sqrt(np.median(squares) / (2 * steps))) if steps else float("nan"),
        float(np.mean(means)),
        np.asarray(saturated, dtype=np.int64),
    )


@dataclass(frozen=True)
class _Read:
    """What a block of frames shows: traces, background (candidate, frame), weight (candidate,); mean of its
    pixels, and of each (y, x) the sum of squares of its steps from frame to frame; saturated (candidate,) frames."""

    traces: NDArray[np.float32]
    background: NDArray[np.float32]
    weight: NDArray[np.float64]
    lit_images: LitImages
    mean: float
    squares: NDArray[np.float32]
    saturated: NDArray[np.int64]

    @classmethod
    def of(
        cls, stack: Stack, traces: NDArray[np.float32], background: NDArray[np.float32], weight: NDArray[np.float64],
        lit_images: LitImages, saturated: NDArray[np.int64],
    ) -> _Read:  # fmt: skip
        squares = np.square(np.diff(stack, axis=0)).sum(axis=0)
        return cls(traces, background, weight, lit_images, float(stack.mean(dtype=np.float64)), squares, saturated)


def _saturated(
    counts: NDArray[Any], full: float | None, window: NDArray[np.int64], inside: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """(candidate,) in how many frames of `counts` (frame, y, x) a pixel of the window is at the end of what the camera
    can tell: `full`, where it is known."""
    found = np.zeros(len(window), dtype=np.int64)
    if full is None:
        return found
    for frame in counts:
        at_end = frame >= full
        if at_end.any():
            found += (at_end.ravel()[window] & inside).any(axis=1)
    return found


@dataclass(frozen=True)
class _Kind:
    """What a trace is."""

    profile: aperture.Profile
    subtract_background: bool

    @classmethod
    def of(cls, options: Options) -> _Kind:
        return cls(options.profile, options.subtract_background)


@dataclass(frozen=True)
class _InPlace:
    """Reads molecules at places that only the field moves, by `motion` (frame, 2); `full` : the largest number that the
    movie can hold, where it is known."""

    positions: NDArray[np.float64]
    sigma: float
    kind: _Kind
    motion: NDArray[np.float64] | None
    full: float | None = None
    _apertures: dict[tuple[int, int], aperture.Aperture] = field(default_factory=dict)

    def __call__(self, frames: Frames, start: int, counts: NDArray[Any], _: Any) -> _Read:
        stack = frames.electrons(counts, start)
        traces = np.empty((len(self.positions), len(stack)), np.float32)
        background = np.empty_like(traces)
        weight = np.zeros(len(self.positions))
        lit_images: LitImages | None = None
        saturated, full = np.zeros(len(self.positions), dtype=np.int64), self.full
        for first, last in drift.still_parts(self.motion, start, start + len(stack)):
            opening = self._opening(frames.shape[1:], first, last)
            lit_images = lit_images or LitImages(opening.window.shape)
            span = slice(first - start, last - start)
            traces[:, span], background[:, span] = opening.traces(stack[span])
            weight += opening.weight * (last - first) / len(stack)
            saturated += _saturated(counts[span], full, opening.window, opening.inside)
            lit_images.add(opening, stack[span], light_around(traces[:, span]), background[:, span])
        assert lit_images is not None  # a block has frames
        return _Read.of(stack, traces, background, weight, lit_images, saturated)

    def _opening(self, shape: tuple[int, int], first: int, last: int) -> aperture.Aperture:
        """One for all frames where nothing moves."""
        made, kind = self._apertures, self.kind
        if self.motion is not None:
            moved = self.positions + self.motion[first:last].mean(axis=0)
            return aperture.aperture(
                moved, shape, self.sigma, kind.profile, subtract_background=kind.subtract_background
            )
        if shape not in made:
            made[shape] = aperture.aperture(
                self.positions, shape, self.sigma, kind.profile, subtract_background=kind.subtract_background
            )
        return made[shape]


@dataclass(frozen=True)
class _Along:
    """Reads molecules along their paths, `beside` being those of the block and where they are seen: (molecule, frame,
    2) and (molecule, frame)."""

    sigma: float
    kind: _Kind
    full: float | None = None

    def __call__(self, frames: Frames, start: int, counts: NDArray[Any], beside: Any) -> _Read:
        stack = frames.electrons(counts, start)
        path_px, seen = beside
        readings = [
            aperture.read_frame(
                image, path_px[:, t], self.sigma, self.kind.profile,
                subtract_background=self.kind.subtract_background,
            )
            for t, image in enumerate(stack)
        ]  # fmt: skip
        traces = np.stack([reading.trace for reading in readings], axis=1).astype(np.float32)
        background = np.stack([reading.background for reading in readings], axis=1).astype(np.float32)
        near = light_around(traces) * seen
        lit_images = LitImages(readings[0].window.shape)
        for t, reading in enumerate(readings):
            lit_images.add(reading, stack[t : t + 1], near[:, t : t + 1], background[:, t : t + 1])
        weight = np.mean([reading.weight for reading in readings], axis=0)
        saturated = np.zeros(len(path_px), dtype=np.int64)
        for t, reading in enumerate(readings):
            saturated += _saturated(counts[t : t + 1], self.full, reading.window, reading.inside) * seen[:, t]
        return _Read.of(stack, traces, background, weight, lit_images, saturated)
