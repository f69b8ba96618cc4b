"""The set-up: acquisition, fluorophore, light, optics, camera, sample, typed and validated.

It lies below the physics: photophysics, optics and camera read their numbers here. Effects and the whole `Model` lie
above them.
"""

from __future__ import annotations

import os
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_core import PydanticCustomError

from napari_mufasa.files.movies import load

Protocol = Literal["PALM", "STORM", "FF", "Blinking"]
NUMBERS = (int, float, int | None, float | None)
MAPS = ("offset_map_adu", "gain_map", "variance_map_e2")  # a camera's maps of its pixels


class Values(BaseModel):
    """Frozen values; unknown keys are an error, and so is text where a number belongs."""

    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True, allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _numbers_are_no_text(cls, value: Any, info: ValidationInfo) -> Any:
        if isinstance(value, (str, bool)) and cls.model_fields[info.field_name or ""].annotation in NUMBERS:
            raise PydanticCustomError("no_number", "input should be a number, without quotes")
        return value


class Part(Values):
    """A frozen group of parameters."""


def _pixel_map(value: Any) -> NDArray[np.float64] | None:
    """A (y, x) map given as an array, nested lists, or the path of a TIFF."""
    if value is None:
        return None
    if isinstance(value, (str, os.PathLike)):
        value = load(value)
        value = value[0] if len(value) == 1 else value
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ValueError("needs a finite 2-D (y, x) map of numbers, or the path of a 2-D TIFF") from None
    if array.ndim != 2 or not np.isfinite(array).all():
        raise ValueError(f"needs a finite 2-D (y, x) map, got shape {array.shape}")
    return array


PixelMap = Annotated[
    Any,
    BeforeValidator(_pixel_map),
    PlainSerializer(lambda a: None if a is None else a.tolist(), when_used="json"),
]


class Acquisition(Part):
    """How the movie was taken."""

    n_frames: int = Field(ge=1, le=10_000_000, description="number of frames")
    frame_length_s: float = Field(gt=0, le=3600, description="exposure time of a frame in s")
    frame_interval_s: float | None = Field(
        None, gt=0, description="time from frame start to frame start in s; null: no dead time"
    )
    pixel_size_nm: float = Field(gt=0, le=1e5, description="pixel size in the sample in nm")
    shape_px: tuple[Annotated[int, Field(ge=1, le=65536)], Annotated[int, Field(ge=1, le=65536)]] = Field(
        description="detector shape (height, width) in pixels"
    )

    @model_validator(mode="after")
    def _interval_holds_the_exposure(self) -> Self:
        if self.frame_interval_s is not None and self.frame_interval_s < self.frame_length_s:
            raise ValueError(
                f"frame_interval_s = {self.frame_interval_s} is shorter than frame_length_s = "
                f"{self.frame_length_s}; give null or at least the exposure time"
            )
        return self

    @property
    def interval_s(self) -> float:
        return self.frame_length_s if self.frame_interval_s is None else self.frame_interval_s


class Fluorophore(Part):
    """The molecule; ``null`` switches a transition off."""

    extinction_coefficient_per_M_cm: float = Field(gt=0, le=1e7, description="ε at the excitation, 1/(M cm)")
    lifetime_s: float = Field(gt=0, le=1e-3, description="excited-state lifetime τ in s")
    quantum_yield: float = Field(1.0, gt=0, le=1, description="photons per relaxation")
    cycles_before_bleaching: float | None = Field(None, gt=0, description="mean cycles N_c; null: no bleaching")
    isc_ratio: float | None = Field(None, ge=0, le=1, description="α_isc = k1T / k10; null: no triplet")
    triplet_decay_rate_per_s: float | None = Field(None, ge=0, description="kT0 in 1/s")


class Excitation(Part):
    """The light."""

    wavelength_nm: float = Field(ge=100, le=5000, description="excitation wavelength in nm")
    power_density_w_per_cm2: float = Field(ge=0, le=1e9, description="power density at the sample, W/cm²")
    activation_rate_per_s: float | None = Field(None, ge=0, description="kNA in 1/s (PALM only)")


class Optics(Part):
    """From emitted photons to photons on the detector."""

    psf_fwhm_nm: float = Field(gt=0, le=1e5, description="full width at half maximum of the PSF in nm")
    collection_efficiency: float = Field(1.0, gt=0, le=1, description="share of photons that reach the detector")
    background_photons_per_px: float = Field(0.0, ge=0, le=1e7, description="photons per pixel and frame")
    brightness_correction: float = Field(
        1.0,
        gt=0,
        le=1e6,
        description="fitted factor on the brightness believed (power × collection); 1 = as believed",
    )
    emission_noise: float = Field(
        1.0,
        ge=0,
        le=1,
        description="share of the variance of emitted photons that detection adds its own to; 0 = counted once; "
        "below 1 for the fast engine only",
    )
    high_resolution_factor: int | None = Field(
        None,
        ge=1,
        le=64,
        description="render on an L-fold finer grid and sum L×L; null: exact pixel integrals",
    )


