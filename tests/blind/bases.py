"""Believed models as plain dicts in the model.json format, and the numbers read from them."""

from __future__ import annotations

import copy
import math
from typing import Any

Believed = dict[str, Any]

AVOGADRO_PER_MOL = 6.02214076e23
PLANCK_J_S = 6.62607015e-34
LIGHT_SPEED_M_PER_S = 299792458.0

_EMCCD: Believed = {
    "protocol": "FF",
    "acquisition": {"n_frames": 300, "frame_length_s": 0.02, "pixel_size_nm": 100.0, "shape_px": [96, 96]},
    "fluorophore": {
        "extinction_coefficient_per_M_cm": 55900,
        "lifetime_s": 2.6e-9,
        "quantum_yield": 0.6,
        "cycles_before_bleaching": None,
        "isc_ratio": None,
        "triplet_decay_rate_per_s": None,
    },
    "excitation": {"wavelength_nm": 488, "power_density_w_per_cm2": 30, "activation_rate_per_s": None},
    "optics": {"psf_fwhm_nm": 300, "collection_efficiency": 0.6, "background_photons_per_px": 10},
    "camera": {
        "type": "EMCCD",
        "quantum_efficiency": 0.9,
        "read_noise_e": 50,
        "clock_induced_charge_e": 0.002,
        "electrons_per_adu": 12,
        "baseline_adu": 200,
        "adc_max": 65535,
        "em_gain": 300,
    },
    "effects": [],
}


# Further bases: what differs from the one they start from. Fields are square. Bleaching as in ``emccd_bleach``.
_FURTHER: dict[str, tuple[str, dict[str, Any]]] = {
    "cmos_bleach": ("cmos", {"fluorophore": {"cycles_before_bleaching": 2e5}}),
    "ccd_bleach": ("ccd", {"fluorophore": {"cycles_before_bleaching": 8e5}}),
    "emccd_small": ("emccd", {"acquisition": {"shape_px": [64, 64]}}),
    "emccd_dim": (
        "emccd",
        {
            "acquisition": {"n_frames": 200, "shape_px": [128, 128]},
            "excitation": {"power_density_w_per_cm2": 15},
            "optics": {"background_photons_per_px": 5},
        },
    ),
    "emccd_wide": ("emccd", {"acquisition": {"n_frames": 90, "shape_px": [256, 256]}}),
    "cmos_bright": (
        "cmos",
        {
            "acquisition": {"shape_px": [80, 80]},
            "excitation": {"power_density_w_per_cm2": 120},
            "optics": {"background_photons_per_px": 25},
        },
    ),
    "cmos_dim": (
        "cmos",
        {
            "acquisition": {"n_frames": 250, "shape_px": [112, 112]},
            "excitation": {"power_density_w_per_cm2": 20},
            "optics": {"background_photons_per_px": 6},
        },
    ),
    "ccd_wide": ("ccd", {"acquisition": {"n_frames": 150, "frame_length_s": 0.04, "shape_px": [160, 160]}}),
    # Lit for 0.2 s (ten frames) at a time, dark as long; for 0.1 s, then dark for 10 s; once, for 0.3 s.
    "emccd_blinking": (
        "emccd",
        {
            "protocol": "Blinking",
            "fluorophore": {"isc_ratio": 3.2e-4, "triplet_decay_rate_per_s": 5.0, "cycles_before_bleaching": 1e6},
        },
    ),
    "emccd_storm": (
        "emccd",
        {
            "protocol": "STORM",
            "fluorophore": {"isc_ratio": 1.3e-4, "triplet_decay_rate_per_s": 0.1, "cycles_before_bleaching": 1e6},
            "excitation": {"power_density_w_per_cm2": 150},
        },
    ),
    "emccd_palm": (
        "emccd",
        {
            "protocol": "PALM",
            "fluorophore": {"cycles_before_bleaching": 1.5e4},
            "excitation": {"power_density_w_per_cm2": 100, "activation_rate_per_s": 0.2},
        },
    ),
    "emccd_sparse": ("emccd", {}),
    "emccd_crowded": ("emccd", {}),
}
PROTOCOLS = ("emccd_blinking", "emccd_storm", "emccd_palm")  # molecules that are lit late, or not for long
DENSITIES = ("emccd_sparse", "emccd_crowded")  # 15 and 180 molecules where others have 50
APART = PROTOCOLS + DENSITIES  # in no plan: the generator's strengths are not made for them


