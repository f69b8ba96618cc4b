"""Which effects there are: the built-in ones, stage by stage, then those that other packages register."""

from __future__ import annotations

import difflib
import warnings
from collections.abc import Mapping
from functools import cache
from importlib import metadata
from typing import Any

from napari_mufasa.model.effect import Effect

ENTRY_POINT_GROUP = "napari_mufasa.effects"
BUILT_IN = ("photophysics", "molecules", "illumination", "motion", "optics", "camera", "readout")  # by stage


@cache
def catalogue() -> dict[str, type[Effect]]:
    """All effects by kind: the built-in ones, stage by stage, then installed third-party ones.

    The built-in ones are entry points, too (a tuple of effects each): a model knows none of them by import.
    """
    ours = [metadata.EntryPoint(name, f"napari_mufasa.effects.{name}:EFFECTS", ENTRY_POINT_GROUP) for name in BUILT_IN]
    found: dict[str, type[Effect]] = {}
    for point in [*ours, *metadata.entry_points(group=ENTRY_POINT_GROUP)]:
        try:
            loaded = point.load()
        except Exception as error:  # someone else's broken package must not take the built-in effects away
            warnings.warn(f"effect plugin {point.name} ({point.value}) does not load: {error!r}", stacklevel=2)
            continue
        for effect in loaded if isinstance(loaded, tuple) else (loaded,):
            if not (isinstance(effect, type) and issubclass(effect, Effect) and effect.kind):
                warnings.warn(f"effect plugin {point.name} ({point.value}) is not an Effect with a kind", stacklevel=2)
                continue
            found.setdefault(effect.kind, effect)
    return found


def effect_class(kind: str) -> type[Effect]:
    """The class of an effect; raises ValueError naming near and known kinds."""
    known = catalogue()
    if kind not in known:
        near = difflib.get_close_matches(kind, known, n=1)
        hint = f"did you mean {near[0]}? " if near else ""
        raise ValueError(f"no effect {kind!r}: {hint}known effects are {', '.join(known)}")
    return known[kind]


def effect_from_data(data: Any) -> Effect:
    """An effect from ``{"kind": …, parameters}``, or the effect itself."""
    if isinstance(data, Effect):
        return data
    if not isinstance(data, Mapping) or "kind" not in data:
        raise ValueError(f'give an effect as {{"kind": …, parameters}}, not {data!r}')
    values = {name: value for name, value in data.items() if name != "kind"}
    return effect_class(str(data["kind"])).model_validate(values)
