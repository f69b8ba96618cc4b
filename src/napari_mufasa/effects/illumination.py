"""Illumination effects: light that is not the same everywhere or always (SPEC.md §9)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from napari_mufasa.effects.base import Effect, parameter
from napari_mufasa.scene import Array, Scene

if TYPE_CHECKING:
    from napari_mufasa.observe import Observation

STAGE = "illumination"
VALUES, FEWEST = 60, 5  # most values of a course that is read off, and frames for each: a walk is a walk, not flicker
SLOW = 0.36  # mean square of a course's steps over its variance: of random walks 97 % have less, of 1/f noise 1.5 %
SEEN = 5.0  # variance over that of its noise which shows a course: white noise passes this less than twice in 10⁴


def course(
    form: str, progress: NDArray[np.float64], rng: np.random.Generator, step_at: float = 0.5, step_frames: float = 0.0,
    seen: tuple[float, ...] = (),
) -> NDArray[np.float64]:  # fmt: skip
    """A change over the movie from 0 (first frame) to about 1 (last): linear, curved, stepwise or wandering.

    What wanders follows `seen`, values at equal times, where they are given; else it is a random walk.
    """
    if form == "linear":
        return progress
    if form == "saturating":
        path: NDArray[np.float64] = (1 - np.exp(-4 * progress)) / (1 - np.exp(-4))
    elif form == "accelerating":
        path = progress**2
    elif form == "step":
        path = _step(np.arange(len(progress)), step_at * (len(progress) - 1), step_frames)
    elif seen:
        path = np.interp(progress, (np.arange(len(seen)) + 0.5) / len(seen), seen)
    else:
        walk = np.cumsum(rng.standard_normal(len(progress)))
        walk -= walk[0]
        path = walk / max(np.abs(walk).max(), 1e-12)
    return path


def drifted(
    size: float, form: str, progress: NDArray[np.float64], rng: np.random.Generator, step_at: float, step_frames: float,
    seen: tuple[float, ...],
) -> NDArray[np.float64]:  # fmt: skip
    """`size` times the course of what drifts; a course that was seen brings its own sign."""
    path = course(form, progress, rng, step_at, step_frames, seen)
    return path * (abs(size) if form == "wandering" and seen else size)


def seen_path() -> Any:
    """The field `course` of effects that may wander."""
    return Field(
        (),
        description="values at equal times, 0 first, ±1 at most, with the sign of the change; () at random",
        json_schema_extra={"forms": ["wandering"]},
    )


def seen_course(readings: NDArray[np.float64]) -> dict[str, Any]:
    """`course` from independent readings (reading, time) of it; () where they do not agree that anything changed."""
    mean = readings.mean(axis=0)
    noise = readings.var(axis=0, ddof=1).mean() / len(readings)
    if not np.isfinite(mean).all() or mean.var() < SEEN * noise:
        return {"course": ()}
    mean = mean - mean[0]
    return {"course": tuple((mean / np.abs(mean).max()).round(4).tolist())}


def seen_light(observation: Observation) -> dict[str, Any]:
    """`course` of the background, if it changes slowly: what flickers is no drift."""
    n = min(VALUES, len(observation.course) // FEWEST)
    if n < FEWEST:
        return {"course": ()}
    frames = len(observation.course) // n
    readings = observation.course[: frames * n].reshape(n, frames).T
    mean = readings.mean(axis=0)
    slow = np.mean(np.diff(mean) ** 2) < SLOW * mean.var()
    return seen_course(readings) if slow else {"course": ()}


def _step(frame: NDArray[Any], at: float, rise: float) -> NDArray[np.float64]:
    """From 0 to 1 at frame `at`, logistic with 10 to 90 % within `rise` frames."""
    if rise <= 0:
        return (frame >= at).astype(np.float64)
    result: NDArray[np.float64] = 1 / (1 + np.exp(np.clip(-(frame - at) * 4.4 / rise, -700, 700)))
    return result


def step_time() -> Any:
    """The field `step_at` of effects with a stepwise course."""
    return parameter(
        0.5, ge=0, le=1, plausible=(0.1, 0.9), unit="of the movie", description="when it happens", forms=("step",)
    )


def step_length() -> Any:
    """The field `step_frames` of effects with a stepwise course."""
    return parameter(
        0.0, ge=0, plausible=(0, 20), unit="frames", description="how long it takes (10 to 90 %)", forms=("step",)
    )


def seen_step(observation: Observation) -> dict[str, float]:
    """`step_at` and `step_frames` as the background shows them.

    The split of the movie whose two means differ most beyond noise, then least squares around it.
    """
    light = observation.course
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
        design = np.stack([np.ones(n), _step(frame, *trial)], axis=1)
        return float(((light - design @ np.linalg.lstsq(design, light, rcond=None)[0]) ** 2).sum())

    at, rise = min(trials, key=misfit)
    return {"step_at": float(np.clip(at / max(n - 1, 1), 0, 1)), "step_frames": float(rise)}


def bright_side(forms: tuple[str, ...] = ()) -> Any:
    """The field `direction_deg` of effects that make one side of the field brighter, in all or some of their forms."""
    told = "where it is brightest; 0 along x, 90 along y"
    return parameter(0.0, plausible=(0, 360), unit="deg", description=told, forms=forms)


def seen_bright_side(observation: Observation) -> dict[str, float]:
    """`direction_deg` as the background's tilt shows it."""
    seen = dict(zip(observation.names, observation.part("all"), strict=True))
    tilt = np.arctan2(seen["background_map_tilt_y"], seen["background_map_tilt_x"])
    return {"direction_deg": float(np.rad2deg(tilt) % 360)}


