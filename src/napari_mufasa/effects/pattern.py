"""Camera effects that lie on pixels, columns and rows (docs/effects.md)."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from napari_mufasa.camera.detector import Stack
from napari_mufasa.model.effect import Effect, parameter
from napari_mufasa.simulate.scene import Scene

STAGE = "camera"
Frames = NDArray[np.int64]


def fixed_pattern(form: str, shape_px: tuple[int, int], rng: np.random.Generator) -> NDArray[np.float64]:
    """What differs between pixels for good, of variance 1: (y, x), or (1, x) where whole columns share it.

    "alternating": two read-out channels take odd and even columns; they make most of the variance.
    """
    columns: NDArray[np.float64] = rng.standard_normal((1, shape_px[1]))
    if form == "columns":
        return columns
    if form == "alternating":
        channel = np.where(np.arange(shape_px[1]) % 2, 1.0, -1.0)
        both: NDArray[np.float64] = np.sqrt(0.7) * channel + np.sqrt(0.3) * columns
        return both
    pixels: NDArray[np.float64] = rng.standard_normal(shape_px)
    return pixels if form == "pixels" else np.sqrt(0.5) * (columns + pixels)


class PixelGainVariation(Effect):
    kind = "pixel_gain_variation"
    stage = STAGE
    strength = "rms"
    order = 1  # a pixel's answer to all charge that is born in it
    title = "Pixel response non-uniformity"
    what_it_is = "Pixels answer the same light with different signals."
    what_it_does = "A fixed pattern that grows with the signal."
    how_to_check = "Take a flat field."
    observables = ("pixel_pattern", "pixel_gain")
    rivals = ("column_offset", "hot_pixels")
    separated_by = "whether the pattern scales with the light; dark frames do not show it"

    rms: float = parameter(
        0.05,
        ge=0,
        le=1,
        plausible=(0.005, 0.2),
        unit="",
        log=True,
        description="relative rms of the response",
    )
    form: Literal["pixels", "columns", "columns_and_pixels", "dull_pixels"] = "pixels"

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        dull = self.form == "dull_pixels"
        off = 1 - rng.standard_exponential(scene.shape_px) if dull else fixed_pattern(self.form, scene.shape_px, rng)
        response = np.maximum(1 + self.rms * off, 0.0).astype(np.float32)
        scene.sensor.amplified.append(lambda e, frames: e * response)


class ColumnOffset(Effect):
    kind = "column_offset"
    stage = STAGE
    strength = "rms_adu"
    title = "Fixed offset pattern"
    what_it_is = "Column (or pixel) amplifiers have different offsets."
    what_it_does = "A fixed pattern of stripes, the same with and without light."
    how_to_check = "Average dark frames: the stripes are there."
    observables = ("column_pattern", "pixel_pattern", "dark_pattern")
    rivals = ("pixel_gain_variation",)
    separated_by = "present in dark frames"

    rms_adu: float = parameter(
        3.0, ge=0, plausible=(0.2, 20), follows="noise_adu", unit="ADU", log=True, description="rms of the offsets"
    )
    form: Literal["columns", "pixels", "columns_and_pixels", "alternating"] = "columns"

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        pattern = fixed_pattern(self.form, scene.shape_px, rng)
        offset = (self.rms_adu * scene.setup.camera.electrons_per_adu * pattern).astype(np.float32)
        scene.sensor.output.append(lambda e, frames: e + offset)


class RowNoise(Effect):
    kind = "row_noise"
    stage = STAGE
    strength = "rms_adu"
    title = "Row read-out noise"
    what_it_is = "Read-out electronics add a random offset to each row of each frame."
    what_it_does = "Horizontal streaks that change from frame to frame."
    how_to_check = "Look at single dark frames."
    observables = ("row_noise",)
    rivals = ("laser_flicker",)
    separated_by = "rows independent within a frame"

    rms_adu: float = parameter(
        3.0, ge=0, plausible=(0.2, 20), follows="noise_adu", unit="ADU", log=True, description="rms of the row offsets"
    )
    hit_share: float = parameter(
        0.1, gt=0, le=1, plausible=(0.03, 0.5), unit="", log=True, description="share of rows that are hit",
        forms=("bursts",),
    )  # fmt: skip
    reach_rows: float = parameter(
        2.0, gt=0, le=1000, plausible=(0.5, 20), unit="rows", log=True,
        description="rows after which neighbours' offsets have lost all but 1/e of what they share",
        forms=("drifting_rows",),
    )  # fmt: skip
    form: Literal["rows", "drifting_rows", "bursts"] = "rows"

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        rms, height = self.rms_adu * scene.setup.camera.electrons_per_adu, scene.shape_px[0]
        kept = np.exp(-1 / self.reach_rows)

        def add(electrons: Stack, frames: Frames) -> Stack:
            for i, f in enumerate(frames):
                draw = scene.streams.of("row noise", int(f))
                noise = rms * draw.standard_normal(height)
                if self.form == "drifting_rows":  # each row's offset, of the same rms, keeps a part of the one before
                    noise[1:] *= np.sqrt(1 - kept**2)
                    noise = signal.lfilter([1.0], [1.0, -kept], noise)
                elif self.form == "bursts":  # interference that comes now and then
                    noise *= (draw.random(height) < self.hit_share) / np.sqrt(self.hit_share)
                electrons[i] += noise[:, None].astype(np.float32)
            return electrons

        scene.sensor.output.append(add)


class HotPixels(Effect):
    kind = "hot_pixels"
    stage = STAGE
    strength = "fraction"
    title = "Hot pixels"
    what_it_is = "Leaky pixels collect charge without light."
    what_it_does = "Single bright pixels, narrower than any spot, at fixed places."
    how_to_check = "Take dark frames; cool the camera."
    observables = ("narrow_bright", "dark_tail", "dark_pattern")
    rivals = ("cosmic_rays", "pixel_gain_variation")
    separated_by = "narrower than the PSF, always there, in dark frames too"

    fraction: float = parameter(
        2e-3, ge=0, le=0.5, plausible=(1e-4, 2e-2), unit="", log=True, description="share of pixels that leak"
    )
    electrons: float = parameter(
        10.0, gt=0, plausible=(2, 50), unit="e⁻/frame", log=True, description="mean leak of a hot pixel while it leaks"
    )
    form: Literal["steady", "telegraph"] = "steady"

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        hot = rng.random(scene.shape_px) < self.fraction
        leak = (hot * rng.exponential(self.electrons, scene.shape_px)).astype(np.float32)
        where = np.nonzero(leak)
        on: Any = np.ones((scene.n_frames, len(where[0])), dtype=np.float32)
        if self.form == "telegraph":  # on and off for about twenty frames each
            switches = rng.random(on.shape) < 1 / 20
            on = ((np.cumsum(switches, axis=0) + rng.integers(0, 2, on.shape[1])) % 2).astype(np.float32)

        def add(expected: Stack, frames: Frames) -> Stack:
            expected[:, where[0], where[1]] += leak[where] * scene.of_frames(on, frames)
            return expected

        scene.sensor.expected.append(add)


EFFECTS = (PixelGainVariation, ColumnOffset, RowNoise, HotPixels)
