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
from scipy import fft, ndimage, signal

from napari_mufasa.discover.rules import OFF
from napari_mufasa.effects.courses import stepwise, told
from napari_mufasa.model.extent import Extent
from napari_mufasa.observe import Observation
from napari_mufasa.observe.summary import mean_shape
from napari_mufasa.spots.drift import SEEN_PX

Array = NDArray[np.float64]
Reader = Callable[[Observation], dict[str, Any]]
VALUES, FEWEST = 60, 5  # most values of a course, and frames for each: a walk is a walk, not flicker
SLOW = 0.36  # mean square of a course's steps over its variance: of random walks 97 % have less, of 1/f noise 1.5 %
LEAST_WEIGHT = 1e-6  # of known tiles under the smoothing window; less: too far from all of them
TELLS_WALK = 20  # frames over which white noise passes for a walk in 2 of 100 dark series, fewer where there are more
SEEN = 5.0  # variance over that of its noise which shows a course: white noise passes this less than twice in 10⁴; and
# a map's over that which a model's own random patterns give it
FEWEST_TILES = 12  # of the background's map that tell a relief
RELIEF = 0.5  # variance of the smoothed map over that of what smoothing takes away: white noise on 12 × 12 tiles
# reached 0.42 at most in 20 000 draws, on 6 × 6 tiles one in 80 passes
CURVATURE = np.outer((1, -2, 1), (1, -2, 1))  # of it 36 times the variance of white noise is left, of slopes nothing
NOISE_LOST = 0.76  # of the variance of white noise, that an average over tiles takes away
PATH_VALUES, PRECISE_PX = 30, 0.03  # most values of a path, and how precise each should be
FIFTHS = 5
FINER, NEARBY, FEWEST_CYCLES = 8, 20, 4  # of a spectrum: grid over that of the movie's length, width of what is nearby
HARMONICS = 15  # of a swing of any shape, at most
PEAK = 40.0  # sum of two spectra over what is usual: of 4000 flickers or drifts at most 4 reach it
NOT_AS_FAR = 0.99  # of the way to the farthest value of a course, on the other side of 0
NORMAL_MEDIAN = 0.6745  # of the absolute value of a standard normal variate


def read_off(kind: str, observation: Observation) -> dict[str, Any]:
    """Parameters of an effect that the movie shows, by name; nothing for effects that have none."""
    reader = READERS.get(kind)
    return {} if reader is None else reader(observation)


def in_scale_of(whole: dict[str, Any], part: dict[str, Any]) -> dict[str, Any]:
    """What a part of the field shows, its course and relief in the scale of what the whole field shows: where they are
    0 and ±1 hangs on single values and their noise. (Least squares of the whole's values on the part's.) It is farthest
    from 0 on the same side, for that is the way that an effect's size points."""
    found = dict(part)
    for name in ("course", "seen"):
        here, there = np.array(part.get(name, ())), np.array(whole.get(name, ()))
        if here.size and there.size and np.ptp(here) > 0:
            slope, offset = np.polyfit(here, _resampled(there, 0, (0.0, 1.0), len(here)), 1)
            values = offset + slope * here
            if name == "course":
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


def course_of(readings: Array) -> dict[str, Any]:
    """`course` from independent readings (reading, time) of it; () where they do not agree that anything changed."""
    mean = readings.mean(axis=0)
    noise = readings.var(axis=0, ddof=1).mean() / len(readings)
    if not np.isfinite(mean).all() or mean.var() < SEEN * noise:
        return {"course": ()}
    return _from_zero(mean)


def _from_zero(values: Array) -> dict[str, Any]:
    course = values - values[0]
    return {"course": tuple((course / np.abs(course).max()).round(4).tolist())}


