"""Motion common to the whole field, so that positions can follow it (SPEC.md §6)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.camera.frames import Frames
from napari_mufasa.spots.find import spot_filter

ANCHORS = 40  # times at which the shift is measured
STILL_PX = 0.15  # apertures are moved on when the field has moved this far


def common_motion(
    frames: Frames, sigma_px: float, report: Callable[[int], None] | None, cancel: Callable[[], bool] | None
) -> NDArray[np.float64]:
    """(frame, 2) shift (y, x) of the field relative to its start, interpolated between block averages.

    Each block's average is registered by phase-free cross-correlation with the average of the blocks
    before it, already brought back; molecules that bleach fade from both, so they do not bias it.
    """
    from scipy import ndimage
    from skimage.registration import phase_cross_correlation

    block = max(1, frames.n_frames // ANCHORS)
    times, shifts = [], []
    reference = None
    for start, stack in frames.blocks(block, report, cancel):
        for i in range(0, len(stack), block):
            part = stack[i : i + block]
            image = spot_filter(part.mean(axis=0), sigma_px)
            if reference is None:
                reference, shift = image, np.zeros(2)
            else:
                found = phase_cross_correlation(  # type: ignore[no-untyped-call]
                    reference, image, upsample_factor=50, normalization=None
                )
                shift = -found[0]
                back = ndimage.shift(image, -shift, order=1, mode="nearest")
                reference = 0.8 * reference + 0.2 * back
            times.append(start + i + (len(part) - 1) / 2)
            shifts.append(shift)
    moved = np.asarray(shifts)
    t = np.arange(frames.n_frames)
    motion = np.stack([np.interp(t, times, moved[:, axis]) for axis in range(2)], axis=1)
    return np.asarray(motion - motion[0])


def still_parts(motion: NDArray[np.float64] | None, start: int, stop: int) -> list[tuple[int, int]]:
    """The frames `start` … `stop` − 1 as spans (first, last + 1) in which the field moves by less than `STILL_PX`."""
    if motion is None:
        return [(start, stop)]
    bounds = [start]
    for frame in range(start + 1, stop):
        if np.abs(motion[frame] - motion[bounds[-1]]).max() > STILL_PX:
            bounds.append(frame)
    return list(zip(bounds, [*bounds[1:], stop], strict=True))


def moved_px(early: NDArray[np.floating], late: NDArray[np.floating]) -> float:
    """How far the spots of a filtered image (y, x) have moved in a later one, px; 0 where the two do not match."""
    from scipy import ndimage
    from skimage.registration import phase_cross_correlation

    found = phase_cross_correlation(early, late, upsample_factor=10, normalization=None)  # type: ignore[no-untyped-call]
    back = ndimage.shift(late, found[0], order=1, mode="nearest")
    before, after = (np.corrcoef(early.ravel(), image.ravel())[0, 1] for image in (late, back))
    return float(np.hypot(*found[0])) if after > max(0.3, before + 0.05) else 0.0
