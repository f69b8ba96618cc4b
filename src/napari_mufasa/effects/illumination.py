"""Illumination effects: light that is not the same everywhere or always (docs/effects.md)."""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy import signal

from napari_mufasa.effects.courses import drifted, seen_path, settling, step_length, step_time, told
from napari_mufasa.effects.fields import (
    bright_side,
    centre_along,
    gaussian,
    gaussian_width,
    relief,
    seen_values,
    value_columns,
)
from napari_mufasa.model.effect import Effect, parameter
from napari_mufasa.simulate.scene import Array, Scene

STAGE = "illumination"


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
        description="light lost where the field is dimmest ('linear', 'beam'), a half field from the beam's middle "
        "('gaussian'), 1.12 half fields from it ('off_centre')",
    )
    direction_deg: float = bright_side(forms=("off_centre", "linear"))
    centre_y: float = centre_along("y", "beam")
    centre_x: float = centre_along("x", "beam")
    width: float = gaussian_width("beam")
    seen: tuple[float, ...] = seen_values()
    seen_columns: int = value_columns()
    form: Literal["gaussian", "off_centre", "linear", "as_seen", "beam"] = "gaussian"

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        angle = np.deg2rad(self.direction_deg)
        beam = gaussian(scene, (self.centre_y, self.centre_x), self.width)

        def profile(y: Array, x: Array) -> Array:
            v, u = scene.centred(y, x)
            if self.form == "beam":  # a Gaussian over even light, which leaves 1 − edge_dimming where it ends
                left_on: Array = 1 - self.edge_dimming * (1 - beam(y, x))
                return np.maximum(left_on, 0.0)  # molecules may lie beyond the faintest
            if self.seen and self.form == "as_seen":
                lit: Array = 1 - self.edge_dimming * (1 - relief(self.seen, self.seen_columns, scene, y, x))
                return lit
            if self.form in ("linear", "as_seen"):  # where nothing was seen
                height, width = np.array(scene.field_px) / max(scene.field_px)
                reach = width * abs(np.cos(angle)) + height * abs(np.sin(angle))  # from the centre to the last corner
                along: Array = (u * np.cos(angle) + v * np.sin(angle)) / reach
                return np.maximum(1 - self.edge_dimming * (1 - along) / 2, 0.0)
            cy, cx = (0.5 * np.sin(angle), 0.5 * np.cos(angle)) if self.form == "off_centre" else (0.0, 0.0)
            decay = np.log(1 - self.edge_dimming)
            left: Array = np.exp(decay * ((v - cy) ** 2 + (u - cx) ** 2) / (1 + cy**2 + cx**2))
            return left

        # The brightness believed is that of the field's mean, so only the shape is new.
        mean = float(np.mean(scene.over_field(profile)))
        scene.light_field.append(lambda y, x: profile(y, x) / mean)


class LaserDrift(Effect):
    kind = "laser_drift"
    stage = STAGE
    strength = "change"
    title = "Laser power drift"
    what_it_is = "The power at the sample changes slowly during the movie."
    what_it_does = "Spots and background rise or fall together."
    how_to_check = "Log the power with a photodiode."
    observables = ("level_trend", "level_time", "background_time")
    rivals = ("background_decay", "baseline_drift", "focus_drift", "periodic_modulation")
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
    settling_time: float = settling()
    course: tuple[float, ...] = seen_path()
    form: Literal["linear", "saturating", "step", "wandering"] = "linear"

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        change = drifted(
            self.change, self.form, scene, rng, self.step_at, self.step_frames, self.settling_time, self.course
        )
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
    rivals = ("periodic_modulation", "row_noise", "laser_drift")
    separated_by = "the spectrum of the common mode; a photodiode trace"

    rms: float = parameter(
        0.05, ge=0, le=1, plausible=(0.005, 0.2), unit="", log=True, description="relative rms of the light"
    )
    correlation_frames: float = parameter(
        3.0, gt=0, plausible=(0.7, 12), unit="frames", log=True, description="time within which it forgets itself",
        forms=("relaxing",),
    )  # fmt: skip
    course: tuple[float, ...] = seen_path(("pink",), "light at equal times, mean 0, in units of its rms")
    form: Literal["white", "pink", "relaxing"] = "white"

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        noise = rng.standard_normal(scene.n_frames)
        if self.form == "relaxing":  # Uhlenbeck and Ornstein, Phys. Rev. 36, 823 (1930): begins as it goes on
            kept = np.exp(-1 / self.correlation_frames)
            noise[1:] *= np.sqrt(1 - kept**2)
            noise = signal.lfilter([1.0], [1.0, -kept], noise)
        if self.form == "pink":
            spectrum = np.fft.rfft(noise)
            frequency = np.maximum(np.fft.rfftfreq(scene.n_frames), 1.0 / scene.n_frames)
            noise = np.fft.irfft(spectrum / np.sqrt(frequency), scene.n_frames)
            noise = (noise - noise.mean()) / max(noise.std(), 1e-12)
            if self.course:  # before and after it was seen it flickers as ever
                seen = (scene.elapsed > 0) & (scene.elapsed < 1)
                noise = np.where(seen, told(self.course, scene.elapsed), noise)
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
    rivals = ("laser_flicker", "laser_drift")
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
