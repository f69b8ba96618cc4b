"""What a movie shows of an effect directly, so that no fit needs to search for it.

`READERS` holds a function for each kind of effect that has such parameters: from an `Observation` to their values.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pywt
from numpy.typing import NDArray
from scipy import ndimage, signal

from napari_mufasa.discover.seen_courses import (
    course_of,
    flicker_course,
    from_zero,
    light_course,
    light_period,
    light_step_and_course,
    walk_of,
)
from napari_mufasa.effects import Effect
from napari_mufasa.effects.courses import told
from napari_mufasa.model.extent import Extent
from napari_mufasa.observe import Observation
from napari_mufasa.observe.summary import mean_shape
from napari_mufasa.spots.drift import SEEN_PX

Array = NDArray[np.float64]
Reader = Callable[[Observation], dict[str, Any]]
LEAST_WEIGHT = 1e-6  # of known tiles under the smoothing window; less: too far from all of them
MORE_THAN_PATTERNS = 5.0  # variance of a map over that which a model's own random patterns give it
FEWEST_TILES = 12  # of the background's map that tell a relief
RELIEF = 0.5  # variance of the smoothed map over that of what smoothing takes away: white noise on 12 × 12 tiles
# reached 0.42 at most in 20 000 draws, on 6 × 6 tiles one in 80 passes
CURVATURE = np.outer((1, -2, 1), (1, -2, 1))  # of it 36 times the variance of white noise is left, of slopes nothing
NOISE_LOST = 0.76  # of the variance of white noise, that an average over tiles takes away
PATH_VALUES, PRECISE_PX = 30, 0.03  # most values of a path, and how precise each should be
FIFTHS = 5
NOT_AS_FAR = 0.99  # of the way to the farthest value of a course, on the other side of 0
NORMAL_MEDIAN = 0.6745  # of the absolute value of a standard normal variate


def read_off(kind: str, observation: Observation) -> dict[str, Any]:
    """Parameters of an effect that the movie shows, by name; nothing for effects that have none."""
    reader = READERS.get(kind)
    return {} if reader is None else reader(observation)


def in_scale_of(whole: dict[str, Any], part: dict[str, Any]) -> dict[str, Any]:
    """What a part of the field shows, its course and relief in the scale of what the whole field shows: where they are
    0 and ±1 hangs on single values and their noise. (Least squares of the whole's values on the part's.) What begins at
    0 is farthest from it on the same side, for that is the way that an effect's size points."""
    found = dict(part)
    for name in ("course", "seen"):
        here, there = np.array(part.get(name, ())), np.array(whole.get(name, ()))
        if here.size and there.size and np.ptp(here) > 0:
            slope, offset = np.polyfit(here, _resampled(there, 0, (0.0, 1.0), len(here)), 1)
            values = offset + slope * here
            if name == "course" and there[0] == 0:  # a drift's
                side = np.sign(max(there, key=abs))
                values = side * np.maximum(side * values, -NOT_AS_FAR * max((side * values).max(), 0.0))
            found[name] = tuple(values.round(4).tolist())
    return found


def told_for(extent: Extent, found: dict[str, Any]) -> dict[str, Any]:
    """Parameters that were read off a part of a movie, as an effect gives them that speaks of an extent around it
    (shares of the part); beyond the part, what was seen at its end."""
    told, frames = dict(found), extent.frames
    for name in ("course", "path"):
        if values := found.get(name):
            told[name] = tuple(map(_plain, _resampled(np.array(values), 0, frames)))
    if "step_at" in found:
        told["step_at"] = float(np.clip((found["step_at"] - frames[0]) / (frames[1] - frames[0]), 0, 1))
    for name, columns in (("seen", "seen_columns"), ("map", "map_columns")):
        if values := found.get(name):
            grid = np.reshape(values, (-1, found[columns]))
            grid = _resampled(_resampled(grid, 0, extent.rows), 1, extent.columns)
            told |= {name: tuple(grid.ravel().tolist()), columns: grid.shape[1]}
    return told


def _resampled(values: Array, axis: int, bounds: tuple[float, float], cells: int | None = None) -> Array:
    """Values at the centres of equal cells of a part along an axis, as those of so many `cells` between `bounds`
    (shares of the part); None: of about as large ones."""
    n, (start, stop) = values.shape[axis], bounds
    cells = max(1, round(n * (stop - start))) if cells is None else cells
    at = start + (stop - start) * (np.arange(cells) + 0.5) / cells
    found: Array = np.apply_along_axis(lambda row: told(row, at), axis, values)
    return found


def _plain(value: Any) -> Any:
    return tuple(value.tolist()) if value.ndim else float(value)


