"""Photophysics from traces: brightness, bleaching, dark state and activation, with what cannot be told apart."""

from napari_mufasa.infer.photophysics import Photophysics, infer_photophysics

__all__ = ["Photophysics", "infer_photophysics"]
