"""The model: everything needed to simulate a movie, typed, validated, JSON in and out (SPEC.md §10).

Models are immutable; ``model.with_values({"optics.psf_fwhm_nm": 320})`` gives a changed copy.
"""

from __future__ import annotations

import difflib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    SerializeAsAny,
    ValidationError,
    model_validator,
)

from napari_mufasa.effects import Effect, effect_class, effect_from_data
from napari_mufasa.errors import MufasaError

Protocol = Literal["PALM", "STORM", "FF", "Blinking"]


class Part(BaseModel):
    """A frozen group of parameters; unknown keys are an error."""

    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True, allow_inf_nan=False)


def _pixel_map(value: Any) -> NDArray[np.float64] | None:
    """A (y, x) map given as an array, nested lists, or the path of a TIFF."""
    if value is None:
        return None
    if isinstance(value, (str, os.PathLike)):
        import tifffile

        if not Path(value).is_file():
            raise ValueError(f"no file {value}; give the path of a 2-D TIFF")
        value = tifffile.imread(value)
    array = np.asarray(value, dtype=np.float64)
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
        description="share of the variance of emitted photons that detection adds its own to; 0 = counted once",
    )
    high_resolution_factor: int | None = Field(
        None,
        ge=1,
        le=64,
        description="render on an L-fold finer grid and sum L×L; null: exact pixel integrals",
    )


class Camera(Part):
    """The detector (SPEC.md §4); maps are (y, x) arrays, nested lists or TIFF paths."""

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

    @model_validator(mode="after")
    def _fits_its_type(self) -> Self:
        if self.type == "EMCCD" and self.em_gain is None:
            raise ValueError("em_gain is missing: an EMCCD needs its electron-multiplying gain (1 … 100000)")
        if self.type != "EMCCD" and self.em_gain not in (None, 1):
            raise ValueError(f"em_gain = {self.em_gain} on a {self.type}: only an EMCCD has one; give null")
        knots = np.asarray(self.cmos_gain_curve, dtype=float)
        if len(knots) < 2 or np.any(np.diff(knots[:, 0]) <= 0) or np.any(np.diff(knots[:, 1]) <= 0):
            raise ValueError("cmos_gain_curve must rise strictly in both columns: a falling curve has no inverse")
        if self.gain_map is not None and np.any(self.gain_map <= 0):
            raise ValueError("gain_map must be positive everywhere")
        if self.variance_map_e2 is not None and np.any(self.variance_map_e2 < 0):
            raise ValueError("variance_map_e2 must not be negative")
        return self


class Sample(Part):
    """Where the molecules are when no positions are given."""

    layout: Literal["random", "grid"] = "random"
    n_molecules: int = Field(50, ge=0, le=10_000_000, description="number of molecules in the field")
    min_distance_px: float = Field(0.0, ge=0, description="smallest distance between molecules (random layout)")


def _effects(value: Any) -> Any:
    if not isinstance(value, (list, tuple)):
        return value
    effects = [_effect(item, f"effects.{i}") for i, item in enumerate(value)]
    kinds = [effect.kind for effect in effects]
    for i, kind in enumerate(kinds):
        if kind in kinds[:i]:
            raise MufasaError(f"effects.{i}: {kind} is in the model already: give one of each kind")
    return effects


def _effect(data: Any, path: str) -> Effect:
    try:
        return effect_from_data(data)
    except ValidationError as error:
        raise MufasaError(explain(error, effect_class(str(data["kind"])), path)) from None
    except ValueError as error:
        raise MufasaError(f"{path}: {error}") from None