def base_model(name: str = "emccd") -> Believed:
    """Return a fresh believed model, one of ``BASE_NAMES``."""
    if name in _FURTHER:
        start, changes = _FURTHER[name]
        model = base_model(start)
        for part, values in changes.items():
            if isinstance(values, dict):
                model[part].update(copy.deepcopy(values))
            else:
                model[part] = values
        return model
    model = copy.deepcopy(_EMCCD)
    if name == "emccd":
        return model
    if name == "emccd_bleach":
        # Mean life k01/N_c: 12.7 s against a movie of 6 s, so about 38 % bleach.
        model["fluorophore"]["cycles_before_bleaching"] = 2e5
        return model
    if name == "emccd_short":
        model["acquisition"].update(n_frames=120, shape_px=[64, 64])
        return model
    if name == "cmos":
        model["camera"] = {
            "type": "CMOS",
            "quantum_efficiency": 0.8,
            "read_noise_e": 1.6,
            "clock_induced_charge_e": 0.002,
            "electrons_per_adu": 0.5,
            "baseline_adu": 100,
            "adc_max": 65535,
        }
        return model
    if name == "ccd":
        # A plain CCD needs more light: four times the power, background with it.
        model["excitation"]["power_density_w_per_cm2"] = 120
        model["optics"]["background_photons_per_px"] = 25
        model["camera"] = {
            "type": "CCD",
            "quantum_efficiency": 0.9,
            "read_noise_e": 6.0,
            "clock_induced_charge_e": 0.002,
            "electrons_per_adu": 1.5,
            "baseline_adu": 300,
            "adc_max": 65535,
        }
        return model
    raise ValueError(f"base model {name!r} unknown; choose one of {', '.join(BASE_NAMES)}")


# Molecules that a movie of each base has in the trial.
MOLECULES = {
    "emccd": 50, "emccd_bleach": 50, "emccd_short": 25, "cmos": 50, "ccd": 50, "cmos_bleach": 50, "ccd_bleach": 50,
    "emccd_small": 20, "emccd_dim": 90, "emccd_wide": 400, "cmos_bright": 35, "cmos_dim": 60, "ccd_wide": 140,
    "emccd_blinking": 60, "emccd_storm": 250, "emccd_palm": 200, "emccd_sparse": 15, "emccd_crowded": 180,
}  # fmt: skip
BASE_NAMES = tuple(MOLECULES)


def excitation_rate_per_s(model: Believed) -> float:
    """k01 of docs/photophysics.md."""
    return (
        model["fluorophore"]["extinction_coefficient_per_M_cm"]
        * model["excitation"]["power_density_w_per_cm2"]
        * model["excitation"]["wavelength_nm"]
        * 1e-6
        * math.log(10.0)
        / (AVOGADRO_PER_MOL * PLANCK_J_S * LIGHT_SPEED_M_PER_S)
    )


def s1_branching(model: Believed) -> tuple[float, float, float]:
    """Probability per excitation of fluorescence relaxation, of crossing to T1 and of bleaching."""
    dye = model["fluorophore"]
    isc = dye.get("isc_ratio") or 0.0
    cycles = dye.get("cycles_before_bleaching")
    bleach = 1.0 / cycles if cycles else 0.0
    total = 1.0 + isc + bleach
    return 1.0 / total, isc / total, bleach / total


def cycle_rate_per_s(model: Believed) -> float:
    """Excitations per second of a molecule that is never dark: one per mean S0 time plus mean S1 time."""
    relax, _, _ = s1_branching(model)
    s1_time_s = model["fluorophore"]["lifetime_s"] * relax
    return 1.0 / (1.0 / excitation_rate_per_s(model) + s1_time_s)


def photons_per_s(model: Believed) -> float:
    """Photons per second that reach the detector from one molecule while it is bright."""
    relax, _, _ = s1_branching(model)
    quantum_yield = model["fluorophore"].get("quantum_yield")
    quantum_yield = 1.0 if quantum_yield is None else quantum_yield
    collection = model["optics"].get("collection_efficiency")
    collection = 1.0 if collection is None else collection
    return cycle_rate_per_s(model) * relax * quantum_yield * collection


def sigma_px(model: Believed) -> float:
    """Standard deviation of the Gaussian PSF in pixels."""
    return model["optics"]["psf_fwhm_nm"] / 2.3548 / model["acquisition"]["pixel_size_nm"]
