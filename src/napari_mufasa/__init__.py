"""napari-mufasa: simulate, denoise, extract, compare, and find the physics a model lacks.

The public names, imported on first use. Four of them (`simulate`, `denoise`, `calibrate`, `design`) are also the names
of sub-packages: those can be called like the function, so that importing anything below them hides nothing.
"""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from napari_mufasa.calibrate import Calibration, calibrate
    from napari_mufasa.channels import Channels, PairedTraces, SimulatedPair, extract_pair, register, simulate_pair
    from napari_mufasa.compare import Comparison, compare_movie, compare_traces
    from napari_mufasa.compare.wasserstein import wasserstein
    from napari_mufasa.denoise import denoise, pure_let
    from napari_mufasa.design.predict import Prediction, design, predict
    from napari_mufasa.design.solve import Solution, solve
    from napari_mufasa.discover import (
        Confirmation,
        Investigation,
        Power,
        Report,
        confirm,
        confirm_halves,
        diagnose,
        diagnose_traces,
        power,
        refine,
    )
    from napari_mufasa.effects import Effect, catalogue
    from napari_mufasa.errors import Cancelled, MufasaError
    from napari_mufasa.infer import Photophysics, infer_photophysics
    from napari_mufasa.model import Camera, Model, Setup, preset
    from napari_mufasa.propose import Mismatch, Proposal, mismatches, propose_model
    from napari_mufasa.simulate import SimulatedAcquisition, Simulation, simulate, simulate_dark, simulate_emission
    from napari_mufasa.traces import TraceSet, extract_traces

_HOMES = {
    "calibrate": ("Calibration", "calibrate"),
    "channels": ("Channels", "PairedTraces", "SimulatedPair", "extract_pair", "register", "simulate_pair"),
    "compare": ("Comparison", "compare_movie", "compare_traces", "wasserstein"),
    "denoise": ("denoise", "pure_let"),
    "design": ("Prediction", "Solution", "design", "predict", "solve"),
    "discover": (
        "Confirmation",
        "Investigation",
        "Power",
        "Report",
        "confirm",
        "confirm_halves",
        "diagnose",
        "diagnose_traces",
        "power",
        "refine",
    ),
    "effects": ("Effect", "catalogue"),
    "errors": ("Cancelled", "MufasaError"),
    "infer": ("Photophysics", "infer_photophysics"),
    "model": ("Camera", "Model", "Setup", "preset"),
    "propose": ("Mismatch", "Proposal", "mismatches", "propose_model"),
    "simulate": ("SimulatedAcquisition", "Simulation", "simulate", "simulate_dark", "simulate_emission"),
    "traces": ("TraceSet", "extract_traces"),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [
    "Calibration", "Camera", "Cancelled", "Channels", "Comparison", "Confirmation", "Effect", "Investigation",
    "Mismatch", "Model", "MufasaError", "PairedTraces", "Photophysics", "Power", "Prediction", "Proposal", "Report",
    "Setup", "SimulatedAcquisition", "SimulatedPair", "Simulation", "Solution", "TraceSet", "calibrate",
    "catalogue", "compare_movie", "compare_traces", "confirm", "confirm_halves", "denoise", "design", "diagnose",
    "diagnose_traces", "extract_pair", "extract_traces", "infer_photophysics", "mismatches", "power", "predict",
    "preset", "propose_model", "pure_let", "refine", "register", "simulate", "simulate_dark", "simulate_emission",
    "simulate_pair", "solve", "wasserstein",
]  # fmt: skip
__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"napari_mufasa has no {name}; public names are {', '.join(sorted(_HOME_OF))}")
    value = getattr(import_module(f"napari_mufasa.{_HOME_OF[name]}"), name)
    if name not in _HOMES:
        globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME_OF})


class _Callable(ModuleType):
    """A sub-package that is called like the public function of its name."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return getattr(self, self.__name__.rpartition(".")[2])(*args, **kwargs)


class _Package(ModuleType):
    """This package: where importing a sub-package would hide a function, the sub-package can be called."""

    def __setattr__(self, name: str, value: Any) -> None:
        if isinstance(value, ModuleType) and name in _HOME_OF:
            value.__class__ = _Callable
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
