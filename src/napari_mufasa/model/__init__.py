"""What is believed: a `Setup` (instrument, sample), a `Model` (a set-up and its effects), presets. Data, no physics."""

from napari_mufasa.model.effect import Effect, parameter
from napari_mufasa.model.model import Model
from napari_mufasa.model.presets import PRESETS, preset
from napari_mufasa.model.registry import catalogue, effect_class, effect_from_data
from napari_mufasa.model.setup import MAPS, Acquisition, Camera, Excitation, Fluorophore, Optics, Sample, Setup

__all__ = [
    "MAPS", "PRESETS", "Acquisition", "Camera", "Effect", "Excitation", "Fluorophore", "Model", "Optics", "Sample",
    "Setup", "catalogue", "effect_class", "effect_from_data", "parameter", "preset",
]  # fmt: skip
