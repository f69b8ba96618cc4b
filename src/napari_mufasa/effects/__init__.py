"""The effects: one physical mechanism each, a module or two per stage. They change a scene; they know no observable."""

from napari_mufasa.model.effect import Effect, parameter
from napari_mufasa.model.registry import catalogue, effect_class, effect_from_data

__all__ = ["Effect", "catalogue", "effect_class", "effect_from_data", "parameter"]
