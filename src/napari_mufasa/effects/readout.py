"""Read-out effects: what amplifier and converter do to a signal, in light and in the dark (docs/effects.md)."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from napari_mufasa.camera.detector import Stack, charge_variance_e2, read_noise_map_e
from napari_mufasa.camera.readout import along_rows, code_begins, noise_along_rows, row_kernel
from napari_mufasa.model.effect import Effect, parameter
from napari_mufasa.model.setup import Camera, Setup
from napari_mufasa.simulate.scene import Scene

STAGE = "camera"
Frames = NDArray[np.int64]
SHORTEST, LONGEST = -0.5, 1.0  # shares that a kernel may have: below −½ later pixels would outweigh the pixel itself


class SerialReadout(Effect):
    kind = "serial_readout"
    stage = STAGE
    strength = "share"
    common = False
    title = "Read-out that mixes neighbours"
    what_it_is = "The amplifier has not settled, or swings back, when the next pixel of the row is read."
    what_it_does = (
        "Each pixel gets a signed share of the ones read before it: noise is correlated along rows, not columns."
    )
    how_to_check = "Correlate neighbours in dark frames and in an even field; read out more slowly."
    observables = ("neighbour_right", "photon_transfer", "background_variance")
    rivals = ("em_excess_noise", "row_noise")
    separated_by = "the signed correlation of neighbours along rows against that along columns; slower read-out"

    share: float = parameter(
        -0.05, ge=SHORTEST, le=LONGEST, plausible=(-0.25, 0.25), unit="",
        description="what later pixels of a row get of a pixel, over what it keeps; negative: a swing back",
    )  # fmt: skip
    tail_px: float = parameter(
        1.0, gt=0, le=20, plausible=(0.4, 4), unit="px", log=True,
        description="how far the share reaches, falling by 1/e in as many pixels", forms=("tail",),
    )  # fmt: skip
    noise_ratio: float = parameter(
        1.0, ge=-5, le=5, plausible=(-1.5, 1.5), unit="",
        description="share of the read noise over that of the signal; noise from behind the amplifier has another",
    )  # fmt: skip
    dark_rows: tuple[float, ...] = Field(
        (), description="correlation of neighbours in dark frames, by distance, as seen: the read noise makes it, and "
        "noise_ratio tells nothing; () where it does",
    )  # fmt: skip
    form: Literal["one_pixel", "tail"] = "one_pixel"

    @classmethod
    def suits(cls, setup: Setup) -> bool:
        return setup.camera.type != "CMOS"  # its columns are read side by side

    def kernel(self, share: float) -> NDArray[np.float64]:
        """What a pixel reads of itself and of the ones read before it: 1 and, in all, `share`."""
        if self.form == "one_pixel":
            return np.array([1.0, share])
        tail = np.exp(-np.arange(int(np.ceil(7 * self.tail_px)) + 1) / self.tail_px)  # cut at 1e-3
        return np.concatenate([[1.0], share * tail / tail.sum()])

    def noise_kernel(self, camera: Camera) -> NDArray[np.float64]:
        """The same of the read noise: where dark frames show it, it has what spurious electrons, which are mixed as
        light is, do not account for."""
        if not self.dark_rows:
            return self.kernel(float(np.clip(self.share * self.noise_ratio, SHORTEST, LONGEST)))
        light = self.kernel(self.share) / (1 + self.share)
        light = np.pad(light, (0, max(len(self.dark_rows) + 1 - len(light), 0)))
        spurious = charge_variance_e2(camera) * np.correlate(light, light, "full")[len(light) - 1 :]
        read = float(np.mean(np.square(read_noise_map_e(camera))))
        seen = np.pad(self.dark_rows, (0, len(light) - 1 - len(self.dark_rows))) * (read + spurious[0])
        return row_kernel((seen - spurious[1:]) / max(read, 1e-9))

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        if self.share == 0:
            return
        # The light keeps its mean, for that is what a conversion factor is made from; the noise its mean and rms,
        # which dark frames tell.
        signal = self.kernel(self.share)
        signal = signal / signal.sum()
        noise = self.noise_kernel(scene.setup.camera)
        noise = noise / np.sqrt(np.sum(noise**2))
        mean_e = np.float32(scene.setup.camera.read_noise_mean_e)
        scene.sensor.amplifier.append(lambda e, frames: along_rows(e, signal))
        scene.sensor.noise.append(lambda e, frames: noise_along_rows(e - mean_e, noise) + mean_e)


class FrameBaseline(Effect):
    kind = "frame_baseline"
    stage = STAGE
    strength = "rms_adu"
    common = False
    title = "Baseline that differs between frames"
    what_it_is = "The camera's offset is not the same in every frame: it alternates between two values, or jitters."
    what_it_does = "Whole frames are a little higher or lower, in light and dark, at the same noise."
    how_to_check = "Plot the mean of each dark frame."
    observables = ("common_mode",)
    rivals = ("laser_flicker", "periodic_modulation", "row_noise", "baseline_drift")
    separated_by = "the means of dark frames; whether spots change with the background"

    rms_adu: float = parameter(
        1.0, ge=0, le=1e4, plausible=(0.1, 10), follows="noise_adu", unit="ADU", log=True,
        description="rms of the frames' offsets about their mean",
    )  # fmt: skip
    form: Literal["alternating", "jitter"] = "alternating"

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        size = self.rms_adu * scene.setup.camera.electrons_per_adu
        first = rng.choice([-1.0, 1.0])  # which of the two offsets the movie happens to begin with

        def add(electrons: Stack, frames: Frames) -> Stack:
            if self.form == "alternating":
                offset = first * (1.0 - 2.0 * (frames % 2))
            else:
                draws = (scene.streams.of("frame baseline", int(f)).standard_normal() for f in frames)
                offset = np.fromiter(draws, np.float64, len(frames))
            raised: Stack = electrons + (size * offset).astype(np.float32)[:, None, None]
            return raised

        scene.sensor.output.append(add)


class ConverterCodes(Effect):
    kind = "converter_codes"
    stage = STAGE
    strength = "unevenness"
    common = False
    title = "Uneven codes of the converter"
    what_it_is = "The steps of the analogue-to-digital converter are not equally wide."
    what_it_does = (
        "Some counts come up more often than their neighbours, in a pattern that repeats with the lower bits."
    )
    how_to_check = "Look at the histogram of counts modulo 32, in light and dark."
    observables = ("digits", "dark_digits")
    rivals = ("column_offset", "em_excess_noise")
    separated_by = "the histogram of counts modulo a power of two"

    unevenness: float = parameter(
        0.15, ge=0, le=1, plausible=(0.02, 0.6), unit="", log=True, description="relative rms of the codes' widths"
    )
    widths: tuple[float, ...] = Field(
        (),
        description="the codes' widths as seen, from code 0 to the period, in any unit; () at random, of period 32",
        json_schema_extra={"forms": ["modulo_32"]},
    )
    form: Literal["modulo_32", "missing_low_bit"] = "modulo_32"

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        if self.unevenness == 0:
            return
        if self.form == "missing_low_bit":  # one of two codes is preferred
            pattern = np.array([1.0, -1.0]) * rng.choice([-1.0, 1.0])
        else:
            pattern = np.array(self.widths) if len(self.widths) > 1 else rng.standard_normal(32)
        scene.sensor.code_begins = code_begins(pattern, self.unevenness)


EFFECTS = (SerialReadout, FrameBaseline, ConverterCodes)
