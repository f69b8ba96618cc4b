"""Measured against simulated emission: W1, its floor, baselines, distributions (docs/comparison.md)."""

from napari_mufasa.compare.comparison import Comparison, compare_movie, compare_traces, to_photoelectrons
from napari_mufasa.compare.distributions import Distribution, distributions
from napari_mufasa.compare.fit import Fit, fit_model
from napari_mufasa.compare.wasserstein import (
    Floor,
    bootstrap_interval,
    difference_interval,
    floor,
    wasserstein,
)

__all__ = [
    "Comparison",
    "Distribution",
    "Fit",
    "Floor",
    "bootstrap_interval",
    "compare_movie",
    "compare_traces",
    "difference_interval",
    "distributions",
    "fit_model",
    "floor",
    "to_photoelectrons",
    "wasserstein",
]
