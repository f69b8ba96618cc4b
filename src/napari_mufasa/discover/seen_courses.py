"""How the light changes over a movie, as its background shows it: drifts, walks, steps, swings and flicker."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage, signal, stats

from napari_mufasa.discover.rules import ALARM, NEAR, OFF
from napari_mufasa.effects.courses import stepwise
from napari_mufasa.observe import Observation

Array = NDArray[np.float64]
VALUES, FEWEST = 60, 5  # most values of a course, and frames for each: a walk is a walk, not flicker
SLOW = 0.36  # mean square of a course's steps over its variance: of random walks 97 % have less, of 1/f noise 1.5 %
TELLS_WALK = 20  # frames over which white noise passes for a walk in 2 of 100 dark series, fewer where there are more
FINER, NEARBY, FEWEST_CYCLES = 8, 20, 4  # of a spectrum: grid over that of the movie's length, width of what is nearby
HARMONICS = 15  # of a swing of any shape, at most
PEAK = 40.0  # sum of two spectra over what is usual: of 4000 flickers or drifts at most 4 reach it
DRIFT = 3  # first cosines that a drift may fill
IN_WHITE = np.logspace(-4, 4, 60)  # shares of coloured noise in white noise that are tried, …
RELAXES = np.logspace(-0.2, 1.1, 10)  # … and frames within which noise forgets itself
SEEN = 5.0  # variance over that of its noise which shows a course: white noise passes this less than twice in 10⁴


def course_of(readings: Array) -> dict[str, Any]:
    """`course` from independent readings (reading, time) of it; () where they do not agree that anything changed."""
    mean = readings.mean(axis=0)
    noise = readings.var(axis=0, ddof=1).mean() / len(readings)
    if not np.isfinite(mean).all() or mean.var() < SEEN * noise:
        return {"course": ()}
    return from_zero(mean)


def from_zero(values: Array) -> dict[str, Any]:
    course = values - values[0]
    return {"course": tuple((course / np.abs(course).max()).round(4).tolist())}


def light_course(observation: Observation) -> dict[str, Any]:
    """`course` of the background, if it changes slowly: what swings or flickers is taken off. A walk whose steps stand
    out of the noise of a frame is told for each frame."""
    light = without_swing(observation)
    flicker = flicker_in(light)
    light = light if flicker is None else light - flicker
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
    return from_zero(np.array([part.mean() for part in np.array_split(light, n)]) if walk is None else walk)


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


def flicker_course(observation: Observation) -> dict[str, Any]:
    """`course` of 1/f flicker as the background shows it, for each frame, in units of its rms; () where it shows
    none."""
    flicker = flicker_in(without_swing(observation))
    return {"course": () if flicker is None else tuple((flicker / flicker.std()).round(4).tolist())}


def flicker_in(course: Array) -> Array | None:
    """The 1/f noise in a course, with its spectrum (as `walk_alone`), where it and white noise are the likeliest law of
    its cosines, of all or of all but the first, which a drift besides may fill. What is larger than
    any by chance (but one time in fifty) is no part of the flicker."""
    if len(course) < TELLS_WALK or not course.var() > 0:
        return None
    cosines = fft.dct(course - course.mean(), norm="ortho")
    law = _pink_law(cosines, 1) or _pink_law(cosines, 1 + DRIFT)
    if law is None:
        return None
    scale, pink = law[0], law[1] * _pink(len(course), 1)
    by_chance = stats.norm.isf(ALARM / (2 * len(pink))) * np.sqrt(scale * (1 + pink))
    too_large = np.abs(cosines[1:]) > by_chance
    cosines[1:] *= np.where(too_large, 0.0, np.sqrt(pink / (1 + pink)))
    alone: Array = fft.idct(cosines, norm="ortho")
    return alone


def _pink(n: int, first: int) -> Array:
    """1/f, f the frequency in cycles per frame, of the cosines of n frames from the `first` on."""
    return 2 * n / np.arange(first, n)


def _pink_law(cosines: Array, first: int) -> tuple[float, float] | None:
    """Power of white noise, and the share of 1/f noise in it, by the cosines from the `first` on, where by them
    (Whittle, Ark. Mat. 2, 423, 1953) these two are likelier than white noise alone, which chance passes for them in
    0.1 %, than a walk in it, with no doubt, and than noise that relaxes."""
    n = len(cosines)
    turn, power = np.pi * np.arange(first, n) / n, np.square(cosines[first:])

    def likeliest(*shapes: Array) -> tuple[float, int]:
        """The least −2 log likelihood, each shape at its best scale, and whose it is."""
        found = [len(power) * np.log(np.mean(power / shape)) + np.log(shape).sum() for shape in shapes]
        return min(found), int(np.argmin(found))

    relaxing = [1 / (1 - 2 * kept * np.cos(turn) + kept**2) for kept in np.exp(-1 / RELAXES)]
    pink, best = likeliest(*(1 + share * _pink(n, first) for share in IN_WHITE))
    white, _ = likeliest(np.ones_like(turn))
    walk, _ = likeliest(*(1 + share / (2 - 2 * np.cos(turn)) for share in IN_WHITE))
    relaxed, _ = likeliest(*(1 + share * shape for share in IN_WHITE for shape in relaxing))
    if pink > min(white - OFF**2, walk - NEAR, relaxed + np.log(n)):
        return None
    share = float(IN_WHITE[best])
    return float(np.mean(power / (1 + share * _pink(n, first)))), share


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
