"""napari-mufasa: simulate, denoise, extract, compare, and find the physics a model lacks.

The public names, imported on first use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from napari_mufasa.compare.wasserstein import wasserstein
    from napari_mufasa.denoise import denoise, pure_let
    from napari_mufasa.discover import diagnose
    from napari_mufasa.effects import Effect
    from napari_mufasa.errors import Cancelled, MufasaError
    from napari_mufasa.model import Camera, Model
    from napari_mufasa.presets import preset
    from napari_mufasa.simulation import simulate, simulate_dark, simulate_emission
    from napari_mufasa.traces import extract_traces

_HOMES = {
    "Camera": "model",
    "Cancelled": "errors",
    "Effect": "effects",
    "Model": "model",
    "MufasaError": "errors",
    "denoise": "denoise",
    "diagnose": "discover",
    "extract_traces": "traces",
    "preset": "presets",
    "pure_let": "denoise",
    "simulate": "simulation",
    "simulate_dark": "simulation",
    "simulate_emission": "simulation",
    "wasserstein": "compare",
}

__all__ = [
    "Camera", "Cancelled", "Effect", "Model", "MufasaError", "denoise", "diagnose", "extract_traces", "preset",
    "pure_let", "simulate", "simulate_dark", "simulate_emission", "wasserstein",
]  # fmt: skip
__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"napari_mufasa has no {name}; public names are {', '.join(sorted(_HOMES))}")
    value = getattr(import_module(f"napari_mufasa.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
