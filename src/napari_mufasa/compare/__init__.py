"""Measured against simulated emission: W1, its floor, baselines, distributions (SPEC.md §7)."""

from napari_mufasa.compare.wasserstein import floor, wasserstein

__all__ = ["floor", "wasserstein"]
