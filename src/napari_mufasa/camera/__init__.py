"""Detectors: `expose` (photons → ADU) and its inverse, the gain register, a movie as blocks of photoelectrons."""

from napari_mufasa.camera.detector import (
    IDEAL,
    Hook,
    SensorHooks,
    Stack,
    baseline_map_adu,
    check_counts,
    cmos_response,
    cmos_response_inverse,
    expose,
    multiplication_noise,
    output_electrons,
    photoelectrons,
    photons,
    read_noise_map_e,
    read_variance,
)

__all__ = [
    "IDEAL", "Hook", "SensorHooks", "Stack", "baseline_map_adu", "check_counts", "cmos_response",
    "cmos_response_inverse", "expose", "multiplication_noise", "output_electrons", "photoelectrons", "photons",
    "read_noise_map_e", "read_variance",
]  # fmt: skip
