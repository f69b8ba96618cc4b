"""Where spots are in single frames, to a part of a pixel: what following molecules starts from (docs/traces.md)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.camera.frames import Frames
from napari_mufasa.cluster import in_order
from napari_mufasa.spots.aperture import background_slopes
from napari_mufasa.spots.filters import border_noise, lower_spread, spot_filter

Array = NDArray[np.float64]
AVERAGED = 3  # frames, around each: dim spots are found in their mean, and have hardly moved in it
THRESHOLD_SIGMA = 4.0  # noise sd of such a mean; what noise raises now and then makes no path of several frames
OWN_SIGMA = 2.5  # noise sd of a single frame from which on a spot that is known to be there is seen in it
STEPS = 6  # of Gauss and Newton: from half a pixel away three are enough
FARTHEST_PX = 1.5  # from where it is looked for: what goes farther is another spot


@dataclass(frozen=True)
class Places:
    """Spots, in the order of the frames: frame (spot,), position_px (spot, 2) as (y, x) in the mean of the frames
    around, strength (spot,) in noise sd of that mean, own_px (spot, 2) in the frame itself, nan where it is not seen
    there."""

    frame: NDArray[np.int64]
    position_px: Array
    strength: Array
    own_px: Array

    def moved_by(self, motion_px: Array) -> Places:
        """The same places, those of each frame moved by (frame, 2)."""
        by = motion_px[self.frame]
        return replace(self, position_px=self.position_px + by, own_px=self.own_px + by)


def locate(
    frames: Frames,
    sigma_px: float,
    *,
    threshold_sigma: float | None = None,
    report: Callable[[int], None] | None = None,
    cancel: Callable[[], bool] | None = None,
) -> Places:
    """Find and fit the spots around every frame of a movie, read once, block by block.

    A candidate is a local maximum of the spot filter in the mean of three frames, above `threshold_sigma` (4) robust sd
    of that mean; its place, there and in the frame itself, is that of a Gaussian of the PSF's width on a plane,
    fitted by least squares. Errors of the places in frames themselves are independent of each other.
    """
    level = THRESHOLD_SIGMA if threshold_sigma is None else threshold_sigma
    uneven = border_noise((frames.shape[1], frames.shape[2]), sigma_px)
    blocks = _with_margin(frames, report, cancel)
    found = list(in_order(_Located(sigma_px, level, uneven), blocks, client=frames.client, workers=0, cancel=cancel))
    return Places(*(np.concatenate(parts) for parts in zip(*found, strict=True)))


@dataclass(frozen=True)
class _Located:
    """Finds the spots in (first frame, images) with a frame more at either end: as in `Places`."""

    sigma_px: float
    level: float
    uneven: NDArray[np.float32]

    def __call__(self, block: tuple[int, NDArray[np.float32]]) -> tuple[NDArray[Any], ...]:
        (first, images), sigma_px = block, self.sigma_px
        filtered = spot_filter(images, sigma_px) / self.uneven
        n = len(images) - 2 * (AVERAGED // 2)
        inner = slice(AVERAGED // 2, AVERAGED // 2 + n)
        means, means_filtered = _running_mean(images), _running_mean(filtered)
        frame, pixel, strength = _maxima(means_filtered, self.level, sigma_px)
        slopes = background_slopes(means, frame, pixel.astype(np.float64), sigma_px)
        place, good = fit_places(means, frame, pixel, sigma_px, slopes=slopes)
        frame, place, strength, slopes = frame[good], place[good], strength[good], slopes[good]
        nearest = np.clip(np.rint(place).astype(np.int64), 0, np.array(images.shape[1:]) - 1)
        own, seen = fit_places(images[inner], frame, nearest, sigma_px, place - nearest, slopes)
        y, x = np.clip(np.rint(own).astype(np.int64), 0, np.array(images.shape[1:]) - 1).T
        seen &= filtered[inner][frame, y, x] > OWN_SIGMA * _noise(filtered[inner])[frame]
        return frame + first, place, strength, np.where(seen[:, None], own, np.nan)


def _with_margin(
    frames: Frames, report: Callable[[int], None] | None, cancel: Callable[[], bool] | None
) -> Iterator[tuple[int, NDArray[np.float32]]]:
    """(first frame, images) with a frame of the neighbouring block at either end; the movie's ends stand twice."""
    margin = AVERAGED // 2
    held: NDArray[np.float32] | None = None
    first = 0
    for start, stack in frames.counts(report=report, cancel=cancel):
        images = frames.flat(stack.astype(np.float32))
        held = np.concatenate([images[:1]] * margin + [images]) if held is None else np.concatenate([held, images])
        if len(held) > 2 * margin:
            yield first, held
            first = start + len(stack) - margin
            held = held[-2 * margin :]
    if held is not None:
        yield first, np.concatenate([held] + [held[-1:]] * margin)


