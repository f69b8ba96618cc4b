"""How strongly each pixel speaks for a spot: a matched filter over several times (docs/traces.md).

A molecule may be lit all the time, late, or for a few frames. Each pixel's evidence is the largest
signal-to-noise ratio of a spot-shaped signal over three time scales: short blocks, five short blocks, the
whole movie. The noise of each scale is measured from differences of successive blocks, so that structure
that does not move in time (uneven light, fixed patterns) is not mistaken for noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from napari_mufasa.camera.frames import Frames, Stack
from napari_mufasa.spots.crowding import Between
from napari_mufasa.spots.filters import Image, border_noise, lower_spread, spot_filter
from napari_mufasa.spots.times import MIDDLE, short_block

TILE = 16  # px; the noise is the same within a tile


@dataclass(frozen=True)
class Evidence:
    """image : evidence of a spot at each pixel, in noise sd; signal : the same with noise in time alone, which tells
    where a spot lies; early, late : filtered means of the movie's first and last fifth; each (y, x). spread : robust sd
    of `image` between its spots."""

    image: Image
    signal: Image
    early: Image
    late: Image
    spread: float


def block_means(stack: NDArray[Any], edges: NDArray[np.integer]) -> Stack:
    """(block, y, x) means of the frames `edges[b]` … `edges[b + 1]` − 1 of a stack (frame, y, x)."""
    from napari_mufasa.spots import kernels

    if stack.dtype not in (np.uint16, np.float32):  # each further type would be compiled for itself
        stack = stack.astype(np.float32)
    means: Stack = kernels.block_means(np.ascontiguousarray(stack), np.asarray(edges, dtype=np.int64))
    return means


def search(
    frames: Frames,
    sigma_px: float,
    *,
    block: int | None = None,
    drift_px: NDArray[np.float64] | None = None,
    report: Callable[[int], None] | None = None,
    cancel: Callable[[], bool] | None = None,
) -> Evidence:
    """Read a movie once, block by block, for the evidence of spots in it.

    `block` frames make a short block (None: at most `SHORT_BLOCKS` of them). `drift_px` (frame, 2) is undone.
    """
    from napari_mufasa.spots import kernels

    shape = frames.shape[1:]
    block = short_block(frames.n_frames, block)
    total, steps = np.zeros(shape, np.float64), np.zeros(shape, np.float64)
    early, late = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    shortest, middle = np.full(shape, -np.inf, np.float32), np.full(shape, -np.inf, np.float32)
    recent = np.empty((0, *shape), np.float32)
    n_blocks = 0
    for start, filtered in frames.worked(
        FilteredMeans(block, sigma_px, drift_px), multiple=block, report=report, cancel=cancel
    ):
        first = start + block * np.arange(len(filtered))
        if not len(first):
            continue
        early += filtered[: np.count_nonzero(first < frames.n_frames / 5)].sum(axis=0)
        late += filtered[np.count_nonzero(first + block <= frames.n_frames * 4 / 5) :].sum(axis=0)
        filtered = np.concatenate([recent, filtered]) if len(recent) else filtered
        kernels.take_in(filtered, len(recent), total, steps, shortest, middle)
        recent = filtered[-(MIDDLE - 1) :]
        n_blocks += len(first)
    whole = (total / n_blocks).astype(np.float32)
    if n_blocks < 3:  # too short for differences in time: noise from the spread in space
        image = (whole / max(lower_spread(whole), 1e-12)).astype(np.float32)
        return Evidence(image, image, early, late, lower_spread(image))
    noise = np.sqrt(_smooth_floor(steps / (2 * (n_blocks - 1)))).astype(np.float32)
    noise *= border_noise((shape[0], shape[1]), sigma_px)
    noise = np.maximum(noise, np.float32(1e-12))
    best = shortest / noise
    if n_blocks >= MIDDLE:
        best = np.maximum(best, middle / (noise / np.float32(np.sqrt(MIDDLE))))
    whole_noise = noise / np.float32(np.sqrt(n_blocks))
    # Static structure that is no molecule (uneven light, fixed pattern) limits the long average.
    between = Between.of(whole, whole_noise, sigma_px)
    limited = np.maximum(whole_noise, np.float32(between.of_mean))
    image = np.maximum(best, whole / limited)
    return Evidence(image, np.maximum(best, whole / whole_noise), early, late, between.spread(image))


@dataclass(frozen=True)
class FilteredMeans:
    """Filtered means (mean, y, x) over each `block` of frames, the drift (frame, 2) undone; frames left over at the end
    make none."""

    block: int
    sigma_px: float
    drift_px: NDArray[np.float64] | None = None

    def __call__(self, frames: Frames, start: int, counts: NDArray[Any], _: Any = None) -> Stack:
        from napari_mufasa.spots import kernels

        edges = np.arange(0, len(counts) + 1, self.block)
        if len(edges) < 2:
            return np.empty((0, *frames.shape[1:]), np.float32)
        means = frames.flat(block_means(counts, edges))
        if self.drift_px is not None:
            moved = [self.drift_px[f : f + self.block].mean(axis=0) for f in start + edges[:-1]]
            means = kernels.moved_back(means, np.array(moved))
        return spot_filter(means, self.sigma_px)


def peak_offsets(image: NDArray[np.floating], peaks: NDArray[np.int64]) -> NDArray[np.float64]:
    """Offset (y, x) of a maximum from its pixel (peak, 2), by the parabola through it and its neighbours, at most half
    a pixel."""
    last, mid = np.array(image.shape) - 1, image[tuple(peaks.T)].astype(float)
    offsets = np.zeros(peaks.shape)
    for axis, step in enumerate(([1, 0], [0, 1])):
        before, after = (
            np.maximum(peaks - step, 0),
            np.minimum(peaks + step, last),
        )  # the edge goes on outside the image
        low, high = image[tuple(before.T)].astype(float), image[tuple(after.T)].astype(float)
        bend = low - 2 * mid + high
        offset = np.divide(0.5 * (low - high), bend, out=np.zeros(len(peaks)), where=bend < 0)
        offsets[:, axis] = np.clip(offset, -0.5, 0.5)
    return offsets


def _smooth_floor(variance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Noise variance as a smooth map: medians over tiles, so that spots (a minority) do not count."""
    height, width = variance.shape
    rows, columns = -(-height // TILE), -(-width // TILE)
    whole = np.pad(variance, ((0, rows * TILE - height), (0, columns * TILE - width)), mode="symmetric")
    grid = np.median(whole.reshape(rows, TILE, columns, TILE), axis=(1, 3))
    grid = ndimage.median_filter(grid, 3, mode="nearest")
    smooth = ndimage.zoom(grid, TILE, order=1, mode="nearest", grid_mode=True)[:height, :width]
    return np.asarray(np.maximum(smooth, 1e-12))
