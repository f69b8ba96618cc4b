"""What an effect is: named parameters, what it does to a scene, and words a user understands.

An effect is data in ``model.effects``. The simulator builds a `Scene` from the model and lets every effect
change it once (`Effect.apply`); nothing else in the simulator knows which effects exist. A third party
registers a class under the entry-point group ``napari_mufasa.effects``.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, ClassVar, Literal, get_args, get_origin

import numpy as np
from pydantic import Field, SerializerFunctionWrapHandler, model_serializer

from napari_mufasa.model.setup import Setup, Values

REFERENCE = {"frame_s": 0.02, "movie_s": 6.0, "frames": 300.0, "noise_adu": 4.0}
"""The acquisition that plausible ranges are written for: 300 frames of 20 ms, 4 ADU read noise."""

STAGES = ("photophysics", "illumination", "sample motion", "optics and background", "camera")


def parameter(
    default: float, *, ge: float | None = None, gt: float | None = None, le: float | None = None,
    plausible: tuple[float, float], unit: str, description: str, log: bool = False, follows: str = "",
    forms: tuple[str, ...] = (),
) -> Any:  # fmt: skip
    """A numeric effect parameter: hard limits, the plausible range a search covers, unit and meaning.

    `plausible` is for the `REFERENCE` acquisition; `follows` names what it scales with ("movie_s": a bleaching
    rate is looked for where molecules bleach within the movie), "/" in front where it scales inversely. `forms`: the
    functional forms that it matters to; none named: all.
    """
    return Field(
        default,
        ge=ge,
        gt=gt,
        le=le,
        description=description,
        json_schema_extra={
            "plausible": list(plausible), "unit": unit, "log": log, "follows": follows, "forms": list(forms),
        },
    )  # fmt: skip


class Effect(Values):
    """One physical mechanism. Subclasses declare parameters as fields and override `apply`.

    Class attributes
    ----------------
    kind : identifier in model.json (docs/effects.md)
    stage : one of `STAGES`
    strength : name of the parameter whose zero (or `null_value`, see `none_at`) switches the effect off
    title, what_it_is, what_it_does, how_to_check : one paragraph a biologist understands, in three sentences
    observables : prefixes of the observables it moves most
    rivals : kinds it is easily confused with
    separated_by : the extra measurement that separates them
    common : whether a diagnosis considers it from the start (see `common_in`); the others are considered where the
        common ones leave a model off its floor
    describes_only : whether it repeats what a movie shows, whatever caused it: considered where no effect with a law
        of its own explains anything more, and no rival of one
    hides_molecules : whether it leaves many molecules too dim to be found one by one
    order : effects are applied by this number, those of one number by their kinds, however a model lists them. What
        adds molecules that others shall act on comes first (−1), what adds molecules of another kind last (1), what
        acts on all of them later (2); what happens to the charge of a sensor as it happens there
    """

    kind: ClassVar[str] = ""
    stage: ClassVar[str] = ""
    strength: ClassVar[str] = ""
    null_value: ClassVar[float] = 0.0
    title: ClassVar[str] = ""
    what_it_is: ClassVar[str] = ""
    what_it_does: ClassVar[str] = ""
    how_to_check: ClassVar[str] = ""
    observables: ClassVar[tuple[str, ...]] = ()
    rivals: ClassVar[tuple[str, ...]] = ()
    separated_by: ClassVar[str] = ""
    common: ClassVar[bool] = True
    describes_only: ClassVar[bool] = False
    hides_molecules: ClassVar[bool] = False
    order: ClassVar[int] = 0

    def apply(self, scene: Any, rng: np.random.Generator) -> None:
        """Change the scene (`simulate.Scene`) in place; `rng` is this effect's own stream."""
        # Not abstract: whoever writes a plug-in reads this line, no error about a class that cannot be made.
        raise NotImplementedError(f"effect {type(self).__name__} does nothing: override apply()")

    def in_the_dark(self) -> Effect:
        """The effect as dark frames have it, which are taken at another time than the movie."""
        return self

    @classmethod
    def suits(cls, setup: Setup) -> bool:
        """Whether the effect makes sense for this set-up (an EM register needs an EMCCD, …)."""
        return True

    @classmethod
    def same_as(cls, setup: Setup, beside: Collection[str]) -> tuple[str, ...]:
        """The rivals of which the effect is a special case in this set-up, with effects of these kinds beside it:
        nothing there tells them apart."""
        return ()

    @classmethod
    def common_in(cls, setup: Setup) -> bool:
        """Whether a diagnosis of this set-up considers the effect from the start."""
        return cls.common and cls.suits(setup)

    @classmethod
    def none_at(cls, setup: Setup) -> float:
        """The strength at which the effect changes nothing in this set-up."""
        return cls.null_value

    @model_serializer(mode="wrap")
    def _with_kind(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        # A serializer, not `model_dump`: only this one is used when the effect is part of a model.
        return {"kind": self.kind, **handler(self)}

    @classmethod
    def plausible(cls, setup: Setup | None = None) -> dict[str, tuple[float, float, bool]]:
        """Numeric parameters with their plausible range and whether it is searched on a log scale.

        The ranges are those of the set-up's acquisition, or of the `REFERENCE` one.
        """
        found = {}
        for name, field in cls.model_fields.items():
            extra = field.json_schema_extra
            if isinstance(extra, dict) and "plausible" in extra:
                bounds: Any = extra["plausible"]
                factor = 1.0 if setup is None else _relative_scale(str(extra["follows"]), setup)
                found[name] = (float(bounds[0]) * factor, float(bounds[1]) * factor, bool(extra["log"]))
        return found

    @classmethod
    def unit(cls, name: str) -> str:
        """The unit of a parameter, "" without one."""
        extra = cls.model_fields[name].json_schema_extra
        return str(extra.get("unit", "")) if isinstance(extra, dict) else ""

    @classmethod
    def forms(cls) -> tuple[str, ...]:
        """The functional forms the effect offers (its ``form`` field), or one unnamed form."""
        return cls.choices().get("form", ("",))

    def parameters(self) -> dict[str, Any]:
        """Name and value of what matters to the effect's form."""
        return {name: getattr(self, name) for name in type(self).model_fields if self.matters(name)}

    def matters(self, name: str) -> bool:
        """Whether a parameter changes anything in the effect's form."""
        return self.form_name in self.only_for(name)

    @classmethod
    def only_for(cls, name: str) -> set[str]:
        """The forms that a parameter matters to."""
        extra = cls.model_fields[name].json_schema_extra
        named: Any = extra.get("forms") if isinstance(extra, dict) else None
        return set(named or cls.forms())

    @classmethod
    def choices(cls) -> dict[str, tuple[str, ...]]:
        """Fields with named options: the form, and others like it."""
        fields = {name: field.annotation for name, field in cls.model_fields.items()}
        return {name: get_args(options) for name, options in fields.items() if get_origin(options) is Literal}

    @property
    def chosen(self) -> dict[str, str]:
        """The option of each of its `choices`; those of an effect without parameters given are its plain ones."""
        return {name: str(getattr(self, name)) for name in type(self).choices()}

    @property
    def form_name(self) -> str:
        """The functional form it has, "" where there is only one."""
        return str(getattr(self, "form", ""))


def _relative_scale(follows: str, setup: Setup) -> float:
    """How much larger the set-up's scale is than the reference's."""
    if not follows:
        return 1.0
    name = follows.removeprefix("/")
    ratio = _scales(setup)[name] / REFERENCE[name]
    return 1 / ratio if follows.startswith("/") else ratio


def _scales(setup: Setup) -> dict[str, float]:
    acquisition, camera = setup.acquisition, setup.camera
    return {
        "frame_s": acquisition.interval_s,
        "movie_s": acquisition.interval_s * acquisition.n_frames,
        "frames": float(acquisition.n_frames),
        "noise_adu": max(camera.read_noise_e / camera.electrons_per_adu, 1.0),
    }