class Camera(Part):
    """The detector (docs/camera.md); maps are (y, x) arrays, nested lists or TIFF paths."""

    type: Literal["CCD", "EMCCD", "CMOS"]
    quantum_efficiency: float = Field(gt=0, le=1, description="photoelectrons per photon")
    read_noise_e: float = Field(ge=0, le=1e6, description="read noise in electrons rms at the output")
    clock_induced_charge_e: float = Field(0.0, ge=0, le=1e6, description="electrons per pixel and frame")
    electrons_per_adu: float = Field(gt=0, le=1e6, description="output electrons per digital count")
    baseline_adu: float = Field(ge=0, le=2**32, description="offset in digital counts")
    adc_max: int = Field(65535, ge=1, le=65535, description="largest digital count (uint16 movies)")
    em_gain: float | None = Field(None, ge=1, le=1e5, description="electron-multiplying gain; EMCCD only")
    read_noise_mean_e: float = Field(0.0, description="mean μ of the read noise in electrons")
    cmos_gain_curve: tuple[tuple[float, float], ...] = Field(
        ((0.0, 0.0), (200.0, 180.0), (1000.0, 500.0), (2000.0, 600.0)),
        description="CMOS g_p as (electrons in, electrons out) knots; continued with the last slope",
    )
    offset_map_adu: PixelMap = Field(None, description="per-pixel offset added to the baseline, ADU")
    gain_map: PixelMap = Field(None, description="per-pixel factor on the gain")
    variance_map_e2: PixelMap = Field(None, description="per-pixel read noise variance, electrons²")
    excess_noise_factor: float | None = Field(
        None, ge=1, le=10, description="F² of the register, EMCCD only; null: 2, as at high gain"
    )
    readout_kernel: tuple[Annotated[float, Field(ge=-1, le=1)], ...] = Field(
        (), max_length=16, description="signal of the pixels read before, as shares of a pixel's own: x − 1, x − 2 …"
    )
    read_noise_kernel: tuple[Annotated[float, Field(ge=-1, le=1)], ...] = Field(
        (), max_length=16, description="the same of the read noise, which keeps its rms"
    )
    baseline_alternation_adu: float = Field(
        0.0, ge=-1e4, le=1e4, description="baseline of frames 0, 2, 4 … above the mean, of the others below, ADU"
    )
    baseline_jitter_adu: float = Field(0.0, ge=0, le=1e4, description="rms of each frame's own baseline, ADU")
    code_widths: tuple[Annotated[float, Field(ge=0)], ...] = Field(
        (), max_length=4096, description="widths of the converter's codes over a period, any unit; (): all equal"
    )

    @model_validator(mode="after")
    def _fits_its_type(self) -> Self:
        if self.type == "EMCCD" and self.em_gain is None:
            raise ValueError("em_gain is missing: an EMCCD needs its electron-multiplying gain (1 … 100000)")
        if self.type != "EMCCD" and self.em_gain not in (None, 1):
            raise ValueError(f"em_gain = {self.em_gain} on a {self.type}: only an EMCCD has one; give null")
        if self.type != "EMCCD" and self.excess_noise_factor is not None:
            raise ValueError(f"excess_noise_factor on a {self.type}: only an EMCCD has a register; give null")
        if self.readout_kernel and not np.all(np.abs(np.roots([1.0, *self.readout_kernel])) < 0.999):
            raise ValueError("readout_kernel gives more to later pixels than a pixel keeps: it cannot be undone")
        if self.code_widths and (len(self.code_widths) < 2 or sum(self.code_widths) <= 0):
            raise ValueError("code_widths needs two or more widths, not all 0; or give none")
        knots = np.asarray(self.cmos_gain_curve, dtype=float)
        if len(knots) < 2 or np.any(np.diff(knots[:, 0]) <= 0) or np.any(np.diff(knots[:, 1]) <= 0):
            raise ValueError("cmos_gain_curve must rise strictly in both columns: a falling curve has no inverse")
        if self.gain_map is not None and np.any(self.gain_map <= 0):
            raise ValueError("gain_map must be positive everywhere")
        if self.variance_map_e2 is not None and np.any(self.variance_map_e2 < 0):
            raise ValueError("variance_map_e2 must not be negative")
        if self.baseline_adu >= self.adc_max:
            raise ValueError(
                f"baseline_adu = {self.baseline_adu:g} is not below adc_max = {self.adc_max}: give the camera's values"
            )
        return self

    def of_part(self, rows: slice, columns: slice) -> Self:
        """The camera as a part of its field has it: maps of pixels are cropped."""
        maps = {name: getattr(self, name) for name in MAPS}
        cropped = {name: None if pixels is None else pixels[rows, columns] for name, pixels in maps.items()}
        return self.model_copy(update=cropped)


class Sample(Part):
    """Where the molecules are when no positions are given."""

    layout: Literal["random", "grid"] = "random"
    n_molecules: int = Field(50, ge=0, le=10_000_000, description="number of molecules in the field")
    min_distance_px: float = Field(0.0, ge=0, description="smallest distance between molecules (random layout)")


class Setup(Part):
    """Sample, photophysics, excitation, optics, camera: what is believed of an instrument, without effects."""

    protocol: Protocol
    acquisition: Acquisition
    fluorophore: Fluorophore
    excitation: Excitation
    optics: Optics
    camera: Camera
    sample: Sample = Sample()

    @model_validator(mode="after")
    def _maps_fit_the_detector(self) -> Self:
        for name in MAPS:
            value = getattr(self.camera, name)
            if value is not None and value.shape != tuple(self.acquisition.shape_px):
                raise ValueError(
                    f"camera.{name} has shape {value.shape}, the detector {tuple(self.acquisition.shape_px)}; "
                    "give a map of the detector's shape"
                )
        return self

    @property
    def sigma_px(self) -> float:
        """PSF standard deviation in detector pixels: FWHM / 2.3548 / pixel size."""
        return float(self.optics.psf_fwhm_nm / (2 * np.sqrt(2 * np.log(2))) / self.acquisition.pixel_size_nm)
