"""The sample movies: one of each protocol, and one with a hidden effect, as napari's layers."""

from __future__ import annotations

from typing import Any

import numpy as np

from napari_mufasa.files.layers import LayerData, contrast, movie_space
from napari_mufasa.files.movies import METADATA_KEY
from napari_mufasa.model import Model, effect_from_data, preset
from napari_mufasa.simulate.movie import simulate, simulate_dark


def sample_palm() -> list[LayerData]:
    """PALM: molecules that wake up, one after the other."""
    return _sample("PALM", 200, 40, {"optics.psf_fwhm_nm": 308, "excitation.power_density_w_per_cm2": 100})


def sample_storm() -> list[LayerData]:
    """STORM: molecules that are mostly dark."""
    more_light = {"optics.psf_fwhm_nm": 308, "excitation.power_density_w_per_cm2": 100, "fluorophore.isc_ratio": 1e-4}
    return _sample("STORM", 200, 40, more_light)


def sample_ff() -> list[LayerData]:
    """Fluorescence fluctuations: molecules that are on until they bleach."""
    return _sample("FF", 100, 50, {"excitation.power_density_w_per_cm2": 5})


def sample_blinking() -> list[LayerData]:
    """Blinking molecules on a CMOS camera."""
    return _sample("Blinking", 100, 50, {"fluorophore.isc_ratio": 1e-4, "fluorophore.cycles_before_bleaching": 5e3})


def _sample(name: str, n_frames: int, n_molecules: int, changes: dict[str, Any]) -> list[LayerData]:
    """A small movie of a preset, with changes that let single molecules be seen by eye."""

    model = preset(name).with_values(
        {
            "acquisition.n_frames": n_frames,
            "acquisition.shape_px": (96, 96),
            "sample.n_molecules": n_molecules,
            "sample.min_distance_px": 8.0,
        }
        | changes
    )
    result = simulate(model, seed=1, workers=2)
    options = movie_space(model.acquisition.pixel_size_nm) | {
        "name": f"{name} sample",
        "metadata": {METADATA_KEY: {"model": model.to_dict(), "seed": 1}},
        "contrast_limits": contrast(result.movie),
        "colormap": "gray",
    }
    return [(result.movie, options, "image")]


#: What may be hidden in the puzzle: effect and a size that such data show.
HIDDEN: tuple[dict[str, Any], ...] = (
    {"kind": "stage_drift", "distance_px": 3.0},
    {"kind": "triplet_blinking"},
    {"kind": "laser_drift", "change": -0.45},
    {"kind": "background_gradient"},
    {"kind": "illumination_profile", "edge_dimming": 0.75},
    {"kind": "image_lag"},
)
PUZZLE_SEED = 20


def puzzle_model() -> Model:
    """What the user of the hidden-effect sample believes."""

    return Model.from_dict(
        {
            "protocol": "FF",
            "acquisition": {"n_frames": 300, "frame_length_s": 0.02, "pixel_size_nm": 100.0, "shape_px": [64, 64]},
            "fluorophore": {"extinction_coefficient_per_M_cm": 55900, "lifetime_s": 2.6e-9, "quantum_yield": 0.6},
            "excitation": {"wavelength_nm": 488, "power_density_w_per_cm2": 30},
            "optics": {"psf_fwhm_nm": 300, "collection_efficiency": 0.6, "background_photons_per_px": 10},
            "camera": {
                "type": "EMCCD", "quantum_efficiency": 0.9, "read_noise_e": 50, "clock_induced_charge_e": 0.002,
                "electrons_per_adu": 12, "baseline_adu": 200, "adc_max": 65535, "em_gain": 300,
            },
            "sample": {"n_molecules": 40, "min_distance_px": 5.0},
        }
    )  # fmt: skip


def hidden_effect(seed: int = PUZZLE_SEED) -> Any:
    """The effect behind the hidden-effect sample of a seed: the envelope. Look only afterwards."""

    return effect_from_data(HIDDEN[int(np.random.default_rng(seed).integers(len(HIDDEN)))])


def sample_hidden_effect(seed: int = PUZZLE_SEED) -> list[LayerData]:
    """A measurement whose believed model lacks one effect, and its dark frames. The metadata do not tell which."""

    believed = puzzle_model()
    rng = np.random.default_rng([seed, 1])
    off_by = 1 + 0.08 * rng.uniform(-1, 1, 2)  # nobody knows brightness and background better than this
    truth = believed.with_values(
        {
            "excitation.power_density_w_per_cm2": believed.excitation.power_density_w_per_cm2 * off_by[0],
            "optics.background_photons_per_px": believed.optics.background_photons_per_px * off_by[1],
        }
    ).with_effects(hidden_effect(seed))
    movie = simulate(truth, seed=seed, workers=2).movie
    dark = simulate_dark(truth, 60, seed=seed)
    dark_name = "hidden effect, dark frames"
    of_dark = {METADATA_KEY: {"role": "dark frames"}}
    of_movie = {METADATA_KEY: {"model": believed.to_dict(), "seed": None, "dark_layer": dark_name}}
    shared = movie_space(believed.acquisition.pixel_size_nm) | {"colormap": "gray"}
    return [
        (dark, shared | {"name": dark_name, "visible": False, "metadata": of_dark}, "image"),
        (movie, shared | {"name": "hidden effect", "contrast_limits": contrast(movie), "metadata": of_movie}, "image"),
    ]
