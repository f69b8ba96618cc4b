"""Motion common to the whole field, so that positions can follow it (docs/traces.md)."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from napari_mufasa.camera.frames import Frames
from napari_mufasa.spots.evidence import block_means, peak_offsets
from napari_mufasa.spots.filters import lower_spread, spot_filter

Array = NDArray[np.float64]
Image = NDArray[np.float32]
ANCHORS = 40  # times at which the shift is measured
REACH_PX = 12  # from one time to the next the field is looked for no farther
STILL_PX = 0.15  # apertures are moved on when the field has moved this far
STANDS_OUT = 6.0  # robust sd of the correlation around it; noise alone has its top at 3 to 4
ONE_HILL = 2 / 3  # of the top: nothing else within reach comes so far, as pairs of other molecules do by chance
LEAP_PX = 1.0  # so far the field moves from one time to the next if it leaps
CLEAR = 4.0  # robust sd of a filtered image: spots above are clear
GOES_ON = 3  # speeds next to either end of a path, of which the middle one goes on beyond it
SEEN_PX = 0.3  # a common path that reaches farther is no noise


def common_path(images: Iterable[Image]) -> Array:
    """(image, 2) shift (y, x) of the whole field since the first of some filtered images (y, x).

    Each is compared with the mean of the ones before, brought back; molecules that bleach fade from both, so they do
    not bias it. A leap is one of most of the spots: where other molecules are lit in every image, the few brightest of
    two correlate at some shift, but not with each spot counted alike.
    """
    path: list[Array] = []
    reference: Field | None = None
    alike: Field | None = None
    for image in images:
        field, flat = Field(image), Field(_flattened(image))
        if reference is None or alike is None:
            reference, alike, at = field, flat, np.zeros(2)
        else:
            at = reference.shift_of(field, near=path[-1])
            leaps = np.hypot(*(at - path[-1])) > LEAP_PX
            if leaps and np.hypot(*(alike.shift_of(flat, near=path[-1]) - at)) > LEAP_PX:
                at = path[-1]
            reference.add(field, at, len(path))
            alike.add(flat, at, len(path))
        path.append(at)
    return np.array(path).reshape(-1, 2)


def _flattened(image: Image) -> Image:
    """A filtered image in which spots that stand out of its noise, if it has any, are all as high."""
    most = CLEAR * lower_spread(image)
    return np.clip(image, -most, most) if most > 0 else image


def common_motion(
    frames: Frames, sigma_px: float, report: Callable[[int], None] | None, cancel: Callable[[], bool] | None
) -> Array:
    """(frame, 2) shift (y, x) of the field relative to its start, interpolated between block averages."""
    block = max(1, frames.n_frames // ANCHORS)
    times: list[float] = []

    def averages() -> Iterable[Image]:
        for start, stack in frames.counts(block, report, cancel):
            edges = np.append(np.arange(0, len(stack), block), len(stack))
            times.extend(start + (edges[1:] + edges[:-1] - 1) / 2)
            yield from spot_filter(frames.flat(block_means(stack, edges)), sigma_px)

    path = common_path(averages())
    return between(path, np.array(times), frames.n_frames)


def between(path: Array, times: Array, n_frames: int) -> Array:
    """(frame, 2) motion since the first frame, interpolated from a path (time, 2) known at some times in frames; before
    the first and after the last it goes on as it mostly does next to there."""
    t = np.arange(n_frames)
    motion = np.stack([np.interp(t, times, path[:, axis]) for axis in range(2)], axis=1)
    if len(path) > 1:
        speed = np.diff(path, axis=0) / np.diff(times)[:, None]
        # The middle of some speeds: a leap, or one place that is off, is nothing that goes on.
        first, last = (np.median(some, axis=0) for some in (speed[:GOES_ON], speed[-GOES_ON:]))
        motion += np.minimum(t - times[0], 0)[:, None] * first + np.maximum(t - times[-1], 0)[:, None] * last
    return np.asarray(motion - motion[0])


class Field:
    """A filtered image (y, x) as it is compared with others: its Fourier transform, with room to move in."""

    def __init__(self, image: Image, reach_px: int = REACH_PX) -> None:
        self.reach_px = reach_px
        self.padded = [fft.next_fast_len(n + reach_px, real=True) for n in image.shape]
        self.spectrum = fft.rfft2(image - image.mean(), self.padded)

    def shift_of(self, other: Field, near: Array | None = None) -> Array:
        """How far (y, x) the other image has moved against this one, px: the top of their correlation within reach of
        `near` (None: of no motion); `near` itself where no top stands out there, from its surroundings and alone."""
        near, reach = np.zeros(2) if near is None else near, self.reach_px
        correlation = fft.irfft2(other.spectrum * np.conj(self.spectrum), self.padded)
        centre = np.rint(near).astype(int)
        y, x = (np.arange(c - reach, c + reach + 1) % n for c, n in zip(centre, self.padded, strict=True))
        window = correlation[np.ix_(y, x)]
        top = np.array(np.unravel_index(np.argmax(window), window.shape))
        ranks = [int(0.1587 * window.size), window.size // 2]
        low, middle = np.partition(window, ranks, axis=None)[ranks]
        height = window.max() - middle
        if (
            top.min() < 1
            or top.max() > 2 * reach - 1
            or height < STANDS_OUT * (middle - low)
            or ndimage.label(window > middle + ONE_HILL * height)[1] > 1
        ):
            return np.asarray(near, dtype=np.float64)
        return np.asarray(centre - reach + top + peak_offsets(window, top[None])[0], dtype=np.float64)

    def add(self, other: Field, shift: Array, n: int) -> None:
        """Make this mean of `n` images the mean of one more, which has moved by `shift`."""
        ky, kx = fft.fftfreq(self.padded[0]), fft.rfftfreq(self.padded[1])
        back = np.outer(np.exp(2j * np.pi * ky * shift[0]), np.exp(2j * np.pi * kx * shift[1])).astype(np.complex64)
        self.spectrum = self.spectrum * (n / (n + 1)) + other.spectrum * back / (n + 1)


def still_parts(motion: Array | None, start: int, stop: int) -> list[tuple[int, int]]:
    """The frames `start` … `stop` − 1 as spans (first, last + 1) in which the field moves by less than `STILL_PX`."""
    if motion is None:
        return [(start, stop)]
    bounds = [start]
    for frame in range(start + 1, stop):
        if np.abs(motion[frame] - motion[bounds[-1]]).max() > STILL_PX:
            bounds.append(frame)
    return list(zip(bounds, [*bounds[1:], stop], strict=True))


def moved_px(early: Image, late: Image) -> float:
    """How far the spots of a filtered image (y, x) have moved in a later one, px; 0 where the two do not match."""
    from napari_mufasa.spots.kernels import moved_back

    reach = min(early.shape) // 3
    shift = Field(early, reach).shift_of(Field(late, reach))
    back = moved_back(late[None], shift[None])[0]
    before, after = (np.corrcoef(early.ravel(), image.ravel())[0, 1] for image in (late, back))
    return float(np.hypot(*shift)) if after > max(0.3, before + 0.05) else 0.0
