"""Camera effects: what a real sensor does beyond the ideal one (docs/effects.md); its patterns are in `pattern`.

Electrons here are output electrons unless a name says photoelectrons; strengths are given in units a data
sheet or a dark frame shows.
"""

from __future__ import annotations

from math import cos, floor, pi, sin
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from napari_mufasa.camera.detector import Stack, multiplication_noise
from napari_mufasa.effects import pattern
from napari_mufasa.effects.courses import drifted, seen_path, settling, step_length, step_time, told
from napari_mufasa.model.effect import Effect, parameter
from napari_mufasa.model.setup import Setup
from napari_mufasa.photophysics.rates import excitation_rate
from napari_mufasa.simulate.scene import Scene

STAGE = "camera"
Frames = NDArray[np.int64]


def _gain(scene: Scene) -> float:
    """Charge on its way out per photoelectron: what a register makes of it."""
    camera = scene.setup.camera
    return float(camera.em_gain or 1.0) if camera.type == "EMCCD" else 1.0


def peak_e(setup: Setup) -> float:
    """Photoelectrons per frame of a bright molecule in the pixel it is centred on, roughly."""
    dye, light, optics = setup.fluorophore, setup.excitation, setup.optics
    rate = excitation_rate(dye.extinction_coefficient_per_M_cm, light.power_density_w_per_cm2, light.wavelength_nm)
    collected = optics.collection_efficiency * optics.brightness_correction
    exposure_s, efficiency = setup.acquisition.frame_length_s, setup.camera.quantum_efficiency
    return rate * exposure_s * dye.quantum_yield * collected * efficiency / (2 * np.pi * setup.sigma_px**2)


class EMExcessNoise(Effect):
    kind = "em_excess_noise"
    stage = STAGE
    strength = "excess_noise_factor"
    null_value = 2.0
    title = "Other excess noise than an ideal EM register"
    what_it_is = "The register multiplies with more or less noise than the ideal F² = 2, or in a camera believed a CCD."
    what_it_does = "The variance for a given mean is off, for spots and background alike."
    how_to_check = "Take a photon-transfer series at low and high gain."
    observables = ("photon_transfer", "background_skewness")
    rivals = ("detector_saturation", "triplet_blinking")
    separated_by = "photon-transfer slope and skewness together"

    excess_noise_factor: float = parameter(
        1.4,
        ge=1,
        le=5,
        plausible=(1.0, 3.0),
        unit="",
        description="F² = variance/mean after division by the gain; a CCD has 1",
    )
    form: Literal["gamma", "low_gain"] = "gamma"

    @classmethod
    def suits(cls, setup: Setup) -> bool:
        return setup.camera.type in ("EMCCD", "CCD")  # the EM register of a camera believed a CCD may be on

    @classmethod
    def common_in(cls, setup: Setup) -> bool:
        return setup.camera.type == "EMCCD"

    @classmethod
    def none_at(cls, setup: Setup) -> float:
        return multiplication_noise(setup.camera)

    @classmethod
    def plausible(cls, setup: Setup | None = None) -> dict[str, tuple[float, float, bool]]:
        """A CCD whose EM register is on has no more than that register's F² = 2."""
        found = super().plausible(setup)
        if setup is not None and setup.camera.type == "CCD":
            found[cls.strength] = (1.0, 2.0, False)
        return found

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        scene.sensor.excess_noise_factor = self.excess_noise_factor
        scene.sensor.nothing_lost = self.form == "low_gain"  # as far as F² < 2, which a low gain makes


class ClockInducedCharge(Effect):
    kind = "clock_induced_charge"
    stage = STAGE
    strength = "electrons"
    title = "Clock-induced charge"
    what_it_is = "Clocking the charge makes spurious electrons, before the register or on their way through it."
    what_it_does = "Single-electron events appear in every frame, dark ones too."
    how_to_check = "Take dark frames: the tail of bright single pixels is there without light."
    observables = ("dark_mean", "dark_tail")
    rivals = ("baseline_drift", "background_gradient")
    separated_by = "dark frames only"

    electrons: float = parameter(
        0.05,
        ge=0,
        plausible=(0.003, 0.5),
        unit="e⁻/px/frame",
        log=True,
        description="mean spurious charge added, over the gain",
    )
    growth: float = parameter(
        1.2,
        ge=-2,
        le=2,
        plausible=(-1.8, 1.8),
        unit="",
        description="more of it in the last row than in the first, as a share of the mean: far rows are clocked more",
        forms=("along_columns",),
    )
    form: Literal["before_register", "in_register", "along_columns"] = "before_register"

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        gain = max(_gain(scene), 1.0)
        if self.form != "in_register" or gain == 1.0:
            growth = self.growth if self.form == "along_columns" else 0.0
            middle = 0.5 if scene.field_px[0] > 1 else 0.0
            rows = np.maximum(1 + growth * (scene.down.astype(np.float32) - middle), 0)[:, None]
            scene.sensor.expected.append(lambda e, frames: e + np.float32(self.electrons) * rows)
            return
        mean = (1 - 1 / gain) / np.log(gain)  # of gain^-u: what an electron born at u of the register's length keeps

        def born(electrons: Stack, frames: Frames) -> Stack:
            for i, f in enumerate(frames):
                draw = scene.streams.of("charge in register", int(f))
                n = draw.poisson(self.electrons / mean * electrons[i].size)
                charge = draw.standard_exponential(n) * gain ** draw.random(n)
                where = draw.integers(0, electrons[i].size, n)
                electrons[i] += np.bincount(where, charge, electrons[i].size).reshape(electrons[i].shape)
            return electrons

        scene.sensor.amplified.append(born)


