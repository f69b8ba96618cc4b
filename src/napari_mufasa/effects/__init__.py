"""The catalogue of effects (SPEC.md §9): one module per stage, one class per effect."""

from napari_mufasa.effects.base import Effect, parameter
from napari_mufasa.effects.registry import catalogue, effect_class, effect_from_data

__all__ = ["Effect", "catalogue", "effect_class", "effect_from_data", "parameter"]