class IlluminationProfile(Effect):
    kind = "illumination_profile"
    stage = STAGE
    strength = "edge_dimming"
    title = "Uneven illumination"
    what_it_is = "The laser beam is brighter in one place than at the edges of the field."
    what_it_does = "Spots and background both fade towards the dim side."
    how_to_check = "Image a flat dye slide; move the sample: the bright region stays with the microscope."
    observables = ("level_position", "background_map")
    rivals = ("background_gradient", "brightness_heterogeneity")
    separated_by = "spot brightness against position; a flat dye slide"

    edge_dimming: float = parameter(
        0.4,
        ge=0,
        le=0.99,
        plausible=(0.05, 0.85),
        unit="",
        description="light lost at the field's dimmest edge",
    )
    direction_deg: float = bright_side(forms=("off_centre", "linear"))
    form: Literal["gaussian", "off_centre", "linear"] = "gaussian"

    @classmethod
    def read_off(cls, observation: Observation) -> dict[str, float]:
        return seen_bright_side(observation)

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        angle = np.deg2rad(self.direction_deg)

        def profile(y: Array, x: Array) -> Array:
            v, u = scene.centred(y, x)
            if self.form == "linear":
                height, width = np.array(scene.shape_px) / max(scene.shape_px)
                reach = width * abs(np.cos(angle)) + height * abs(np.sin(angle))  # from the centre to the last corner
                along: Array = (u * np.cos(angle) + v * np.sin(angle)) / reach
                return 1 - self.edge_dimming * (1 - along) / 2
            cy, cx = (0.5 * np.sin(angle), 0.5 * np.cos(angle)) if self.form == "off_centre" else (0.0, 0.0)
            decay = np.log(1 - self.edge_dimming)
            left: Array = np.exp(decay * ((v - cy) ** 2 + (u - cx) ** 2) / (1 + cy**2 + cx**2))
            return left

        # The brightness believed is that of the field's mean, so only the shape is new.
        mean = float(np.mean(profile(*scene.pixel_coordinates())))
        scene.light_field.append(lambda y, x: profile(y, x) / mean)


class LaserDrift(Effect):
    kind = "laser_drift"
    stage = STAGE
    strength = "change"
    title = "Laser power drift"
    what_it_is = "The power at the sample changes slowly during the movie."
    what_it_does = "Spots and background rise or fall together."
    how_to_check = "Log the power with a photodiode."
    observables = ("level_trend", "background_time")
    rivals = ("background_decay", "baseline_drift", "focus_drift")
    separated_by = "a photodiode trace; dark frames; spot level against background"

    change: float = parameter(
        -0.25,
        ge=-0.95,
        le=5,
        plausible=(-0.5, 0.5),
        unit="",
        description="relative change from first to last frame",
    )
    step_at: float = step_time()
    step_frames: float = step_length()
    course: tuple[float, ...] = seen_path()
    form: Literal["linear", "saturating", "step", "wandering"] = "linear"

    @classmethod
    def read_off(cls, observation: Observation) -> dict[str, Any]:
        return seen_step(observation) | seen_light(observation)

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        change = drifted(self.change, self.form, scene.progress, rng, self.step_at, self.step_frames, self.course)
        scene.light = np.maximum(scene.light * (1 + change), 0.0)


class LaserFlicker(Effect):
    kind = "laser_flicker"
    stage = STAGE
    strength = "rms"
    title = "Laser flicker"
    what_it_is = "The laser's power fluctuates from frame to frame."
    what_it_does = "All spots and the background flicker in unison, without a period."
    how_to_check = "Log the power with a photodiode."
    observables = ("common_mode",)
    rivals = ("periodic_modulation", "row_noise")
    separated_by = "the spectrum of the common mode; a photodiode trace"

    rms: float = parameter(
        0.05, ge=0, le=1, plausible=(0.005, 0.2), unit="", log=True, description="relative rms of the light"
    )
    form: Literal["white", "pink"] = "white"

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        noise = rng.standard_normal(scene.n_frames)
        if self.form == "pink":
            spectrum = np.fft.rfft(noise)
            frequency = np.maximum(np.fft.rfftfreq(scene.n_frames), 1.0 / scene.n_frames)
            noise = np.fft.irfft(spectrum / np.sqrt(frequency), scene.n_frames)
            noise = (noise - noise.mean()) / max(noise.std(), 1e-12)
        scene.light = np.maximum(scene.light * (1 + self.rms * noise), 0.0)


class PeriodicModulation(Effect):
    kind = "periodic_modulation"
    stage = STAGE
    strength = "amplitude"
    title = "Periodic light modulation"
    what_it_is = "Mains ripple or another periodic disturbance of the light, seen through the frame rate."
    what_it_does = "All spots and the background swing in unison at one frequency."
    how_to_check = "Change the frame rate: the period changes; look at the photodiode's spectrum."
    observables = ("common_mode",)
    rivals = ("laser_flicker",)
    separated_by = "the spectrum of the common mode at two frame rates"

    amplitude: float = parameter(
        0.08, ge=0, le=1, plausible=(0.01, 0.25), unit="", log=True, description="relative amplitude"
    )
    period_frames: float = parameter(
        9.0, gt=2, plausible=(2.5, 40), unit="frames", log=True, description="period as recorded"
    )
    form: Literal["sine", "square"] = "sine"

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        phase = rng.uniform(0, 2 * np.pi)
        wave = np.sin(2 * np.pi * np.arange(scene.n_frames) / self.period_frames + phase)
        if self.form == "square":
            wave = np.sign(wave)
        scene.light = np.maximum(scene.light * (1 + self.amplitude * wave), 0.0)


EFFECTS = (IlluminationProfile, LaserDrift, LaserFlicker, PeriodicModulation)