class DetectorSaturation(Effect):
    kind = "detector_saturation"
    stage = STAGE
    strength = "inverse_full_scale"
    order = 3  # of all charge, in its pixel's gain, with what was left behind
    title = "Detector saturation"
    what_it_is = "Full wells and amplifiers bend at high signal."
    what_it_does = "Bright spots have flat tops and too little variance."
    how_to_check = "Take an exposure series: the signal stops growing with time."
    observables = ("photon_transfer", "peak_quantile", "spot_width")
    rivals = ("em_excess_noise",)
    separated_by = "the top bins of the photon-transfer curve"

    inverse_full_scale: float = parameter(
        0.02, ge=0, plausible=(0.003, 0.2), unit="1/e⁻", log=True,
        description="1 / (photoelectrons per pixel at which the response has bent by its form)",
    )  # fmt: skip
    form: Literal["soft", "hard", "rounded"] = "soft"

    @classmethod
    def plausible(cls, setup: Setup | None = None) -> dict[str, tuple[float, float, bool]]:
        """The range is for a molecule of 10 photoelectrons in its brightest pixel, and follows that of the set-up."""
        found = super().plausible(setup)
        if setup is not None:
            low, high, log = found[cls.strength]
            factor = 1 / (max(peak_e(setup), 1.0) / 10.0)
            found[cls.strength] = (low * factor, high * factor, log)
        return found

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        if self.inverse_full_scale == 0:
            return
        full = np.float32(_gain(scene) / self.inverse_full_scale)

        def bend(electrons: Stack, frames: Frames) -> Stack:
            if self.form == "hard":
                return np.minimum(electrons, full)
            if self.form == "rounded":
                return np.asarray(full * np.tanh(electrons / full), np.float32)
            bent: Stack = (electrons / (1 + np.maximum(electrons, 0) / full)).astype(np.float32)
            return bent

        scene.sensor.amplified.append(bend)


class ImageLag(Effect):
    kind = "image_lag"
    stage = STAGE
    strength = "fraction"
    order = 2  # of all charge, wherever it was born
    title = "Image lag"
    what_it_is = "Some charge of a frame is read with the next ones."
    what_it_does = "Every pixel remembers its last value; a vanished spot leaves a shadow."
    how_to_check = "Flash the light: the first dark frame is not dark."
    observables = ("pixel_lag", "autocorrelation")
    rivals = ("triplet_blinking",)
    separated_by = "lag-1 correlation of pixels without molecules"

    fraction: float = parameter(
        0.05,
        ge=0,
        le=0.9,
        plausible=(0.005, 0.3),
        unit="",
        log=True,
        description="share of charge left behind",
    )
    kept: float = parameter(
        0.5, ge=0, le=0.95, plausible=(0.1, 0.8), unit="per frame",
        description="share of the charge left behind that stays for another frame", forms=("decaying",),
    )  # fmt: skip
    form: Literal["one_frame", "decaying"] = "one_frame"

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        # Charge older than `depth` frames counts as `depth` frames old; usually it is 1e-4 of the signal.
        depth = 1
        kept = np.float32(self.kept if self.form == "decaying" else 0.0)
        if kept > 0 and self.fraction > 0:
            depth = int(np.clip(np.ceil(np.log(1e-4 / self.fraction) / np.log(kept)), 1, 40))
        scene.sensor.memory_frames = max(scene.sensor.memory_frames, depth)
        f = np.float32(self.fraction)

        def lag(electrons: Stack, frames: Frames) -> Stack:
            result = (1 - f) * electrons
            for back in range(1, depth + 1):
                weight = f * kept ** (back - 1) * (1 if back == depth else 1 - kept)  # the last takes the rest
                result[back:] += weight * electrons[: max(0, len(electrons) - back)]
            return result

        scene.sensor.amplified.append(lag)