def uneven_light(observation: Observation) -> dict[str, Any]:
    """Of a beam, which is smooth: what is finer is stray light, or molecules too dim to be found."""
    return bright_side(observation) | relief(observation, averaged)


def uneven_background(observation: Observation) -> dict[str, Any]:
    return bright_side(observation) | relief(observation, sharpened)


def bright_side(observation: Observation) -> dict[str, float]:
    """`direction_deg` as the background's tilt shows it, if there is a map of it."""
    seen = dict(zip(observation.names, observation.part("all"), strict=True))
    y, x = seen["background_map_tilt_y"], seen["background_map_tilt_x"]
    return {"direction_deg": float(np.rad2deg(np.arctan2(y, x)) % 360)} if y or x else {}


def relief(observation: Observation, without_noise: Callable[[Array], Array]) -> dict[str, Any]:
    """`seen` and `seen_columns` from the background's map; () where it shows nothing but noise."""
    tiles = observation.background_map
    known = np.isfinite(tiles)
    nothing = {"seen": (), "seen_columns": 1}
    if known.sum() < FEWEST_TILES:
        return nothing
    smooth = averaged(tiles)
    if smooth[known].var() < RELIEF * (tiles - smooth)[known].var():
        return nothing
    seen = without_noise(tiles)
    height = (seen - seen.min()) / np.ptp(seen)
    return {"seen": tuple(height.ravel().round(4).tolist()), "seen_columns": tiles.shape[1]}


def averaged(tiles: Array) -> Array:
    """A map averaged over neighbouring tiles, unknown ones (NaN) filled from these, near or far."""
    known = np.isfinite(tiles)
    weight = ndimage.gaussian_filter(known.astype(float), 1.0, mode="nearest")
    values = ndimage.gaussian_filter(np.where(known, tiles, 0.0), 1.0, mode="nearest")
    beyond_all = weight < LEAST_WEIGHT
    nearest = ndimage.distance_transform_edt(beyond_all, return_distances=False, return_indices=True)
    smooth: Array = (values / np.where(beyond_all, 1.0, weight))[tuple(nearest)]
    return smooth


def sharpened(tiles: Array) -> Array:
    """The average makes slopes too flat at the edge, and humps too low: what it has taken away is averaged and given
    back (Tukey's twicing), so far as it is more than noise, as second differences show that (Immerkær, Comput. Vis.
    Image Underst. 64, 300, 1996)."""
    average = averaged(tiles)
    lost = tiles - average
    noise = np.mean(signal.convolve2d(np.where(np.isfinite(tiles), tiles, average), CURVATURE, "valid") ** 2) / 36
    real = np.clip(1 - NOISE_LOST * noise / max(np.nanvar(lost), 1e-300), 0.0, 1.0)
    return np.asarray(average + real * averaged(lost))


def drift_beyond(observation: Observation, model: Sequence[Observation]) -> Observation:
    """The observation whose background has no more of a course than what simulations of a model do not show."""
    expected = np.mean([one.courses for one in model], axis=0)
    return replace(observation, courses=observation.courses - expected + expected.mean(axis=1, keepdims=True))


def relief_beyond(observation: Observation, model: Sequence[Observation]) -> Observation:
    """The observation whose map has no more of a relief than what simulations of a model do not show; without a map
    where the model's random patterns (columns, pixels) could be all there is in it: these would be copied."""
    maps = _maps(model)
    if len(maps) < 2 or np.isfinite(observation.background_map).sum() < FEWEST_TILES:
        return observation
    expected, by_chance = np.mean(maps, axis=0), np.var(maps, axis=0, ddof=1).mean()
    beyond = observation.maps - expected + expected.mean()
    if np.var(sharpened(beyond[0])) <= MORE_THAN_PATTERNS * by_chance:
        beyond = np.full_like(beyond, np.nan)
    return replace(observation, maps=beyond)


def _maps(model: Sequence[Observation]) -> list[Array]:
    """The background's map of each simulation that shows one, without its noise."""
    return [sharpened(one.background_map) for one in model if np.isfinite(one.background_map).sum() >= FEWEST_TILES]


def background_beyond(observation: Observation, model: Sequence[Observation]) -> dict[str, Any]:
    """`map`, `map_columns` and `course` of the background, relative to what simulations of a model show of it; ()
    where they show none."""
    found: dict[str, Any] = {"map": (), "map_columns": 1, "course": ()}
    expected = np.mean([one.course for one in model], axis=0)
    if np.all(expected > 0):
        course = _without_flicker(observation.course / expected)
        found["course"] = tuple((course / course.mean()).round(4).tolist())
    maps = _maps(model)
    expected_map = np.mean(maps, axis=0) if maps else np.zeros(1)
    if np.isfinite(observation.background_map).sum() >= FEWEST_TILES and np.all(expected_map > 0):
        relative = sharpened(observation.background_map) / expected_map
        found["map"] = tuple((relative / relative.mean()).round(4).ravel().tolist())
        found["map_columns"] = relative.shape[1]
    return found


