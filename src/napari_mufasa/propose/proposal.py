"""A first model from a movie: metadata, calibration, spots, traces → what to believe, with what could not be known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_mufasa import checks
from napari_mufasa.calibrate.found import Calibration
from napari_mufasa.calibrate.known import Known
from napari_mufasa.calibrate.measure import CameraType, calibrate, check_given
from napari_mufasa.calibrate.value import NORMAL, Value
from napari_mufasa.errors import MufasaError
from napari_mufasa.files.instrument import Instrument
from napari_mufasa.model.model import Model
from napari_mufasa.photophysics import rates
from napari_mufasa.propose.light import Seen, seen_in
from napari_mufasa.propose.written import camera_told

if TYPE_CHECKING:
    from napari_mufasa.model.setup import Camera

FWHM = 2 * np.sqrt(2 * np.log(2))
FULL_WELL_E = 1e6  # photoelectrons that no pixel holds
#: What is taken where nothing tells.
ASSUMED = {"pixel_size_nm": 100.0, "frame_length_s": 0.1, "wavelength_nm": 532.0}
DYE = {"extinction_coefficient_per_M_cm": 100_000.0, "lifetime_s": 3e-9, "quantum_yield": 0.6}
COLLECTION = 0.1
MOST_EXCITED = 0.009  # share of the time in S1 up to which the fast engine may simulate
BLOCK_FRAMES = 64
LEAST_FRAMES = 4  # of which noise and signal can be told apart
PLAIN_FRAMES = 50  # that tell the darkest level where nothing else can be measured


@dataclass(frozen=True)
class Proposal(Known):
    """A believed model, and how far each of its values is known.

    Attributes
    ----------
    model : ready to simulate and to diagnose from
    values : by name, as docs/model.md has it or in words of their own (on_level_e …), each with its 95 % interval
    unknown : by name, why a value could not be known and what was taken instead
    notes : what else the user should know
    calibration : of the camera; None where it could not be measured
    """

    instrument: Instrument
    calibration: Calibration | None

    def report(self) -> dict[str, Any]:
        """Plain data."""
        calibration = None if self.calibration is None else self.calibration.report()
        return super().report() | {"metadata": self.instrument.known(), "calibration": calibration}


def propose_model(
    movie: Any,
    dark: Any = None,
    *,
    instrument: Instrument | None = None,
    camera_type: CameraType | None = None,
    em_gain: float | None = None,
    electrons_per_adu: float | None = None,
    quantum_efficiency: float = 0.9,
    pixel_size_nm: float | None = None,
    frame_length_s: float | None = None,
    progress: Callable[[int, int], None] | None = None,
    cancel: Callable[[], bool] | None = None,
) -> Proposal:
    """A first believed model for a movie (frame, y, x) of ADU and, if there are any, its dark frames.

    instrument : what the recording software wrote (`files.instrument.read_instrument`)
    camera_type … frame_length_s : what is known, instead of metadata, measurement or assumption; without a type an EM
        gain above 1 says EMCCD, else the histogram does, and the counts that a photoelectron makes; a name of a camera
        with a register, or a gain that is not said to be its, does not

    Raises
    ------
    MufasaError : a movie that cannot be used or has fewer than `LEAST_FRAMES` frames, values that cannot be.
    """
    movie = checks.stack(movie)
    if movie.shape[0] < LEAST_FRAMES:
        frames = checks.counted(int(movie.shape[0]), "frame")
        raise MufasaError(f"the movie has {frames}: give {LEAST_FRAMES} or more to propose a model from")
    dark = None if dark is None else checks.stack(dark, "dark")
    written = instrument or Instrument()
    known, gain, notes = camera_told(written, camera_type, em_gain)
    check_given(known or "EMCCD", gain, electrons_per_adu, quantum_efficiency)
    for name, value in (("pixel_size_nm", pixel_size_nm), ("frame_length_s", frame_length_s)):
        if value is not None:
            checks.number(value, name, 1e-9, 1e9)
    unknown: dict[str, str] = {}
    asked = {
        "em_gain": gain, "electrons_per_adu": electrons_per_adu,
        "quantum_efficiency": quantum_efficiency,
        "adc_max": _adc_max(movie, written.bit_depth, notes),
    }  # fmt: skip
    camera, found = _camera(movie, dark, known, asked, unknown, notes, cancel)
    timing = _timing(movie, written, pixel_size_nm, frame_length_s, unknown)
    seen = seen_in(_lit(movie, found), camera, dark, *_doubts(found), progress=progress, cancel=cancel)
    notes += seen.traces.notes
    if seen.width_from == "short runs":
        notes.append(
            f"molecules move: in a few frames they are {seen.psf_sigma_px.value:.2f} px wide, in the mean of the movie "
            f"{seen.traces.sigma_px:.2f} px; the former is taken"
        )
    if seen.width_from == "fluctuations" and np.isfinite(seen.psf_sigma_px.value):
        notes.append(
            "too few spots stand alone: the PSF's width is that of what neighbouring pixels change by together"
        )
    model = _model(camera, timing, written.wavelength_nm or ASSUMED["wavelength_nm"], seen, unknown)
    values = _values(found, seen, timing, model)
    return Proposal(model, values, unknown, tuple(notes), written, found)


def _lit(movie: Any, found: Calibration | None) -> Any:
    """The movie without its unlit ends, from an even frame on: the baseline of odd ones may differ."""
    if found is None or not (found.leading_dark or found.trailing_dark):
        return movie
    first = found.leading_dark + found.leading_dark % 2
    return checks.unread(movie)[first : movie.shape[0] - found.trailing_dark]


def _adc_max(movie: Any, bit_depth: int | None, notes: list[str]) -> int:
    """The largest count that the metadata say, unless the movie has larger ones."""
    most = 2**bit_depth - 1 if bit_depth is not None and bit_depth < 16 else 65535
    blocks = range(0, movie.shape[0], BLOCK_FRAMES) if most < 65535 else ()
    if any(np.asarray(movie[start : start + BLOCK_FRAMES]).max() > most for start in blocks):
        notes.append(f"the metadata say {bit_depth} bits, but the movie has counts above {most}: 16 bits are taken")
        return 65535
    return most


def _camera(
    movie: Any, dark: Any, kind: CameraType | None, asked: dict[str, Any], unknown: dict[str, str], notes: list[str],
    cancel: Callable[[], bool] | None,
) -> tuple[Camera, Calibration | None]:  # fmt: skip
    given = asked if kind in (None, "EMCCD") else asked | {"em_gain": None}
    try:
        found = calibrate(movie, dark, camera_type=kind, cancel=cancel, **given)
        kind = found.camera.type
        if found.type_untold is not None:
            unknown["camera.type"] = found.type_untold
        light_e = abs(float(np.mean(movie[:8])) - found.baseline_adu.value) / max(
            found.adu_per_photoelectron.value, 1e-12
        )
        if light_e > FULL_WELL_E:
            raise MufasaError(f"its noise would mean {light_e:.1g} photoelectrons in every pixel")
    except MufasaError as error:
        kind = kind or "CCD"
        unknown["camera"] = f"could not be measured ({error}); {kind} with one electron per count is taken"
        unknown["optics.background_photons_per_px"] = "without the camera, counts are no photons"
        return _plain_camera(movie, dark, kind, asked), None
    notes += [note for note in found.notes if note != found.type_untold]
    if not found.law_holds:
        notes.append(
            f"test of fit of the camera: p = {found.p_value:.2g}: its law is not all there is, and its intervals may "
            "be too narrow"
        )
    if kind == "EMCCD" and asked["em_gain"] in (None, 1) and asked["electrons_per_adu"] is None:
        unknown["camera.em_gain"] = "only gain over electrons per count shows in a movie; gain 300 is taken"
    unknown["camera.quantum_efficiency"] = f"does not show in a movie; {asked['quantum_efficiency']:g} is taken"
    low, high = found.adu_per_photoelectron.interval
    if not 0 < low < high < 4 * low:
        unknown["camera.electrons_per_adu"] = "the movie has too little light for its noise: record an even, lit field"
    return found.camera, found


def _plain_camera(movie: Any, dark: Any, kind: CameraType, asked: dict[str, Any]) -> Camera:
    """Where nothing can be measured: the darkest level there is, and one electron a count."""
    from napari_mufasa.model.setup import Camera

    name = "movie" if dark is None else "dark"
    stack = np.asarray((movie if dark is None else dark)[:PLAIN_FRAMES]).astype(np.float64)
    if not np.isfinite(stack).all():
        raise MufasaError(f"{name} has values that are not finite: mask or crop those frames first")
    if stack.min() < 0:
        raise MufasaError(f"{name} holds negative counts ({stack.min():g}): give the camera's raw counts (ADU)")
    if stack.min() >= asked["adc_max"]:
        raise MufasaError(
            f"every pixel of {name} is saturated (at {asked['adc_max']} or above): record with less light"
        )
    level = float(stack.mean()) if dark is not None else float(np.percentile(stack.mean(axis=0), 0.1))
    noise = float(np.sqrt(np.median(stack.var(axis=0)))) if len(stack) > 3 else 1.0
    gain = float(asked["em_gain"] or 300.0) if kind == "EMCCD" else None
    per_adu = float(asked["electrons_per_adu"] or 1.0)
    return Camera(
        type=kind, quantum_efficiency=asked["quantum_efficiency"], read_noise_e=noise * per_adu,
        electrons_per_adu=per_adu, baseline_adu=level + 0.5, em_gain=gain, adc_max=asked["adc_max"],
        **({"cmos_gain_curve": ((0.0, 0.0), (1.0, 1.0))} if kind == "CMOS" else {}),
    )  # fmt: skip


def _timing(
    movie: Any, written: Instrument, pixel_size_nm: float | None, frame_length_s: float | None, unknown: dict[str, str]
) -> dict[str, Any]:
    size = pixel_size_nm or written.pixel_size_nm
    length = frame_length_s or written.exposure_s or written.interval_s
    if size is None:
        unknown["acquisition.pixel_size_nm"] = f"not in the metadata; {ASSUMED['pixel_size_nm']:g} nm is taken"
    if length is None:
        unknown["acquisition.frame_length_s"] = f"not in the metadata; {ASSUMED['frame_length_s']:g} s is taken"
    length = length or ASSUMED["frame_length_s"]
    interval = written.interval_s if written.interval_s is not None and written.interval_s > length else None
    return {
        "n_frames": int(movie.shape[0]), "frame_length_s": length, "frame_interval_s": interval,
        "pixel_size_nm": size or ASSUMED["pixel_size_nm"], "shape_px": tuple(int(n) for n in movie.shape[1:]),
    }  # fmt: skip


def _doubts(found: Calibration | None) -> tuple[float, float]:
    """Relative sd of the gain, and sd of the baseline in photoelectrons."""
    if found is None:
        return 1.0, 0.0
    per_electron = found.adu_per_photoelectron
    base = found.baseline_adu.sd / per_electron.value if np.isfinite(found.baseline_adu.sd) else 0.0
    return float(per_electron.sd / per_electron.value), float(base)


def _model(camera: Camera, timing: dict[str, Any], wavelength_nm: float, seen: Seen, unknown: dict[str, str]) -> Model:
    """What was seen as rates and powers that give it; dye and light are not known apart from their product."""
    level = seen.on_level_e.value
    if not np.isfinite(level) or level <= 0:
        unknown["excitation.power_density_w_per_cm2"] = "too few isolated spots to tell their brightness"
        level = 100.0
    per_cycle = DYE["quantum_yield"] * COLLECTION * camera.quantum_efficiency
    excited_s = level / (per_cycle * timing["frame_length_s"]) * DYE["lifetime_s"]  # of each second
    share = min(excited_s, MOST_EXCITED)
    # Where that dye would be near saturation, one that cycles faster.
    dye = DYE | {"lifetime_s": DYE["lifetime_s"] * share / excited_s}
    k01 = rates.relaxation_rate(dye["lifetime_s"]) * share / (1 - share)
    power = k01 / rates.excitation_rate(dye["extinction_coefficient_per_M_cm"], 1.0, wavelength_nm)
    unknown["fluorophore"] = (
        "dye, wavelength, power and collection show only as their product, photons per frame: a typical dye is taken"
    )
    interval = timing["frame_interval_s"] or timing["frame_length_s"]
    cycles = isc = decay = None
    if np.isfinite(seen.bleaching_per_frame.value) and seen.bleaching_per_frame.value > 0:
        cycles = k01 * interval / seen.bleaching_per_frame.value
    elif not np.isfinite(seen.bleaching_per_frame.value):
        unknown["fluorophore.cycles_before_bleaching"] = "too few molecules to tell; no bleaching is taken"
    if np.isfinite(seen.off_per_frame.value):
        isc = min(seen.off_per_frame.value / interval / k01, 1.0)
        decay = 1 / (seen.dark_frames.value * interval)
    if not np.isfinite(seen.psf_sigma_px.value):
        unknown["optics.psf_fwhm_nm"] = "too few isolated spots; the width of the brightest is taken"
    sigma = seen.psf_sigma_px.value if np.isfinite(seen.psf_sigma_px.value) else seen.traces.sigma_px
    if not np.isfinite(seen.n_molecules.value):
        unknown["sample.n_molecules"] = "no molecules were found; 50 is taken"
    number = seen.n_molecules.value if np.isfinite(seen.n_molecules.value) else 50
    background = (seen.background_e.value - camera.clock_induced_charge_e) / camera.quantum_efficiency
    return Model.from_dict(
        {
            "protocol": "FF" if isc is None else "Blinking",
            "acquisition": timing,
            "fluorophore": dye
            | {"cycles_before_bleaching": cycles, "isc_ratio": isc, "triplet_decay_rate_per_s": decay},
            "excitation": {"wavelength_nm": wavelength_nm, "power_density_w_per_cm2": power},
            "optics": {
                "psf_fwhm_nm": FWHM * sigma * timing["pixel_size_nm"],
                "collection_efficiency": COLLECTION,
                "background_photons_per_px": max(background, 0.0),
            },
            "camera": camera.model_dump(),
            "sample": {"n_molecules": round(number)},
        }
    )


def _product(one: Value, other: Value) -> Value:
    """With the relative errors of both; a given number has none."""
    value = one.value * other.value
    share = float(np.hypot(*np.nan_to_num([one.sd / one.value, other.sd / other.value]))) if value else 0.0
    shares = [np.nan_to_num(np.subtract(v.interval, v.value) / v.value) for v in (one, other) if v.value]
    low = float(np.sqrt(sum(s[0] ** 2 for s in shares)))
    high = float(np.sqrt(sum(s[1] ** 2 for s in shares)))
    return Value(value, value * share, max(value * (1 - low), 0.0), value * (1 + max(high, NORMAL * share)))


def _values(found: Calibration | None, seen: Seen, timing: dict[str, Any], model: Model) -> dict[str, Value]:
    qe = model.camera.quantum_efficiency
    interval = timing["frame_interval_s"] or timing["frame_length_s"]
    charge = model.camera.clock_induced_charge_e
    low, high = seen.background_e.interval
    background = Value(
        model.optics.background_photons_per_px, seen.background_e.sd / qe, (low - charge) / qe, (high - charge) / qe
    )
    values = {
        "optics.psf_fwhm_nm": seen.psf_sigma_px.over(1 / (FWHM * timing["pixel_size_nm"])),
        "psf_sigma_px": seen.psf_sigma_px,
        "optics.background_photons_per_px": background,
        "sample.n_molecules": seen.n_molecules,
        "on_level_e": seen.on_level_e,
        "photons_per_frame": seen.on_level_e.over(qe),
        "bleaching_rate_per_s": seen.bleaching_per_frame.over(interval),
        "off_rate_per_s": seen.off_per_frame.over(interval),
        "dark_time_s": seen.dark_frames.over(1 / interval),
    }
    if found is not None:
        values |= {
            "camera.baseline_adu": found.baseline_adu,
            "camera.read_noise_e": _product(found.read_noise_adu, found.electrons_per_adu),
            "camera.electrons_per_adu": found.electrons_per_adu,
            "camera.em_gain": found.em_gain,
            "adu_per_photoelectron": found.adu_per_photoelectron,
            "camera.clock_induced_charge_e": found.clock_induced_charge_e,
        }
    if found is None:  # numbers that rest on photoelectrons say nothing
        return {}
    return {name: value for name, value in values.items() if np.isfinite(value.value)}
