"""Parameters in words: label, unit and range of a field of a set-up, an effect or a table."""

from __future__ import annotations

from pydantic import BaseModel
from pydantic.fields import FieldInfo

UNITS = {  # endings of names; longer ones first where one ends the other
    "_per_M_cm": "1/(M cm)",
    "_w_per_cm2": "W/cm²",
    "_photons_per_px": "photons/px",
    "_per_s": "1/s",
    "_frames": "frames",
    "_adu": "ADU",
    "_e2": "e⁻ squared",
    "_deg": "°",
    "_nm": "nm",
    "_px": "px",
    "_e": "e⁻",
    "_s": "s",
}
NAMED_UNITS = {"electrons_per_adu": "e⁻/ADU", "n_frames": "", "shape_px": "px"}
LABELS = {
    "n_frames": "Frames",
    "n_molecules": "Molecules",
    "shape_px": "Height × width",
    "psf_fwhm_nm": "PSF width (FWHM)",
    "adc_max": "Largest count",
    "em_gain": "EM gain",
    "electrons_per_adu": "Electrons per count",
    "cmos_gain_curve": "CMOS gain curve",
    "isc_ratio": "Triplet crossing α_isc",
    "type": "Type",
    "k01_per_s": "Excitation rate k01",
    "detected_e_per_frame": "Electrons detected per frame",
    "snr_peak_pixel": "SNR, brightest pixel",
    "snr_spot": "SNR, whole spot",
    "detected_e_per_visit": "Electrons of a bright visit",
    "snr_visit": "SNR of a bright visit, whole spot",
    "detection_sd": "Stands out by (sd of the noise)",
    "w1_floor_e": "W1 floor",
    "psf_sigma_px": "PSF width σ",
    "on_level_e": "Electrons of a bright frame",
    "adu_per_photoelectron": "ADU per photoelectron",
    "localisation_nm": "Least error of a place",
    "frames_before_bleaching": "Bright frames before bleaching",
    "detected_e_before_bleaching": "Electrons before bleaching",
    "headroom_sd": "Brightest pixel below the largest count by (sd of its noise)",
}


def unit_of(name: str, owner: type[BaseModel] | None = None) -> str:
    """The unit in a parameter's name (`psf_fwhm_nm` → nm), or the one an effect declares."""
    declared = getattr(owner, "unit", None)
    if callable(declared) and declared(name):
        return "°" if declared(name) == "deg" else str(declared(name))
    if name in NAMED_UNITS:
        return NAMED_UNITS[name]
    return next((unit for ending, unit in UNITS.items() if name.endswith(ending)), "")


def told(name: str, owner: type[BaseModel] | None = None) -> str:
    """`frame_length_s` → "Frame length (s)"."""
    unit = unit_of(name, owner)
    return f"{label_of(name)} ({unit})" if unit else label_of(name)


def label_of(name: str) -> str:
    """`frame_length_s` → "Frame length"."""
    if name in LABELS:
        return LABELS[name]
    for ending in UNITS:
        name = name.removesuffix(ending) if len(name) > len(ending) + 1 else name
    words = name.replace("_", " ").strip()
    return words[:1].upper() + words[1:]


def bounds_of(field: FieldInfo) -> str:
    """The allowed range in words."""
    signs = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}
    found = []
    for constraint in field.metadata:
        for name, sign in signs.items():
            limit = getattr(constraint, name, None)
            if limit is not None:
                found.append(f"{sign} {limit:g}")
    return " and ".join(found)


def number_text(value: float | None) -> str:
    """A number as one types it: no noise digits, powers of ten where they help."""
    if value is None:
        return ""
    if isinstance(value, int) or (float(value).is_integer() and abs(value) < 1e7):
        return str(int(value))
    return f"{value:.6g}"
