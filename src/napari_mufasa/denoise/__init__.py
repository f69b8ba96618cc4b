"""Denoising: the physics run backwards (docs/denoising.md)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .pipeline import denoise as denoise
    from .purelet import pure_let as pure_let
    from .temporal import pure_let_movie as pure_let_movie
    from .temporal import pure_let_traces as pure_let_traces

_HOMES = {
    "denoise": "pipeline",
    "pure_let": "purelet",
    "pure_let_movie": "temporal",
    "pure_let_traces": "temporal",
}
__all__ = ["denoise", "pure_let", "pure_let_movie", "pure_let_traces"]


def __getattr__(name: str) -> Any:
    # Imported on first use: numba alone takes half a second.
    if name not in _HOMES:
        raise AttributeError(f"module {__name__} has no attribute {name}")
    from importlib import import_module

    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
