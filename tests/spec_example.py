"""model.json and the identifiers of effects as docs/effects.md and docs/model.md print them: the one example that
tests share.
"""

from __future__ import annotations

from typing import Any

MODEL: dict[str, Any] = {
    "protocol": "FF",
    "acquisition": {"n_frames": 300, "frame_length_s": 0.02, "pixel_size_nm": 100.0, "shape_px": [96, 96]},
    "fluorophore": {
        "extinction_coefficient_per_M_cm": 55900, "lifetime_s": 2.6e-9, "quantum_yield": 0.6,
        "cycles_before_bleaching": None, "isc_ratio": None, "triplet_decay_rate_per_s": None,
    },
    "excitation": {"wavelength_nm": 488, "power_density_w_per_cm2": 30, "activation_rate_per_s": None},
    "optics": {"psf_fwhm_nm": 300, "collection_efficiency": 0.6, "background_photons_per_px": 10},
    "camera": {
        "type": "EMCCD", "quantum_efficiency": 0.9, "read_noise_e": 50, "clock_induced_charge_e": 0.002,
        "electrons_per_adu": 12, "baseline_adu": 200, "adc_max": 65535, "em_gain": 300,
    },
    "effects": [],
}  # fmt: skip

EFFECTS = [
    "triplet_blinking",
    "long_dark_state",
    "photobleaching",
    "delayed_activation",
    "brightness_heterogeneity",
    "multiple_emitters",
    "illumination_profile",
    "laser_drift",
    "laser_flicker",
    "periodic_modulation",
    "stage_drift",
    "focus_drift",
    "molecule_diffusion",
    "astigmatism",
    "background_gradient",
    "background_decay",
    "em_excess_noise",
    "clock_induced_charge",
    "pixel_gain_variation",
    "column_offset",
    "row_noise",
    "hot_pixels",
    "detector_saturation",
    "image_lag",
    "baseline_drift",
    "cosmic_rays",
]
