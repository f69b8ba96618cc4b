"""The sample movies: one of each protocol, and one with a hidden effect, as napari's layers.

Here, too, is how an effect is hidden, for the sample and for the demonstration of the command line: what the user
believes, what may be missing from it, and by how much everything else is off, as it is in every laboratory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.effects import effect_class
from napari_mufasa.files.layers import LayerData, contrast, movie_space
from napari_mufasa.files.movies import METADATA_KEY
from napari_mufasa.model import Model, preset


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
    from napari_mufasa.simulate.movie import simulate

    result = simulate(model, seed=1, workers=2)
    options = movie_space(model.acquisition.pixel_size_nm) | {
        "name": f"{name} sample",
        "metadata": {METADATA_KEY: {"model": model.to_dict(), "seed": 1}},
        "contrast_limits": contrast(result.movie),
        "colormap": "gray",
    }
    return [(result.movie, options, "image")]


#: What the user of a hidden effect believes: an EMCCD movie of molecules that are always on.
BELIEVED: dict[str, Any] = {
    "protocol": "FF",
    "acquisition": {"n_frames": 300, "frame_length_s": 0.02, "pixel_size_nm": 100.0, "shape_px": [96, 96]},
    "fluorophore": {
        "extinction_coefficient_per_M_cm": 55900, "lifetime_s": 2.6e-9, "quantum_yield": 0.6,
        "cycles_before_bleaching": 4e6, "isc_ratio": None, "triplet_decay_rate_per_s": None,
    },
    "excitation": {"wavelength_nm": 488, "power_density_w_per_cm2": 30, "activation_rate_per_s": None},
    "optics": {"psf_fwhm_nm": 300, "collection_efficiency": 0.6, "background_photons_per_px": 10},
    "camera": {
        "type": "EMCCD", "quantum_efficiency": 0.9, "read_noise_e": 50, "clock_induced_charge_e": 0.002,
        "electrons_per_adu": 12, "baseline_adu": 200, "adc_max": 65535, "em_gain": 300,
    },
    "sample": {"n_molecules": 50, "min_distance_px": 6},
    "effects": [],
}  # fmt: skip
#: What may be hidden, with ranges in which it is visible in such a movie; forms are drawn, too.
VISIBLE: dict[str, dict[str, tuple[float, float]]] = {
    "triplet_blinking": {"off_rate_per_s": (5, 15), "dark_time_s": (0.03, 0.08)},
    "photobleaching": {"rate_per_s": (0.2, 0.5)},
    "delayed_activation": {"fraction": (0.5, 0.8), "activation_rate_per_s": (0.3, 0.8)},
    "brightness_heterogeneity": {"spread": (0.4, 0.6)},
    "laser_drift": {"change": (-0.5, -0.3)},
    "laser_flicker": {"rms": (0.08, 0.15)},
    "periodic_modulation": {"amplitude": (0.12, 0.2), "period_frames": (5, 20)},
    "stage_drift": {"distance_px": (2, 4), "direction_deg": (0, 360)},
    "focus_drift": {"widening": (0.4, 0.7)},
    "molecule_diffusion": {"diffusion_px2_per_frame": (0.005, 0.015)},
    "background_gradient": {"relative_height": (0.35, 0.6), "direction_deg": (0, 360)},
    "illumination_profile": {"edge_dimming": (0.65, 0.8)},
    "image_lag": {"fraction": (0.05, 0.08)},
}
#: What the sample may hide: effects of every stage that its small movie shows.
PUZZLES = (
    "stage_drift", "triplet_blinking", "laser_drift", "background_gradient", "illumination_profile", "image_lag",
)  # fmt: skip
PUZZLE_SEED = 20
#: Nobody knows power, background and focus better than this (factors).
OFF_BY = {
    "excitation.power_density_w_per_cm2": (0.93, 1.07),
    "optics.background_photons_per_px": (0.93, 1.07),
    "optics.psf_fwhm_nm": (0.97, 1.03),
}


@dataclass(frozen=True)
class Puzzle:
    """A measurement (frame, y, x, ADU) with its dark frames, what its user believes, and the truth."""

    believed: Model
    truth: Model
    movie: NDArray[np.uint16]
    dark: NDArray[np.uint16]


def hide(believed: Model, kinds: Iterable[str], rng: np.random.Generator, n_dark: int = 100) -> Puzzle:
    """One effect of ``kinds`` put into the model believed, and the movie recorded with everything else a little off."""
    from napari_mufasa.simulate.movie import simulate, simulate_dark

    effect = draw_effect(believed, kinds, rng)
    data = believed.model_dump()
    off = {path: data[path.split(".")[0]][path.split(".")[1]] * rng.uniform(*by) for path, by in OFF_BY.items()}
    truth = believed.with_values(off).with_effects(effect)
    movie = simulate(truth, seed=int(rng.integers(2**31)), workers=2).movie
    return Puzzle(believed, truth, movie, simulate_dark(truth, n_dark, seed=int(rng.integers(2**31))))


# What is "as seen" is read off a measurement: there is none yet. The others came later, and seeds hide what they did.
NOT_DRAWN = ("", "as_seen", "steady", "orientations")


def draw_effect(believed: Model, kinds: Iterable[str], rng: np.random.Generator) -> Any:
    """An effect of ``kinds`` with a drawn form and values drawn within the range in which it is visible."""
    kind = str(rng.choice(list(kinds)))
    data: dict[str, Any] = {"kind": kind}
    data |= {name: float(rng.uniform(*bounds)) for name, bounds in VISIBLE[kind].items()}
    forms = [form for form in effect_class(kind).forms() if form not in NOT_DRAWN]
    if forms:
        data["form"] = str(rng.choice(forms))
    return believed.with_values({"effects": [data]}).effects[0]


def puzzle_model() -> Model:
    """What the user of the hidden-effect sample believes: `BELIEVED` on a smaller field, without bleaching."""
    return Model.from_dict(BELIEVED).with_values(
        {
            "acquisition.shape_px": (64, 64),
            "fluorophore.cycles_before_bleaching": None,
            "sample.n_molecules": 40,
            "sample.min_distance_px": 5.0,
        }
    )


def hidden_effect(seed: int = PUZZLE_SEED) -> Any:
    """The effect behind the hidden-effect sample of a seed: the envelope. Look only afterwards."""
    return draw_effect(puzzle_model(), PUZZLES, np.random.default_rng(seed))


def sample_hidden_effect(seed: int = PUZZLE_SEED) -> list[LayerData]:
    """A measurement whose believed model lacks one effect, and its dark frames. The metadata do not tell which."""
    puzzle = hide(puzzle_model(), PUZZLES, np.random.default_rng(seed), n_dark=60)
    dark_name = "hidden effect, dark frames"
    of_dark = {METADATA_KEY: {"role": "dark frames"}}
    of_movie = {METADATA_KEY: {"model": puzzle.believed.to_dict(), "seed": None, "dark_layer": dark_name}}
    shared = movie_space(puzzle.believed.acquisition.pixel_size_nm) | {"colormap": "gray"}
    shown = {"name": "hidden effect", "contrast_limits": contrast(puzzle.movie), "metadata": of_movie}
    return [
        (puzzle.dark, shared | {"name": dark_name, "visible": False, "metadata": of_dark}, "image"),
        (puzzle.movie, shared | shown, "image"),
    ]


#: The samples by key (napari.yaml lists them for napari): what each is called, and what makes its layers.
SAMPLES: dict[str, tuple[str, Callable[[], list[LayerData]]]] = {
    "hidden_effect": ("hidden effect", sample_hidden_effect),
    "ff": ("FF", sample_ff),
    "blinking": ("Blinking", sample_blinking),
    "storm": ("STORM", sample_storm),
    "palm": ("PALM", sample_palm),
}
