"""The model: a set-up and its effects, all that is needed to simulate a movie; JSON in and out.

Models are immutable; ``model.with_values({"optics.psf_fwhm_nm": 320})`` gives a changed copy.
"""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, SerializeAsAny, ValidationError

from napari_mufasa import checks
from napari_mufasa.errors import MufasaError
from napari_mufasa.files.whole import read_json, write_text
from napari_mufasa.model.effect import Effect
from napari_mufasa.model.explain import explain
from napari_mufasa.model.extent import Extent
from napari_mufasa.model.registry import effect_class, effect_from_data
from napari_mufasa.model.setup import MAPS, Camera, Setup


def _effects(value: Any) -> Any:
    if not isinstance(value, (list, tuple)):
        return value
    effects = [_effect(item, f"effects.{i}") for i, item in enumerate(value)]
    kinds = [effect.kind for effect in effects]
    for i, kind in enumerate(kinds):
        if kind in kinds[:i]:
            raise MufasaError(f"effects.{i}: {kind} is in the model already: give one of each kind")
    return effects


def _effect(data: Any, path: str) -> Effect:
    try:
        return effect_from_data(data)
    except ValidationError as error:
        raise MufasaError(explain(error, effect_class(str(data["kind"])), path)) from None
    except ValueError as error:
        raise MufasaError(f"{path}: {error}") from None


class Model(Setup):
    """Sample, photophysics, excitation, optics, camera and effects: all a movie needs."""

    effects: Annotated[tuple[SerializeAsAny[Effect], ...], BeforeValidator(_effects)] = ()
    effects_refer_to: Extent | None = None  # the part of the movie that effects speak of; None: all of it

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Model:
        """Build a model from plain data; raises `MufasaError` naming field, value, range and remedy."""
        try:
            return cls.model_validate(data)
        except ValidationError as error:
            raise MufasaError(explain(error, cls)) from None

    @classmethod
    def from_json(cls, path: str | os.PathLike[str]) -> Model:
        """Read a model.json (docs/model.md); raises `MufasaError` in one clear line."""
        data = read_json(path, "a model.json (see 'presets')")
        if not isinstance(data, dict):
            raise MufasaError(f"{path} holds a {type(data).__name__}, not a model: see 'presets FF' for the form")
        if data and set(data) <= set(Camera.model_fields):
            raise MufasaError(
                f'{path} holds a camera alone, no model: put it under "camera" of a model.json, or let propose make one'
            )
        try:
            return cls.from_dict(data)
        except MufasaError as error:
            raise MufasaError(f"{path}: {error}") from None

    @classmethod
    def stored_in(cls, metadata: Mapping[str, Any]) -> Model | None:
        """The model that travelled with a movie ("model" in its metadata), None without; warns where it cannot be
        restored: the movie is still good, perhaps an effect's package is not installed."""
        if not metadata.get("model"):
            return None
        try:
            camera = metadata["model"].get("camera") if isinstance(metadata["model"], dict) else None
            if isinstance(camera, dict) and any(isinstance(camera.get(name), str) for name in MAPS):
                raise MufasaError("its camera's maps are files elsewhere: give its model.json")
            return cls.from_dict(metadata["model"])
        except MufasaError as error:
            warnings.warn(f"the model stored with the movie cannot be restored ({error})", stacklevel=2)
            return None

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON-ready data."""
        return self.model_dump(mode="json")

    def to_json(self, path: str | os.PathLike[str]) -> None:
        """Write model.json (to a temporary name first, so that nothing is ever half-written)."""
        write_text(path, json.dumps(self.to_dict(), indent=1) + "\n")

    def with_values(self, values: Mapping[str, Any]) -> Model:
        """A copy with some values changed, named by dotted path, validated anew."""
        data = self.model_dump()
        for path, value in values.items():
            *parents, name = path.split(".")
            target: Any = data
            for parent in parents:
                target = _member(target, parent)
            if not isinstance(target, dict) or name not in target:
                raise MufasaError(f"a model has no {path}: use the names of model.json, as optics.psf_fwhm_nm")
            target[name] = value
        return Model.from_dict(data)

    def in_shape(
        self,
        *,
        n_frames: int | None = None,
        shape_px: tuple[int, int] | None = None,
        region: tuple[slice, slice, slice] | None = None,
        maps: Camera | Literal["own"] | None = "own",
    ) -> Model:
        """The model for a movie of another length or shape.

        Parameters
        ----------
        n_frames, shape_px : frames and (height, width) of that movie; None: as they are
        region : (frames, rows, columns) that it shows of this one, instead of these: the camera's maps are cropped,
            and effects still speak of what they spoke of
        maps : whose maps the pixels have: the model's "own", another camera's, or None: a made-up field has none

        Raises
        ------
        MufasaError : maps that do not have the movie's shape.
        """
        timing, camera = self.acquisition, self.camera if maps == "own" else maps
        extent = self.effects_refer_to
        if region is not None:
            camera = None if camera is None else camera.of_part(*region[1:])
            whole = (timing.n_frames, *timing.shape_px)
            n_frames, height, width = (len(range(*part.indices(n))) for part, n in zip(region, whole, strict=True))
            shape_px = (height, width)
            extent = (extent or Extent()).seen_from(Extent.of(region, whole))
        found: dict[str, Any] = {name: getattr(camera, name, None) for name in MAPS}
        shape = timing.shape_px if shape_px is None else (int(shape_px[0]), int(shape_px[1]))
        for name, value in found.items():
            if value is not None and value.shape != tuple(shape):
                raise MufasaError(f"camera.{name} is {value.shape}, the movie {tuple(shape)}: give a map of the movie")
        frames = timing.n_frames if n_frames is None else int(n_frames)
        changed = self.model_copy(
            update={
                "acquisition": timing.model_copy(update={"n_frames": frames, "shape_px": shape}),
                "camera": self.camera.model_copy(update=found),
            }
        )
        return changed.referring_to(extent)

    def referring_to(self, extent: Extent | None) -> Model:
        """The model whose effects speak of that part of the movie."""
        nothing = extent is None or extent.is_whole or not self.effects
        return self.model_copy(update={"effects_refer_to": None if nothing else extent})

    @property
    def hides_molecules(self) -> bool:
        """Whether effects leave many of its molecules too dim to be found one by one."""
        return any(effect.hides_molecules for effect in self.effects)

    def with_effects(self, *effects: Effect) -> Model:
        """A copy with further effects; one of a kind already there is replaced."""
        for effect in effects:
            checks.need(effect, Effect, "an effect", "give effect_class(KIND)(…), or catalogue()[KIND](…)")
        new = {effect.kind for effect in effects}
        kept = tuple(effect for effect in self.effects if effect.kind not in new)
        return self.model_copy(update={"effects": kept + effects})


def _member(target: Any, name: str) -> Any:
    """A part of nested plain data by key or index; None where there is none."""
    if isinstance(target, (list, tuple)) and name.isdecimal() and int(name) < len(target):
        return target[int(name)]
    return target.get(name) if isinstance(target, dict) else None
