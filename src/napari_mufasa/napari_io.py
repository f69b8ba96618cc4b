"""What napari reads, writes and offers as samples: thin functions over `napari_mufasa.io` and the simulator."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_mufasa.io import METADATA_KEY

if TYPE_CHECKING:
    from napari_mufasa.model import Model

LayerData = tuple[Any, dict[str, Any], str]
MOVIE_SUFFIXES = (".tif", ".tiff", ".zarr")
BLOCK_FRAMES = 64


# readers ------------------------------------------------------------------------------------------------
def get_reader(path: str | Sequence[str]) -> Callable[[str | Sequence[str]], list[LayerData]] | None:
    """napari's question: can you read this? Only files that carry our metadata; all others are someone else's."""
    if not isinstance(path, (str, os.PathLike)):
        return None
    return read_layers if is_ours(path) else None


def is_ours(path: str | os.PathLike[str]) -> bool:
    """Whether we wrote this file; looks at its header only."""
    name = str(path).lower().rstrip("/")
    try:
        if name.endswith(".zarr"):
            import json

            file = Path(path) / "zarr.json"
            return file.is_file() and METADATA_KEY in json.loads(file.read_text()).get("attributes", {})
        if name.endswith((".tif", ".tiff")):
            import tifffile

            with tifffile.TiffFile(path) as tiff:
                return bool(tiff.is_ome and METADATA_KEY in (tiff.ome_metadata or ""))
    except (OSError, ValueError, AttributeError):  # unreadable: not ours
        return False
    return False


def read_layers(path: str | Sequence[str]) -> list[LayerData]:
    """A movie we wrote, lazily, its model in ``metadata["napari_mufasa"]``."""
    return [movie_layer(path if isinstance(path, (str, os.PathLike)) else path[0])]


def movie_layer(path: str | os.PathLike[str]) -> LayerData:
    """Any TIFF or zarr movie (frame, y, x) as an Image layer; contrast from one frame, so that it stays lazy."""
    from napari_mufasa.io import read_movie

    movie = read_movie(path)
    data = movie.data
    options: dict[str, Any] = {
        "name": _stem(path),
        "axis_labels": ("frame", "y", "x"),
        "contrast_limits": contrast(data),
    }
    if movie.model is not None:
        options |= movie_space(movie.model) | {"metadata": _metadata(movie.model, movie.seed)}
    return data, options, "image"


# writers ------------------------------------------------------------------------------------------------
def write_image(path: str, data: Any, attributes: dict[str, Any]) -> list[str]:
    """An Image layer as OME-TIFF or zarr, with its model; streamed in blocks of frames."""
    from napari_mufasa.errors import MufasaError
    from napari_mufasa.io import write_movie
    from napari_mufasa.model import Model

    data = data[0] if attributes.get("multiscale") else data
    stack = data if data.ndim == 3 else data[np.newaxis] if data.ndim == 2 else None
    if stack is None or attributes.get("rgb"):
        raise MufasaError(f"layer has shape {tuple(data.shape)}: a movie is (frame, y, x); save it in another format")
    stored = attributes.get("metadata", {}).get(METADATA_KEY) or {}
    model = Model.from_dict(stored["model"]) if stored.get("model") else None
    blocks = (np.asarray(stack[start : start + BLOCK_FRAMES]) for start in range(0, len(stack), BLOCK_FRAMES))
    units = [str(unit) for unit in attributes.get("units", ())] or ["pixel"]
    size_um = float(attributes["scale"][-1]) if units[-1] in ("micrometer", "um", "µm") else None
    write_movie(
        path, blocks, tuple(stack.shape), stack.dtype, model=model, seed=stored.get("seed"),
        pixel_size_nm=size_um * 1000 if size_um else None,
    )  # fmt: skip
    return [path]


# sample data ----------------------------------------------------------------------------------------------
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
    from napari_mufasa.presets import preset
    from napari_mufasa.simulation import simulate

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
    options = movie_space(model) | {
        "name": f"{name} sample",
        "metadata": _metadata(model, 1),
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
    from napari_mufasa.model import Model

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
    from napari_mufasa.effects import effect_from_data

    return effect_from_data(HIDDEN[int(np.random.default_rng(seed).integers(len(HIDDEN)))])


def sample_hidden_effect(seed: int = PUZZLE_SEED) -> list[LayerData]:
    """A measurement whose believed model lacks one effect, and its dark frames. The metadata do not tell which."""
    from napari_mufasa.simulation import simulate, simulate_dark

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
    shared = movie_space(believed) | {"colormap": "gray"}
    return [
        (dark, shared | {"name": dark_name, "visible": False, "metadata": of_dark}, "image"),
        (movie, shared | {"name": "hidden effect", "contrast_limits": contrast(movie), "metadata": of_movie}, "image"),
    ]


def movie_space(model: Model) -> dict[str, Any]:
    """Scale and units of a (frame, y, x) layer: pixels in µm, the frame axis in frames."""
    size_um = model.acquisition.pixel_size_nm / 1000
    return {"scale": (1.0, size_um, size_um), "units": ("pixel", "um", "um"), "axis_labels": ("frame", "y", "x")}


def _metadata(model: Model, seed: int | None) -> dict[str, Any]:
    return {METADATA_KEY: {"model": model.to_dict(), "seed": seed}}


def contrast(movie: Any) -> tuple[float, float]:
    """Contrast limits from eight frames spread over the movie, so that a lazy one stays lazy."""
    chosen = np.unique(np.linspace(0, len(movie) - 1, 8).astype(int))
    frames = np.stack([np.asarray(movie[int(t)], dtype=np.float32) for t in chosen])
    low, high = (float(v) for v in np.percentile(frames, (1, 99.9)))
    # Coarse digitisation may leave a handful of levels: then the largest count is white.
    return low, high if high - low > 4 else max(float(frames.max()), low + 1e-3)


def _stem(path: str | os.PathLike[str]) -> str:
    name = Path(path).name
    for suffix in (".ome.tiff", ".ome.tif", *MOVIE_SUFFIXES):
        if name.lower().endswith(suffix):
            return name[: -len(suffix)]
    return name
