"""Which forms of the generator are laws of the catalogue, too, and what their parameters are called there.

Read off `napari_mufasa/effects` by hand. A form is *known* where the catalogue has a law of the same functional form
with the same meaning. `near` marks those whose constants the catalogue fixes at other values (two dwell times 1 : 8
here, 1 : 10 there), or whose sizes spread by another law; they count as known, which is the harder count for known
and unseen forms alike. Every form that is not in the table is *unseen*: no law of the catalogue, though a course or a
map that is read off a movie may follow it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

Truth = Mapping[str, Any]
Meaning = str | Callable[[Truth, Mapping[str, Any]], float]  # a name in the truth; or from truth and believed model


@dataclass(frozen=True)
class Law:
    """form : its name in the catalogue (None: the effect has but one) · means : parameters there, from the truth ·
    near : constants differ"""

    form: str | None
    means: Mapping[str, Meaning] = field(default_factory=dict)
    near: bool = False


def _register_gain(believed: Mapping[str, Any]) -> float:
    """Output electrons per photoelectron near zero signal (0.9 for the CMOS curve of docs/camera.md)."""
    camera = believed["camera"]
    return {"EMCCD": float(camera.get("em_gain") or 1.0), "CMOS": 0.9}.get(camera["type"], 1.0)


def _mean_rate_per_s(t: Truth, _: Mapping[str, Any]) -> float:
    """Of two populations whose mean *life* the generator keeps."""
    fast, ratio = t["fast_fraction"], t["rate_ratio"]
    shortest_s = t["mean_life_s"] / (fast + (1 - fast) * ratio)
    return float((fast + (1 - fast) / ratio) / shortest_s)


def _dimming_off_centre(t: Truth, _: Mapping[str, Any]) -> float:
    """The generator counts to the farthest corner, the catalogue to 1 + ½² half fields squared."""
    farthest = (1 + abs(t["centre_y"])) ** 2 + (1 + abs(t["centre_x"])) ** 2
    return float(1 - (1 - t["edge_dimming"]) ** (1.25 / farthest))


def _dimming_centred(t: Truth, _: Mapping[str, Any]) -> float:
    """… to the middle of an edge."""
    return float(1 - (1 - t["edge_dimming"]) ** 0.5)


def _serial_e(t: Truth, believed: Mapping[str, Any]) -> float:
    """Charge over the gain: an electron born inside the register sees a part of the gain only."""
    if "serial_events_per_px" not in t:  # no register: it was made before read-out
        return float(t["extra_e_per_px"])
    gain = _register_gain(believed)
    return float(t["serial_events_per_px"] * (1 - 1 / gain) / math.log(gain))


def _diffusion(t: Truth, believed: Mapping[str, Any]) -> float:
    return float(t["diffusion_px2_per_s"] * believed["acquisition"]["frame_length_s"])


def _decay_time(t: Truth, believed: Mapping[str, Any]) -> float:
    timing = believed["acquisition"]
    return float(t["time_constant_s"] / (timing["n_frames"] * timing["frame_length_s"]))


def _inverse_well(t: Truth, believed: Mapping[str, Any]) -> float:
    return _register_gain(believed) / float(t["full_well_e"])


_DARK: Mapping[str, Meaning] = {"off_rate_per_s": "to_dark_rate_per_s", "dark_time_s": "mean_dark_s"}
_DELAY: Mapping[str, Meaning] = {
    "fraction": "inactive_fraction",
    "activation_rate_per_s": "activation_rate_per_s",
}
_HITS: Mapping[str, Meaning] = {"hits_per_frame": "hits_per_frame"}
_LOG_RATIO: Mapping[str, Meaning] = {"log_ratio": lambda t, _: math.log(t["width_ratio"])}

KNOWN: dict[str, dict[str, Law]] = {
    "triplet_blinking": {"exponential": Law("exponential", _DARK), "two_component": Law("two_exponential", near=True)},
    "long_dark_state": {"exponential": Law("exponential", _DARK), "power_law": Law("power_law", near=True)},
    "photobleaching": {
        "exponential": Law("exponential", {"rate_per_s": "bleaching_rate_per_s"}),
        "two_populations": Law("two_populations", {"rate_per_s": _mean_rate_per_s}),
    },
    "delayed_activation": {
        "exponential": Law("exponential", _DELAY),
        "two_step": Law("two_step", _DELAY),
        "uniform": Law("steady", _DELAY),
    },
    "brightness_heterogeneity": {
        "log_normal": Law("lognormal", {"spread": "cv_in_this_movie"}),
        "two_levels": Law("two_levels", {"spread": "cv_in_this_movie"}),
        "fixed_dipoles": Law("orientations", {"spread": "cv_in_this_movie"}),
    },
    "multiple_emitters": {
        "dimers": Law("dimers", {"fraction": "multiple_fraction"}),
        "two_to_four": Law("oligomers", {"fraction": "multiple_fraction"}),
    },
    "illumination_profile": {
        "centred": Law("gaussian", {"edge_dimming": _dimming_centred}),
        "off_centre": Law("off_centre", {"edge_dimming": _dimming_off_centre}),
        "tilt": Law("linear", {"edge_dimming": "edge_dimming"}),
    },
    "laser_drift": {
        "linear": Law("linear", {"change": "relative_change"}),
        "settling": Law("saturating", {"change": "relative_change"}),
        "step": Law("step", {"change": "relative_change"}),
        "random_walk": Law("wandering"),
    },
    "laser_flicker": {
        "white": Law("white", {"rms": "rms"}),
        "pink": Law("pink", {"rms": "rms"}),
        "correlated": Law("relaxing", {"rms": "rms", "correlation_frames": "correlation_frames"}),
    },
    "periodic_modulation": {
        "sine": Law("sine", {"amplitude": "amplitude", "period_frames": "period_frames"}),
        "square": Law(
            "square", {"amplitude": lambda t, _: t["amplitude"] / math.sqrt(2), "period_frames": "period_frames"}
        ),
    },
    "stage_drift": {
        "linear": Law("linear", {"distance_px": "total_px"}),
        "step": Law("step", {"distance_px": "total_px"}),
        "random_walk": Law("wandering"),
    },
    "focus_drift": {
        "linear": Law("linear", {"widening": "relative_widening"}),
        "random_walk": Law("wandering", near=True),
    },
    "molecule_diffusion": {
        "free": Law("free", {"diffusion_px2_per_frame": _diffusion}),
        "confined": Law("confined", near=True),  # within half of the movie here, thirty frames there
        "mobile_half": Law("half_mobile", {"diffusion_px2_per_frame": _diffusion}),
    },
    "astigmatism": {"axis": Law(None, _LOG_RATIO), "rotated": Law(None, _LOG_RATIO)},
    "background_gradient": {"linear": Law("linear"), "haze": Law("hump")},
    "background_decay": {
        "exponential": Law("exponential", {"fraction": "decaying_share", "time_constant_movies": _decay_time}),
        "linear": Law("linear", {"fraction": "relative_loss"}),
    },
    # "partly_noiseless" is unseen: some electrons multiplied, others not; in the catalogue a part of each
    "em_excess_noise": {"gamma": Law("gamma", {"excess_noise_factor": "excess_noise_factor"})},
    "clock_induced_charge": {
        "parallel": Law("before_register", {"electrons": "extra_e_per_px"}),
        "serial": Law("in_register", {"electrons": _serial_e}),
        "along_rows": Law("along_columns", {"electrons": "extra_e_per_px"}),
    },
    "pixel_gain_variation": {
        "pixels": Law("pixels", {"rms": "gain_sd"}),
        "columns_and_pixels": Law("columns_and_pixels", {"rms": "gain_sd"}),
        "dull_tail": Law("dull_pixels", {"rms": "gain_sd"}),
    },
    "column_offset": {
        "columns": Law("columns", {"rms_adu": "rms_adu"}),
        "odd_even": Law("alternating", {"rms_adu": "rms_adu"}),
        "columns_and_pixels": Law("columns_and_pixels", {"rms_adu": "rms_adu"}, near=True),
    },
    "row_noise": {
        "independent": Law("rows", {"rms_adu": "rms_adu"}),
        # What rows share ends with the next one here, falls by and by there.
        "banded": Law("drifting_rows", {"rms_adu": "rms_adu"}, near=True),
        "rare_rows": Law("bursts", {"rms_adu": "rms_adu"}),
    },
    "hot_pixels": {
        "steady": Law("steady", near=True),
        "spread": Law("steady", {"fraction": "fraction_in_this_movie"}),
        "switching": Law("telegraph", near=True),
    },
    "detector_saturation": {
        "soft": Law("soft", {"inverse_full_scale": _inverse_well}),
        "hard": Law("hard", {"inverse_full_scale": _inverse_well}),
        "rounded": Law("rounded", {"inverse_full_scale": _inverse_well}),
    },
    "image_lag": {
        "next_frame": Law("one_frame", {"fraction": "lag_fraction"}),
        "several_frames": Law("decaying", {"fraction": "lag_fraction", "kept": "kept_per_frame"}),
    },
    "baseline_drift": {
        "linear": Law("linear", {"drift_adu": "change_adu"}),
        "settling": Law("saturating", {"drift_adu": "change_adu"}),
        "step": Law("step", {"drift_adu": "change_adu"}),
        "random_walk": Law("wandering"),
    },
    "cosmic_rays": {"single": Law("points", _HITS, near=True), "track": Law("tracks", _HITS, near=True)},
}

# The catalogue's strength of an effect, for forms that have no meaning of their own above.
STRENGTH: dict[str, tuple[str, Meaning]] = {
    "triplet_blinking": ("off_rate_per_s", "to_dark_rate_per_s"),
    "long_dark_state": ("off_rate_per_s", "to_dark_rate_per_s"),
    "photobleaching": ("rate_per_s", "bleaching_rate_per_s"),
    "delayed_activation": ("fraction", "inactive_fraction"),
    "brightness_heterogeneity": ("spread", "cv_in_this_movie"),
    "multiple_emitters": ("fraction", "multiple_fraction"),
    "illumination_profile": ("edge_dimming", lambda t, _: 1 - t["min_over_max"]),
    "laser_drift": ("change", "relative_change"),
    "laser_flicker": ("rms", "rms"),
    "periodic_modulation": ("amplitude", "amplitude"),
    "stage_drift": ("distance_px", "total_px"),
    "focus_drift": ("widening", "relative_widening"),
    "molecule_diffusion": ("diffusion_px2_per_frame", _diffusion),
    "astigmatism": ("log_ratio", lambda t, _: math.log(t["width_ratio"])),
    "background_gradient": ("relative_height", "peak_to_peak"),
    "background_decay": ("fraction", "relative_loss"),
    "em_excess_noise": ("excess_noise_factor", "excess_noise_factor"),
    "clock_induced_charge": ("electrons", _serial_e),
    "pixel_gain_variation": ("rms", "gain_sd"),
    "column_offset": ("rms_adu", "rms_adu"),
    "row_noise": ("rms_adu", "rms_adu"),
    "hot_pixels": ("fraction", "fraction_in_this_movie"),
    "detector_saturation": ("inverse_full_scale", _inverse_well),
    "image_lag": ("fraction", "lag_fraction"),
    "baseline_drift": ("drift_adu", "change_adu"),
    "cosmic_rays": ("hits_per_frame", "hits_per_frame"),
}

# A strength counts from where it switches the effect off; that is 0 but for the ideal register.
NOTHING = {"em_excess_noise": 2.0}

# Disturbances of `off_catalogue` that are an effect of the catalogue by now: no test of what is off it.
CAUGHT_UP = ("level_switching",)


def law(kind: str, form: str) -> Law | None:
    """The catalogue's law for a form of the generator; None: unseen."""
    return KNOWN[kind].get(form)


def value(meaning: Meaning, truth: Truth, believed: Mapping[str, Any]) -> float:
    return float(truth[meaning] if isinstance(meaning, str) else meaning(truth, believed))


def hidden_strength(kind: str, form: str, truth: Truth, believed: Mapping[str, Any]) -> float:
    """How strong an effect was hidden, in the catalogue's unit, counted from nothing."""
    name, meaning = STRENGTH[kind]
    known = law(kind, form)
    if known is not None:
        meaning = known.means.get(name, meaning)
    return abs(value(meaning, truth, believed) - NOTHING.get(kind, 0.0))