def _running_mean(images: NDArray[np.float32]) -> NDArray[np.float32]:
    n = len(images) - AVERAGED + 1
    return np.asarray(sum(images[i : i + n] for i in range(AVERAGED)) / np.float32(AVERAGED), dtype=np.float32)


def _noise(filtered: NDArray[np.float32]) -> Array:
    return np.array([max(lower_spread(image), 1e-12) for image in filtered])


def _maxima(filtered: NDArray[np.float32], level: float, sigma_px: float) -> tuple[NDArray[np.int64], Any, Array]:
    """(spot,) frame, (spot, 2) pixel, (spot,) noise sd of the local maxima of filtered images (frame, y, x)."""
    from scipy import ndimage

    reach = 2 * max(1, round(sigma_px)) + 1
    strength = filtered / _noise(filtered)[:, None, None].astype(np.float32)
    top = ndimage.maximum_filter(filtered, size=(1, reach, reach), mode="nearest") == filtered
    frame, y, x = np.nonzero(top & (strength > level))
    return frame, np.stack([y, x], axis=1), strength[frame, y, x].astype(np.float64)


def fit_places(
    images: NDArray[np.float32], frame: NDArray[np.int64], pixel: NDArray[np.int64], sigma_px: float,
    start: Array | None = None, slopes: Array | None = None,
) -> tuple[Array, NDArray[np.bool_]]:  # fmt: skip
    """Places (spot, 2) of Gaussians on a plane around some pixels (spot, 2) of images (frame, y, x), and which of
    them are spots: brighter than their surroundings, and near the pixel.

    Least squares over amplitude, constant, y and x at the width of the PSF and a pixel, by Gauss and Newton, from
    `start` (spot, 2) beside the pixel on. The slopes (spot, 2) of the plane are those around each spot (None: see
    `background_slopes`): beneath it they could hardly be told from its place.
    """
    if len(frame) == 0:
        return np.zeros((0, 2)), np.zeros(0, dtype=bool)
    half = max(3, int(np.ceil(2.5 * sigma_px)))
    padded = np.pad(images, ((0, 0), (half, half), (half, half)), mode="edge")
    grid = np.arange(-half, half + 1)
    y, x = pixel[:, 0, None, None] + half + grid[:, None], pixel[:, 1, None, None] + half + grid[None, :]
    patch = padded[frame[:, None, None], y, x].astype(np.float64)
    # What lies outside the field is a copy and must not count.
    rows = (pixel[:, :1] + grid >= 0) & (pixel[:, :1] + grid < images.shape[1])
    columns = (pixel[:, 1:] + grid >= 0) & (pixel[:, 1:] + grid < images.shape[2])
    counts = (rows[:, :, None] & columns[:, None, :]).reshape(len(frame), -1)
    variance = sigma_px**2 + 1 / 12
    begin = np.zeros((len(frame), 2)) if start is None else start
    if slopes is None:
        slopes = background_slopes(images, frame, pixel + begin, sigma_px)
    patch -= slopes[:, 0, None, None] * grid[:, None] + slopes[:, 1, None, None] * grid
    values = patch.reshape(len(frame), -1)
    at, light = begin, np.zeros(len(frame))
    for _ in range(STEPS):
        dy, dx = grid - at[:, :1], grid - at[:, 1:]
        gy, gx = np.exp(-(dy**2) / (2 * variance)), np.exp(-(dx**2) / (2 * variance))
        spot = (gy[:, :, None] * gx[:, None, :]).reshape(len(frame), -1)
        along_y = ((gy * dy)[:, :, None] * gx[:, None, :]).reshape(len(frame), -1) / variance
        along_x = (gy[:, :, None] * (gx * dx)[:, None, :]).reshape(len(frame), -1) / variance
        design = np.stack([spot, np.ones_like(spot), along_y, along_x], axis=1) * counts[:, None]
        normal = design @ design.transpose(0, 2, 1) + 1e-9 * np.eye(4)
        terms = np.linalg.solve(normal, design @ values[..., None])[..., 0]
        light = terms[:, 0]
        step = np.clip(terms[:, 2:] / np.where(light > 0, light, np.inf)[:, None], -0.5, 0.5)
        at = at + step
    good = (light > 0) & (np.abs(at - begin).max(axis=1) <= FARTHEST_PX)
    return np.asarray(pixel + at), good