class BaselineDrift(Effect):
    kind = "baseline_drift"
    stage = STAGE
    strength = "drift_adu"
    title = "Baseline drift"
    what_it_is = "The camera's offset wanders with temperature."
    what_it_does = "The mean of every pixel moves; its variance does not."
    how_to_check = "Watch dark or shaded pixels over time."
    observables = ("background_time", "dark_trend")
    rivals = ("background_decay", "laser_drift")
    separated_by = "variance against mean over time; overscan or dark frames"

    drift_adu: float = parameter(
        8.0,
        ge=-1e4,
        le=1e4,
        plausible=(-40, 40),
        follows="noise_adu",
        unit="ADU",
        description="change from first to last frame",
    )
    step_at: float = step_time()
    step_frames: float = step_length()
    settling_time: float = settling()
    in_dark: float = Field(
        1.0,
        ge=0,
        le=1,
        description="its share in dark frames: 1 they were taken just before the movie, 0 apart from it",
    )
    course: tuple[float, ...] = seen_path()
    dark_course: tuple[float, ...] = Field(
        (),
        description="ADU at equal times of the dark frames, 0 where the movie begins; () at random",
        json_schema_extra={"forms": ["wandering"]},
    )
    form: Literal["linear", "saturating", "step", "wandering"] = "linear"

    def in_the_dark(self) -> Effect:
        """A baseline that wanders does so in dark frames, too, but along a path that the movie does not show."""
        return self.model_copy(update={"course": (), "drift_adu": self.in_dark * self.drift_adu})

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        drift_adu = drifted(
            self.drift_adu, self.form, scene, rng, self.step_at, self.step_frames, self.settling_time,
            self.course,
        )  # fmt: skip
        if self.form == "wandering" and self.dark_course and not self.course:  # see `in_the_dark`
            before = scene.elapsed < 0
            frames = np.arange(before.sum()) + 0.5
            drift_adu[before] = self.in_dark * told(self.dark_course, frames / len(frames))
        offset_e = (drift_adu * scene.setup.camera.electrons_per_adu).astype(np.float32)
        scene.sensor.output.append(lambda e, frames: e + scene.of_frames(offset_e, frames)[:, None, None])


TRACK_PX = 7  # of a particle's track at most


class CosmicRays(Effect):
    kind = "cosmic_rays"
    stage = STAGE
    strength = "hits_per_frame"
    title = "Cosmic rays"
    what_it_is = "Charged particles hit the sensor."
    what_it_does = "Single pixels or short tracks flash in one frame only."
    how_to_check = "Take long dark series; hits never repeat."
    observables = ("single_frame_outliers", "dark_tail")
    rivals = ("hot_pixels",)
    separated_by = "they never repeat at the same pixel"

    hits_per_frame: float = parameter(
        0.05,
        ge=0,
        plausible=(0.005, 1.0),
        unit="1/frame",
        log=True,
        description="hits per frame on the field that effects speak of",
    )
    electrons: float = parameter(
        400.0, gt=0, plausible=(100, 2000), unit="e⁻", log=True, description="mean photoelectrons of a hit"
    )
    form: Literal["points", "tracks"] = "points"

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        gain, shape = _gain(scene), np.array(scene.shape_px)
        margin = TRACK_PX if self.form == "tracks" else 0  # tracks come in from outside
        hits_per_frame = self.hits_per_frame * np.prod(shape + 2 * margin) / np.prod(scene.field_px)

        def hit(electrons: Stack, frames: Frames) -> Stack:
            for i, f in enumerate(frames):
                draw = scene.streams.of("cosmic rays", int(f))
                for _ in range(draw.poisson(hits_per_frame)):
                    charge = draw.exponential(self.electrons) * gain
                    y, x = draw.random(2) * (shape + 2 * margin) - margin
                    length = 1 if self.form == "points" else int(draw.integers(2, TRACK_PX + 1))
                    angle = draw.uniform(0, 2 * pi)
                    for step in range(length):
                        r, c = floor(y + step * sin(angle)), floor(x + step * cos(angle))
                        if 0 <= r < shape[0] and 0 <= c < shape[1]:
                            electrons[i, r, c] += charge / length
            return electrons

        scene.sensor.amplified.append(hit)


EFFECTS = (
    EMExcessNoise, ClockInducedCharge, *pattern.EFFECTS, DetectorSaturation, ImageLag, BaselineDrift, CosmicRays,
)  # fmt: skip
