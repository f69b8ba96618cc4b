"""Named cameras to start from: values of data sheets, as far as they hold for every camera of the name.

Electrons per count and baseline differ from camera to camera and from setting to setting: those here are typical.
`calibrate` measures them.
"""

from __future__ import annotations

from typing import Any, Literal

_LINEAR = ((0.0, 0.0), (1.0, 1.0))


def _emccd(read_noise_e: float, per_adu: float, baseline: float, adc_max: int = 65535) -> dict[str, Any]:
    return {
        "type": "EMCCD", "quantum_efficiency": 0.9, "read_noise_e": read_noise_e, "clock_induced_charge_e": 0.002,
        "electrons_per_adu": per_adu, "baseline_adu": baseline, "em_gain": 300.0, "adc_max": adc_max,
    }  # fmt: skip


def _cmos(read_noise_e: float, per_adu: float, qe: float, baseline: float = 100.0) -> dict[str, Any]:
    return {
        "type": "CMOS", "quantum_efficiency": qe, "read_noise_e": read_noise_e, "electrons_per_adu": per_adu,
        "baseline_adu": baseline, "cmos_gain_curve": _LINEAR,
    }  # fmt: skip


CAMERAS: dict[str, dict[str, Any]] = {
    "EMCCD, gain 300": _emccd(50.0, 12.0, 200.0),
    "sCMOS, linear": _cmos(1.6, 0.46, 0.8),
    "CCD": {
        "type": "CCD", "quantum_efficiency": 0.7, "read_noise_e": 6.0, "electrons_per_adu": 1.0, "baseline_adu": 100.0,
    },
    "Andor iXon Ultra 897, 17 MHz": _emccd(89.0, 15.9, 200.0),
    "Andor iXon 897, 10 MHz": _emccd(65.0, 15.9, 110.0, adc_max=16383),
    "Andor iXon Ultra 888, 30 MHz": _emccd(130.0, 11.5, 430.0),
    "Photometrics Evolve 512, 10 MHz": _emccd(45.0, 5.0, 500.0),
    "Hamamatsu ImagEM X2": _emccd(152.0, 11.7, 1500.0),
    "Hamamatsu ORCA-Flash4.0 V3": _cmos(1.6, 0.46, 0.82),
    "Hamamatsu ORCA-Fusion BT": _cmos(0.7, 0.24, 0.95),
    "Andor Zyla 4.2": _cmos(1.1, 0.45, 0.82),
    "Photometrics Prime 95B": _cmos(1.8, 0.6, 0.95),
    "PCO edge 4.2": _cmos(1.4, 0.46, 0.82),
}  # fmt: skip

_WORDS: dict[Literal["EMCCD", "CMOS", "CCD"], tuple[str, ...]] = {
    "EMCCD": ("emccd", "ixon", "du897", "du-897", "du888", "du-888", "evolve", "imagem", "cascade", "luca", "proem"),
    "CMOS": ("cmos", "zyla", "sona", "neo", "orca-flash", "flash4", "fusion", "prime", "edge", "kinetix", "c11440"),
    "CCD": ("clara", "coolsnap", "orca-r2", "orca-er", "retiga", "pixis"),
}  # fmt: skip


def camera_type_of(name: str | None) -> Literal["EMCCD", "CMOS", "CCD"] | None:
    """The kind of a camera by its name in the metadata; None where the name says nothing."""
    if name is None:
        return None
    lower = name.lower()
    return next((kind for kind, words in _WORDS.items() if any(word in lower for word in words)), None)
