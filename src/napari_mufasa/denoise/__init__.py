"""Denoising: the physics run backwards (SPEC.md §5).

`napari_mufasa.denoise` is this package and also the function `pipeline.denoise`: the package can be called.
"""

from __future__ import annotations

import sys
from types import ModuleType
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


class _CallableModule(ModuleType):
    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self.denoise(*args, **kwargs)


# Importing any module below makes `napari_mufasa.denoise` the package; the public contract is a function.
sys.modules[__name__].__class__ = _CallableModule
