"""A measurement made ready for diagnosis: checked, cropped to an affordable size, its model fitted to its form."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa import camera as detector
from napari_mufasa import checks
from napari_mufasa.calibrate.sample import DIM, lit_frames, window
from napari_mufasa.camera.darkness import light_in_dark
from napari_mufasa.camera.frames import Frames
from napari_mufasa.errors import MufasaError
from napari_mufasa.model.extent import Extent
from napari_mufasa.model.model import Model

FRAMES = 600  # a diagnosis looks at no more frames …
VOXELS = 6_000_000  # … and pixels times frames than this
DARK_FRAMES = 60
LEAST_FRAMES, LEAST_DARK = 20, 5
UNLIT = 0.3  # of the light: frames that hold less of it, above a baseline that is believed, were recorded without it …
ALL_OVER = 0.5  # … if it comes on all over the field: so much of its mean in the middle pixel


@dataclass(frozen=True)
class Measurement:
    """movie (frame, y, x) and dark (frame, y, x) or None, both uint16 ADU; the model in the movie's own shape; which
    part they are of the whole, and the shape of that: the lit frames, y, x; `first_frame` is the first of these in
    the movie given."""

    movie: NDArray[np.uint16]
    dark: NDArray[np.uint16] | None
    model: Model
    notes: tuple[str, ...]
    part: Extent
    whole: tuple[int, int, int]
    first_frame: int


def prepare(movie: Any, model: Model, dark: Any = None) -> Measurement:
    """Check and crop. Lazy arrays are read only where needed. Raises `MufasaError` on unusable input."""
    movie = checks.stack(movie)
    shape = _shape(movie)
    notes = []
    frames = min(shape[0], FRAMES)
    if frames < LEAST_FRAMES:
        raise MufasaError(
            f"the movie has {checks.counted(shape[0], 'frame')}: a diagnosis needs at least {LEAST_FRAMES}"
        )
    if frames < shape[0]:
        notes.append(f"The first {frames} of {shape[0]} frames were used.")
    rows, columns = window(shape[1:], VOXELS // frames)
    if (rows.stop - rows.start, columns.stop - columns.start) != shape[1:]:
        notes.append(
            f"A central region of {rows.stop - rows.start} × {columns.stop - columns.start} of "
            f"{shape[1]} × {shape[2]} pixels was used."
        )
    region = (slice(0, frames), rows, columns)
    data = _counts(np.asarray(movie[region]), "movie", model)
    Frames(data, model.in_shape(maps=None).camera).check_light()
    dark_data, begin, level_adu, share = None, 0, model.camera.baseline_adu, UNLIT
    if dark is not None:
        dark = checks.dark_stack(dark, shape[1:])
        if (n_dark := int(dark.shape[0])) < LEAST_DARK:
            raise MufasaError(f"too few dark frames ({n_dark}): give at least {LEAST_DARK}, better 50")
        if told := light_in_dark(movie, dark):
            warnings.warn(told, stacklevel=3)
        dark_data = _counts(np.asarray(dark[:DARK_FRAMES, rows, columns]), "dark stack", model)
        level_adu, share = float(dark_data.mean()), DIM
    first, stop = _lit(data, level_adu, share)
    first = first if dark_data is not None or first >= LEAST_DARK else 0
    lit = first + first % 2  # an even frame: the baseline of odd ones may differ
    if (first, stop) != (0, frames) and stop - lit >= LEAST_FRAMES:
        begin = lit
        if first:
            used = "left out" if dark_data is not None else "taken as dark frames, the others as the movie"
            notes.append(f"The first {first} frames are dark: they are {used}.")
        if stop < frames:
            notes.append(f"The last {frames - stop} frames are dark: they are left out.")
        if first and dark_data is None:
            dark_data = data[max(begin - DARK_FRAMES, 0) : first]
        data, shape = data[begin:stop], ((stop if stop < frames else shape[0]) - begin, *shape[1:])
        region = (slice(0, len(data)), rows, columns)
    whole = model.in_shape(n_frames=shape[0], shape_px=shape[1:])
    here = _part_of(whole, region).with_values({"sample.layout": "random"})
    return Measurement(data, dark_data, here, tuple(notes), Extent.of(region, shape), shape, begin)


def cropped(model: Model) -> Model:
    """The model of the part of its movie that a diagnosis looks at: as many molecules per area."""
    timing = model.acquisition
    frames = min(timing.n_frames, FRAMES)
    return _part_of(model, (slice(0, frames), *window(timing.shape_px, VOXELS // frames)))


def _part_of(model: Model, region: tuple[slice, slice, slice]) -> Model:
    """The model of a region (frames, rows, columns) of its movie: as many molecules per area."""
    part = model.in_shape(region=region)
    area = float(np.prod(part.acquisition.shape_px)) / float(np.prod(model.acquisition.shape_px))
    return part.with_values({"sample.n_molecules": max(1, round(model.sample.n_molecules * area))})


def _lit(movie: NDArray[np.uint16], level_adu: float, share: float) -> tuple[int, int]:
    """First lit frame and that after the last one. Frames before or after are lit, too, unless they hold less than a
    share of the light beside them above the dark level, and it comes or goes all over the field: each end by itself."""
    first, stop = lit_frames(movie)
    head, tail = movie[first : min(first + DARK_FRAMES, stop)], movie[max(stop - DARK_FRAMES, first) : stop]

    def unlit(part: NDArray[np.uint16], lit: NDArray[np.uint16]) -> bool:
        if not len(part):
            return False
        rise = lit.mean(axis=0) - part.mean(axis=0)
        dark = float(part.mean()) - level_adu < share * float(rise.mean())
        return dark and float(np.median(rise)) > ALL_OVER * float(rise.mean())

    return (
        first if unlit(movie[max(first - DARK_FRAMES, 0) : first], head) else 0,
        stop if unlit(movie[stop : stop + DARK_FRAMES], tail) else len(movie),
    )


def _shape(movie: Any) -> tuple[int, int, int]:
    n_frames, height, width = (int(n) for n in movie.shape)
    if min(height, width) < 24:
        raise MufasaError(f"the movie is {height} × {width} pixels: a diagnosis needs at least 24 × 24")
    return n_frames, height, width


def _counts(data: NDArray[Any], what: str, model: Model) -> NDArray[np.uint16]:
    if data.dtype.kind == "f" and not np.isfinite(data).all():
        raise MufasaError(f"the {what} holds values that are not numbers: export the raw counts (ADU)")
    detector.check_counts(data, model.camera)
    if data.min() < 0 or data.max() > 65535:
        raise MufasaError(f"the {what} spans {data.min()} … {data.max()}: needs raw counts from 0 to 65535")
    if data.min() == data.max():
        raise MufasaError(f"every pixel of the {what} is {data.min()}: nothing was recorded; give the raw counts (ADU)")
    return np.ascontiguousarray(np.rint(data) if data.dtype.kind == "f" else data).astype(np.uint16)
