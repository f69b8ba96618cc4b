"""The tables of docs/model.md as data: ``preset("FF")`` and friends."""

from __future__ import annotations

from typing import Any

from napari_mufasa.errors import MufasaError
from napari_mufasa.model.model import Model

_FLUOROPHORE = {"extinction_coefficient_per_M_cm": 270_000, "lifetime_s": 2e-9, "quantum_yield": 1.0}
_OPTICS = {"collection_efficiency": 1.0, "background_photons_per_px": 20}
_CAMERA = {"quantum_efficiency": 0.9, "clock_induced_charge_e": 0.002, "baseline_adu": 367, "adc_max": 65535}


def _acquisition(n_frames: int, frame_length_s: float, shape_px: tuple[int, int] = (128, 128)) -> dict[str, Any]:
    return {
        "n_frames": n_frames,
        "frame_length_s": frame_length_s,
        "pixel_size_nm": 100.0,
        "shape_px": shape_px,
    }


def _table(
    protocol: str, n_frames: int, power: float, cycles: float, triplet_decay: float, isc: float,
    fwhm: float, camera: dict[str, Any], activation: float | None = None,
) -> dict[str, Any]:  # fmt: skip
    """One column of the source's Tables 1–3."""
    return {
        "protocol": protocol,
        "acquisition": _acquisition(n_frames, 0.01),
        "fluorophore": _FLUOROPHORE
        | {"cycles_before_bleaching": cycles, "isc_ratio": isc, "triplet_decay_rate_per_s": triplet_decay},
        "excitation": {
            "wavelength_nm": 647,
            "power_density_w_per_cm2": power,
            "activation_rate_per_s": activation,
        },
        "optics": _OPTICS | {"psf_fwhm_nm": fwhm},
        "camera": _CAMERA | camera,
    }


_CCD_10 = {"type": "CCD", "read_noise_e": 70.58, "electrons_per_adu": 10.04}
_CCD_100 = {"type": "CCD", "read_noise_e": 70.58, "electrons_per_adu": 100.04}
_EMCCD = {"type": "EMCCD", "read_noise_e": 60.58, "electrons_per_adu": 0.74, "em_gain": 500}
_CMOS = {"type": "CMOS", "read_noise_e": 1.58, "electrons_per_adu": 20.74}


PRESETS: dict[str, dict[str, Any]] = {
    "PALM": _table("PALM", 500, 5, 5e5, 10, 1e-2, 1200, _CCD_10, activation=1.0),
    "STORM": _table("STORM", 500, 7, 5e5, 2, 5e-4, 1200, _CCD_100),
    "FF": _table("FF", 100, 2, 5e3, 1, 1e-5, 308, _EMCCD),
    "Blinking": _table("Blinking", 100, 3, 1e3, 3, 5e-4, 308, _CMOS),
    "EGFP": {
        "protocol": "FF",
        "acquisition": _acquisition(250, 0.01, (512, 512)),
        "fluorophore": {
            "extinction_coefficient_per_M_cm": 55_900,
            "lifetime_s": 2.6e-9,
            "quantum_yield": 0.6,
            "cycles_before_bleaching": None,
            "isc_ratio": None,
            "triplet_decay_rate_per_s": None,
        },
        "excitation": {"wavelength_nm": 488, "power_density_w_per_cm2": 2, "activation_rate_per_s": None},
        "optics": _OPTICS | {"psf_fwhm_nm": 308},
        "camera": _CAMERA | _EMCCD,
        "sample": {"n_molecules": 500},
    },
    "Alexa647-STORM": {
        "protocol": "STORM",
        "acquisition": _acquisition(2000, 0.036, (256, 256)),
        "fluorophore": {
            "extinction_coefficient_per_M_cm": 239_000,
            "lifetime_s": 1e-9,
            "quantum_yield": 1.0,
            "cycles_before_bleaching": 1e9,
            "isc_ratio": 1.6e-3,
            "triplet_decay_rate_per_s": 0.1,
        },
        "excitation": {"wavelength_nm": 641, "power_density_w_per_cm2": 1000, "activation_rate_per_s": None},
        "optics": _OPTICS | {"psf_fwhm_nm": 308},
        "camera": _CAMERA | _CCD_10,
    },
}


def preset(name: str) -> Model:
    """The model of a preset: PALM, STORM, FF, Blinking, EGFP or Alexa647-STORM (docs/model.md).

    Raises `MufasaError` for another name.
    """
    if not isinstance(name, str) or name not in PRESETS:
        raise MufasaError(f"no preset {name!r}: choose one of {', '.join(PRESETS)}")
    return Model.from_dict(PRESETS[name])
