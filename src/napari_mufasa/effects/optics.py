"""Optics and background effects (docs/effects.md)."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from napari_mufasa.effects.courses import course, seen_path, told
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

STAGE = "optics and background"


class Astigmatism(Effect):
    kind = "astigmatism"
    stage = STAGE
    strength = "log_ratio"
    title = "Astigmatism"
    what_it_is = "A cylindrical aberration makes the PSF wider along one axis."
    what_it_does = "All spots are elongated alike, from the first frame on."
    how_to_check = "Take a z-series of beads: the long axis flips through focus."
    observables = ("spot_elongation",)
    rivals = ("stage_drift",)
    separated_by = "the shape of early spots; a z-series"

    log_ratio: float = parameter(
        0.25, ge=-2, le=2, plausible=(0.03, 0.5), unit="", log=True,
        description="ln(σ along the axis / σ across it); the product stays",
    )  # fmt: skip
    axis_deg: float = parameter(90.0, plausible=(0, 180), unit="deg", description="the axis; 0 along x, 90 along y")

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        towards_x = np.cos(2 * np.deg2rad(self.axis_deg))  # 1: the axis is x; −1: it is y
        if abs(towards_x) > 1 - 1e-9:
            scene.sigma_px = scene.sigma_px * np.exp(np.array([-0.5, 0.5]) * towards_x * self.log_ratio)
        else:
            turned = self.axis_deg if self.log_ratio >= 0 else self.axis_deg + 90
            scene.sigma_px = scene.sigma_px * np.exp(-abs(self.log_ratio) / 2)
            scene.oblique = (abs(self.log_ratio), float(np.deg2rad(turned)))


class BackgroundGradient(Effect):
    kind = "background_gradient"
    stage = STAGE
    strength = "relative_height"
    title = "Background gradient or haze"
    what_it_is = "Out-of-focus light that is not the same across the field."
    what_it_does = "The background has a slope or a hump; spots are as bright everywhere."
    how_to_check = "Image an empty field; compare spot brightness across the field."
    observables = ("background_map",)
    rivals = ("illumination_profile",)
    separated_by = "spot brightness against position; a flat dye slide"

    relative_height: float = parameter(
        0.4, ge=0, le=10, plausible=(0.03, 1.2), unit="", log=True,
        description="rise along the length of the field's longer side / mean ('linear'), or of the highest place over "
        "the lowest ('hump', 'as_seen')",
    )  # fmt: skip
    direction_deg: float = bright_side(forms=("linear",))
    centre_y: float = centre_along("y", "hump")
    centre_x: float = centre_along("x", "hump")
    width: float = gaussian_width("hump")
    seen: tuple[float, ...] = seen_values()
    seen_columns: int = value_columns()
    form: Literal["linear", "hump", "as_seen"] = "linear"

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        angle = np.deg2rad(self.direction_deg)
        hump = gaussian(scene, (self.centre_y, self.centre_x), self.width)

        def shape(y: Array, x: Array) -> Array:
            v, u = scene.centred(y, x)
            if self.seen and self.form == "as_seen":
                rise = relief(self.seen, self.seen_columns, scene, y, x)
            elif self.form in ("linear", "as_seen"):  # where nothing was seen
                rise = (u * np.cos(angle) + v * np.sin(angle)) / 2
            else:
                rise = hump(y, x)
            return self.relative_height * rise

        # The background believed is that of the field's mean.
        mean = float(np.mean(scene.over_field(lambda y, x: np.maximum(1 + shape(y, x), 0.0))))
        scene.background_field.append(lambda y, x: np.maximum(1 + shape(y, x), 0.0) / mean)


class BackgroundDecay(Effect):
    kind = "background_decay"
    stage = STAGE
    strength = "fraction"
    title = "Bleaching background"
    what_it_is = "Fluorescence of the medium or the glass bleaches."
    what_it_does = "The background falls; spots keep their level."
    how_to_check = "Pre-bleach the field; a photodiode shows constant light."
    observables = ("background_time",)
    rivals = ("laser_drift", "baseline_drift")
    separated_by = "does the spot level fall too; does the background's variance fall with its mean"

    fraction: float = parameter(
        0.3,
        ge=0,
        le=1,
        plausible=(0.03, 0.7),
        unit="",
        log=True,
        description="share of the background that decays",
    )
    time_constant_movies: float = parameter(
        0.4, gt=0, plausible=(0.1, 1.5), unit="movies", log=True, description="decay time / movie length",
        forms=("exponential",),
    )  # fmt: skip
    course: tuple[float, ...] = seen_path(forms=("as_seen",))
    form: Literal["exponential", "linear", "as_seen"] = "exponential"

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        if self.form == "exponential":
            left = np.exp(-scene.progress / self.time_constant_movies)
        else:
            seen = self.course if self.form == "as_seen" else ()
            gone = np.abs(course("wandering" if seen else "linear", scene, rng, seen=seen))
            left = np.maximum(1 - gone, 0.0)
        scene.background = scene.background * (1 - self.fraction + self.fraction * left)


class BackgroundAsMeasured(Effect):
    kind = "background_as_measured"
    stage = STAGE
    strength = "share"
    common = False
    describes_only = True
    title = "Background as measured"
    what_it_is = "Stray and out-of-focus light of whatever shape and course the movie shows."
    what_it_does = (
        "The background has humps, slopes and transients that no simple law describes; spots keep their level."
    )
    how_to_check = "Image an empty field of the same sample for as long; compare spot brightness across field and time."
    observables = ("background_map", "background_time", "common_mode")
    rivals = ("background_gradient", "background_decay", "illumination_profile", "laser_drift")
    separated_by = "whether spots follow the background's map and course"

    share: float = parameter(
        1.0,
        ge=0,
        le=2,
        plausible=(0.2, 1.2),
        unit="",
        description="how far map and course go: 0 not at all, 1 as given",
    )
    map: tuple[float, ...] = Field(
        (), description="relative background on a grid over the field, row by row, mean 1; () even"
    )
    map_columns: int = Field(1, ge=1, description="columns of that grid")
    course: tuple[float, ...] = Field((), description="relative background at equal times, mean 1; () steady")

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        if self.share == 0:
            return
        if self.map:

            def relative(y: Array, x: Array) -> Array:
                seen = relief(self.map, self.map_columns, scene, y, x)
                return np.maximum(1 + self.share * (seen - 1), 0.0)

            # The background believed is that of the field's and the movie's mean.
            mean = float(np.mean(scene.over_field(relative)))
            if mean > 0:
                scene.background_field.append(lambda y, x: relative(y, x) / mean)
        if self.course:

            def path(elapsed: Array) -> Array:
                return np.maximum(1 + self.share * (told(self.course, elapsed) - 1), 0.0)

            usual = float(scene.over_time(path).mean())
            scene.background = scene.background * path(scene.elapsed) / max(usual, 1e-12)


class PSFHalo(Effect):
    kind = "psf_halo"
    stage = STAGE
    strength = "share"
    common = False
    title = "PSF with a halo"
    what_it_is = "Aberrations or scattering put part of each molecule's light into a wide halo around its spot."
    what_it_does = "Spots have faint skirts beyond the core; their light is all there, their peaks are lower."
    how_to_check = "Average the radial profile of isolated beads out to six times the PSF width."
    observables = ("spot_width_early", "level", "background_map", "peak_quantile")
    rivals = ("focus_drift", "background_gradient")
    separated_by = "the radial profile of isolated bright spots"

    share: float = parameter(
        0.2, ge=0, le=0.95, plausible=(0.05, 0.4), unit="", description="share of a molecule's light in the halo"
    )
    width_ratio: float = parameter(
        2.5, ge=1, le=20, plausible=(2, 3), unit="", description="width of the halo over that of the core"
    )

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        if self.share > 0:
            scene.halo = (self.share, self.width_ratio)


EFFECTS = (Astigmatism, BackgroundGradient, BackgroundDecay, BackgroundAsMeasured, PSFHalo)