class Model(Part):
    """Sample, photophysics, excitation, optics, camera and effects: all a movie needs."""

    protocol: Protocol
    acquisition: Acquisition
    fluorophore: Fluorophore
    excitation: Excitation
    optics: Optics
    camera: Camera
    sample: Sample = Sample()
    effects: Annotated[tuple[SerializeAsAny[Effect], ...], BeforeValidator(_effects)] = ()

    @model_validator(mode="after")
    def _maps_fit_the_detector(self) -> Self:
        for name in ("offset_map_adu", "gain_map", "variance_map_e2"):
            value = getattr(self.camera, name)
            if value is not None and value.shape != tuple(self.acquisition.shape_px):
                raise ValueError(
                    f"camera.{name} has shape {value.shape}, the detector {tuple(self.acquisition.shape_px)}; "
                    "give a map of the detector's shape"
                )
        return self

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Model:
        """Build a model from plain data; raises `MufasaError` naming field, value, range and remedy."""
        try:
            return cls.model_validate(data)
        except ValidationError as error:
            raise MufasaError(explain(error, cls)) from None

    @classmethod
    def from_json(cls, path: str | os.PathLike[str]) -> Model:
        """Read a model.json (SPEC.md §10); raises `MufasaError` in one clear line."""
        try:
            data = json.loads(Path(path).read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise MufasaError(f"no file {path}: give the path of a model.json (see 'presets')") from None
        except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
            raise MufasaError(f"{path} is not readable JSON ({error}): write it anew from 'presets NAME'") from None
        if not isinstance(data, dict):
            raise MufasaError(f"{path} holds a {type(data).__name__}, not a model: see 'presets FF' for the form")
        try:
            return cls.from_dict(data)
        except MufasaError as error:
            raise MufasaError(f"{path}: {error}") from None

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON-ready data."""
        return self.model_dump(mode="json")

    def to_json(self, path: str | os.PathLike[str]) -> None:
        """Write model.json (to a temporary name first, so that nothing is ever half-written)."""
        from napari_mufasa.io import write_text

        write_text(path, json.dumps(self.to_dict(), indent=1) + "\n")

    def with_values(self, values: Mapping[str, Any]) -> Model:
        """A copy with some values changed, named by dotted path, validated anew."""
        data = self.model_dump()
        for path, value in values.items():
            *parents, name = path.split(".")
            target: Any = data
            for parent in parents:
                target = _member(target, parent)
            if not isinstance(target, dict) or name not in target:
                raise MufasaError(f"a model has no {path}: names are those of model.json, as optics.psf_fwhm_nm")
            target[name] = value
        return Model.from_dict(data)

    def with_effects(self, *effects: Effect) -> Model:
        """A copy with further effects; one of a kind already there is replaced."""
        new = {effect.kind for effect in effects}
        kept = tuple(effect for effect in self.effects if effect.kind not in new)
        return self.model_copy(update={"effects": kept + effects})

    @property
    def sigma_px(self) -> float:
        """PSF standard deviation in detector pixels: FWHM / 2.3548 / pixel size."""
        return float(self.optics.psf_fwhm_nm / (2 * np.sqrt(2 * np.log(2))) / self.acquisition.pixel_size_nm)


def _member(target: Any, name: str) -> Any:
    """A part of nested plain data by key or index; None where there is none."""
    if isinstance(target, (list, tuple)) and name.isdecimal() and int(name) < len(target):
        return target[int(name)]
    return target.get(name) if isinstance(target, dict) else None


def explain(error: ValidationError, root: type[BaseModel], prefix: str = "") -> str:
    """One line for the first problem: field, value, what is allowed, remedy. `prefix` is where `root` sits."""
    first = error.errors()[0]
    loc = first["loc"]
    path = ".".join([prefix, *(str(part) for part in loc)] if prefix else [str(part) for part in loc])
    if not loc and not prefix and first["type"] != "value_error":
        path = f"the {root.__name__.lower()}"
    more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
    if first["type"] == "extra_forbidden":
        names = _known_keys(root, loc[:-1])
        near = difflib.get_close_matches(str(loc[-1]), names, n=1, cutoff=0.4)
        hint = f"did you mean {near[0]}? " if near else ""
        return f"unknown key {path}: {hint}known keys here are {', '.join(names)}{more}"
    if first["type"] == "missing":
        names = _known_keys(root, loc)
        needs = f"give an object with {', '.join(names)}" if names else f"give the {_describe(root, loc) or 'value'}"
        return f"{path} is missing: {needs}{more}"
    if first["type"] == "value_error":
        message = str(first["ctx"]["error"])
        return f"{message if not path or path in message else f'{path}: {message}'}{more}"
    description = _describe(root, loc)
    message = first["msg"][:1].lower() + first["msg"][1:]
    return f"{path} = {_short(first.get('input'))}: {message}{f'; {description}' if description else ''}{more}"


def _short(value: Any) -> str:
    text = " ".join(repr(value).split())
    return text if len(text) <= 80 else text[:77] + "…"


def _field(root: type[BaseModel], loc: tuple[int | str, ...]) -> Any:
    current: Any = root
    field = None
    for part in loc:
        if not (isinstance(current, type) and issubclass(current, BaseModel)) or part not in current.model_fields:
            return field
        field = current.model_fields[str(part)]
        current = field.annotation
    return field


def _describe(root: type[BaseModel], loc: tuple[int | str, ...]) -> str:
    """What a field is, and what is allowed: "PSF width in nm (allowed: > 0, ≤ 100000)"."""
    field = _field(root, loc)
    if field is None:
        return ""
    signs = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}
    limits = [
        f"{sign} {getattr(m, name):g}" for m in field.metadata for name, sign in signs.items() if hasattr(m, name)
    ]
    extra = field.json_schema_extra
    unit = str(extra.get("unit", "")) if isinstance(extra, dict) else ""
    allowed = f"allowed: {', '.join(limits)}" if limits else ""
    inside = " ".join(part for part in (allowed, unit) if part)
    return f"{field.description or ''}{f' ({inside})' if inside else ''}".strip()


def _known_keys(root: type[BaseModel], loc: tuple[int | str, ...]) -> list[str]:
    field = _field(root, loc)
    owner = field.annotation if field is not None else root
    return sorted(getattr(owner, "model_fields", {}))