def _without_flicker(course: Array) -> Array:
    """A course without what changes from frame to frame: Haar coefficients within the noise of the finest are none
    (the universal threshold of Donoho and Johnstone, Biometrika 81, 425, 1994)."""
    coarse, *fine = pywt.wavedec(course, "haar")
    noise = np.median(np.abs(fine[-1])) / NORMAL_MEDIAN
    least = noise * np.sqrt(2 * np.log(len(course)))
    kept: Array = pywt.waverec([coarse, *(pywt.threshold(c, least, "hard") for c in fine)], "haar")[: len(course)]
    return kept


def common_path(observation: Observation) -> dict[str, Any]:
    """A path that stands out from its noise is the spots' common path. A step, if it was one, came when the motion
    along the path's end differs most before and after; that difference gives the direction."""
    motion, blocks = observation.spots.common_motion(), observation.spots.path_px
    along = motion @ blocks[-1]
    # One frame before, one after at the least.
    step = 1 + int(np.argmin(np.cumsum(along - along.mean())[:-1])) if len(along) > 1 else 0
    y, x = motion[step:].mean(axis=0) - motion[: max(step, 1)].mean(axis=0)
    direction = {"direction_deg": float(np.rad2deg(np.arctan2(y, x)) % 360)}
    if np.hypot(*blocks.T).max() <= SEEN_PX:
        return direction | {"path": ()}
    noise_px = max(float(np.diff(motion, axis=0).std()) / np.sqrt(2), 1e-6)
    n = int(np.clip(len(motion) * (PRECISE_PX / noise_px) ** 2, len(blocks), PATH_VALUES))
    seen = np.stack([part.mean(axis=0) for part in np.array_split(motion, min(n, len(motion)))])
    seen -= seen[0]
    extent = float(np.hypot(*seen.T).max())
    path = tuple((float(b), float(a)) for b, a in (seen / extent).round(4))
    return direction | {"path": path, "step_at": float((step - 0.5) / max(len(motion) - 1, 1))}


def width_course(observation: Observation) -> dict[str, Any]:
    """The course is that of the spots' width, as fifths of the molecules show it; a walk whose steps stand out of the
    noise of a frame is told for each frame."""
    spots = observation.spots
    keep = np.flatnonzero(spots.inside & spots.isolated)
    blocks = range(spots.shape.shape[1])
    if len(keep) < 2 * FIFTHS:
        return {"course": ()}
    walk = walk_of(spots.common_widening(keep), spots.light.shape[1] // len(blocks))
    if walk is not None:
        return from_zero(walk)
    groups = [keep[i::FIFTHS] for i in range(FIFTHS)]
    return course_of(np.array([[mean_shape(spots, g, [b])[:2].mean() for b in blocks] for g in groups]))


def long_axis(observation: Observation) -> dict[str, float]:
    """The axis is that of the spots' mean second moments."""
    spots = observation.spots
    along_y, along_x, oblique = mean_shape(spots, spots.inside & spots.isolated, range(spots.shape.shape[1]))
    return {"axis_deg": float(np.rad2deg(0.5 * np.arctan2(2 * oblique, along_x - along_y)) % 180)}


READERS: dict[str, Reader] = {
    "illumination_profile": uneven_light,
    "background_gradient": uneven_background,
    "laser_drift": light_step_and_course,
    "laser_flicker": flicker_course,
    "baseline_drift": light_step_and_course,
    "background_decay": light_course,
    "periodic_modulation": light_period,
    "stage_drift": common_path,
    "focus_drift": width_course,
    "astigmatism": long_axis,
    "directed_motion": long_axis,
}
DRIFTS = frozenset(kind for kind, reader in READERS.items() if reader in (light_course, light_step_and_course))
RELIEFS = frozenset(kind for kind, reader in READERS.items() if reader in (uneven_light, uneven_background))
READ_LAST = frozenset({"laser_flicker"})  # noise is what drifts leave
COURSES = DRIFTS | READ_LAST | {"background_as_measured"}


def repeats_a_course(effect: Effect) -> bool:
    """Does every simulation of an effect change the light, or the baseline, over the movie in the same way?"""
    if effect.kind not in COURSES:
        return False
    return bool(getattr(effect, "course", ())) if effect.matters("course") else effect.kind in DRIFTS