def light_course(observation: Observation) -> dict[str, Any]:
    """`course` of the background, if it changes slowly: what swings or flickers is no drift. A walk whose steps stand
    out of the noise of a frame is told for each frame."""
    light = without_swing(observation)
    n = min(VALUES, len(light) // FEWEST)
    if n < FEWEST:
        return {"course": ()}
    frames = len(light) // n
    readings = light[: frames * n].reshape(n, frames).T
    mean = readings.mean(axis=0)
    found = course_of(readings) if np.mean(np.diff(mean) ** 2) < SLOW * mean.var() else {"course": ()}
    if not found["course"]:
        return found
    walk = walk_of(light, frames)
    return _from_zero(np.array([part.mean() for part in np.array_split(light, n)]) if walk is None else walk)


def walk_of(course: Array, frames: int) -> Array | None:
    """A course for each frame where its steps are seen, and the mean of so many `frames` walks away by more than its
    noise."""
    far = max(2, frames // 2)
    if len(course) <= far:
        return None
    step, noise = walk_in_noise(course, far)
    # Of white noise, differences over one frame and over more differ by less (three standard deviations).
    chance = OFF * np.sqrt(8 / len(course)) * noise / (far - 1)
    return walk_alone(course, step, noise) if step > max(chance, 6 * noise / frames**2) else None


def walk_in_noise(course: Array, far: int = 2) -> tuple[float, float]:
    """Variance of a walk's steps, and of the white noise it is seen in, from differences over one frame and over `far`:
    2 where the steps are larger than the noise, more where they are smaller."""
    one, more = (float(np.mean((course[by:] - course[:-by]) ** 2)) for by in (1, far))
    step = (more - one) / (far - 1)
    return step, max((one - step) / 2, 0.0)


def walk_alone(course: Array, step: float, noise: float) -> Array:
    """A course seen in noise with the spectrum of the walk in it: the noise that simulations add makes it what was
    measured. (In cosines, in which a walk between ends that reflect has independent coefficients; the best guess at the
    path would be smoother than a walk.)"""
    cosines = fft.dct(course, norm="ortho")
    walks = 4 * np.sin(np.pi * np.arange(len(course)) / (2 * len(course))) ** 2
    alone: Array = fft.idct(cosines / np.sqrt(1 + walks * noise / step), norm="ortho")
    return alone


def light_step(observation: Observation) -> dict[str, float]:
    """`step_at` and `step_frames` as the background shows them.

    The split of the movie whose two means differ most beyond noise, then least squares around it.
    """
    light = without_swing(observation)
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
        design = np.stack([np.ones(n), stepwise(frame, *trial)], axis=1)
        return float(((light - design @ np.linalg.lstsq(design, light, rcond=None)[0]) ** 2).sum())

    at, rise = min(trials, key=misfit)
    return {"step_at": float(np.clip(at / max(n - 1, 1), 0, 1)), "step_frames": float(rise)}


def light_step_and_course(observation: Observation) -> dict[str, Any]:
    return light_step(observation) | light_course(observation)


def light_period(observation: Observation) -> dict[str, float]:
    """`period_frames` of a swing that background and spots have in common; nothing where none stands out.

    The highest peak of their power spectra (straight line taken off, Hann window), each over its median nearby, which
    noise of any slowly changing colour exceeds alike.
    """
    n = len(observation.course)
    frequency = np.fft.rfftfreq(FINER * n)
    power = np.zeros(len(frequency))
    for light in (observation.course, observation.together()):
        found = np.abs(np.fft.rfft(signal.detrend(light) * np.hanning(n), FINER * n)) ** 2
        usual = ndimage.median_filter(found, size=FINER * NEARBY, mode="mirror") / np.log(2)
        power += found / np.maximum(usual, 1e-12 * found.max() + 1e-300)
    power[frequency < FEWEST_CYCLES / n] = 0.0
    peak = int(np.argmax(power))
    return {"period_frames": float(1 / frequency[peak])} if power[peak] > PEAK and frequency[peak] < 0.5 else {}


def without_swing(observation: Observation) -> Array:
    """The course of the background without a swing that background and spots have in common, of any shape (a straight
    line and harmonics by least squares, at the best frequency about that of the highest peak)."""
    light = observation.course
    period = light_period(observation).get("period_frames")
    if period is None:
        return light
    n, harmonics = len(light), [k for k in range(1, HARMONICS + 1) if 2 * k < period]
    best, least = light, np.inf
    for frequency in 1 / period + np.linspace(-1, 1, 2 * FINER + 1) / (FINER * n):
        turns = 2 * np.pi * frequency * np.arange(n)
        waves = np.column_stack([wave(k * turns) for k in harmonics for wave in (np.sin, np.cos)])
        design = np.column_stack([np.ones(n), np.arange(n), waves])
        found = np.linalg.lstsq(design, light, rcond=None)[0]
        left = float(np.square(light - design @ found).sum())
        if left < least:
            best, least = light - waves @ found[2:], left
    return best


def uneven_light(observation: Observation) -> dict[str, Any]:
    """Of a beam, which is smooth: what is finer is stray light, or molecules too dim to be found."""
    return bright_side(observation) | relief(observation, averaged)


def uneven_background(observation: Observation) -> dict[str, Any]:
    return bright_side(observation) | relief(observation, sharpened)


def bright_side(observation: Observation) -> dict[str, float]:
    """`direction_deg` as the background's tilt shows it."""
    seen = dict(zip(observation.names, observation.part("all"), strict=True))
    tilt = np.arctan2(seen["background_map_tilt_y"], seen["background_map_tilt_x"])
    return {"direction_deg": float(np.rad2deg(tilt) % 360)}


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
    if np.var(sharpened(beyond[0])) <= SEEN * by_chance:
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
        return _from_zero(walk)
    groups = [keep[i::FIFTHS] for i in range(FIFTHS)]
    return course_of(np.array([[mean_shape(spots, g, [b])[:2].mean() for b in blocks] for g in groups]))


def long_axis(observation: Observation) -> dict[str, float]:
    """The axis is that of the spots' mean second moments."""
    spots = observation.spots
    along_y, along_x, oblique = mean_shape(spots, spots.inside & spots.isolated, range(spots.shape.shape[1]))
    return {"axis_deg": float(np.rad2deg(0.5 * np.arctan2(2 * oblique, along_x - along_y)) % 180)}


def stands_still(dark: NDArray[Any]) -> bool:
    """Do dark frames (frame, y, x) show no drift, the last third beside the first, and no walk? How their means scatter
    is told by frames two apart: a baseline may alternate."""
    course = dark.mean(axis=(1, 2), dtype=np.float64)
    third = len(course) // 6 * 2  # a baseline that alternates does so an even number of times
    if third < 2:
        return False
    drift = course[-third:].mean() - course[:third].mean()
    steady = abs(drift) < OFF * (course[2:] - course[:-2]).std() / np.sqrt(third)
    return bool(steady and (third < TELLS_WALK or walk_of(course, third) is None))


def dark_course(dark: NDArray[Any]) -> tuple[float, ...]:
    """How the offset (ADU) of dark frames (frame, pixel) comes to that of the last of them; () of too few frames."""
    n = min(VALUES, len(dark) // FEWEST)
    if n < FEWEST:
        return ()
    values = np.array([part.mean() for part in np.array_split(dark.mean(axis=1, dtype=np.float64), n)])
    return tuple((values - values[-1]).round(3).tolist())


READERS: dict[str, Reader] = {
    "illumination_profile": uneven_light,
    "background_gradient": uneven_background,
    "laser_drift": light_step_and_course,
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
