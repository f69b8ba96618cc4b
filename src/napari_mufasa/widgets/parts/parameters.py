"""Parameters that several steps share, as annotations that magicgui reads."""

from __future__ import annotations

from typing import Annotated, Any, TypeAlias

from napari.layers import Image, Points
from pydantic import NonNegativeFloat, confloat

from napari_mufasa.channels import Channels as Registered
from napari_mufasa.model.model import Model
from napari_mufasa.widgets.parts.edits import ChannelsEdit, LayerEdit, TypedEdit
from napari_mufasa.widgets.parts.model_edit import ModelEdit

_MOVIE: dict[str, Any] = {
    "widget_type": LayerEdit, "label": "Movie", "tooltip": "The movie, an Image layer (frame, y, x)",
}  # fmt: skip
_DARK: dict[str, Any] = {
    "widget_type": LayerEdit, "kind": "dark", "label": "Dark frames",
    "tooltip": "Frames without light, recorded with the same camera settings",
}  # fmt: skip
_DARK_FRAMES: dict[str, Any] = {
    "label": "… or first frames dark", "min": 0, "max": 1_000_000,
    "tooltip": "Number of frames at the start of the movie that were taken without light",
}  # fmt: skip
_MODEL: dict[str, Any] = {
    "widget_type": ModelEdit, "label": "Model", "tooltip": "None: the model in the movie's metadata",
}  # fmt: skip
NUMBER: dict[str, Any] = {"widget_type": TypedEdit, "of": NonNegativeFloat}
_GAIN = NUMBER | {
    "label": "EM gain", "of": confloat(ge=1), "empty": "300 for an EMCCD", "tooltip": "If it is known",
}  # fmt: skip
_PER_ADU = NUMBER | {"label": "Electrons per count", "empty": "from the EM gain"}
_EFFICIENCY = NUMBER | {
    "label": "Quantum efficiency", "of": confloat(ge=0, le=1), "tooltip": "Photoelectrons per photon, as stated",
}  # fmt: skip
_SEED: dict[str, Any] = {
    "label": "Seed", "min": 0, "max": 2**31 - 1, "tooltip": "The same seed gives the same answer",
}  # fmt: skip
Movie: TypeAlias = Annotated[Image, _MOVIE]
AnyMovie: TypeAlias = Annotated[Image | None, _MOVIE]
Dark: TypeAlias = Annotated[Image | None, _DARK]
DarkFrames: TypeAlias = Annotated[int, _DARK_FRAMES]
Molecules: TypeAlias = Annotated[Points | None, {"widget_type": LayerEdit, "kind": "points", "label": "Molecules at"}]
Channels: TypeAlias = Annotated[Registered | None, {"widget_type": ChannelsEdit, "label": "Two channels"}]
Believed: TypeAlias = Annotated[Model | None, _MODEL]
EmGain: TypeAlias = Annotated[float | None, _GAIN]
ElectronsPerAdu: TypeAlias = Annotated[float | None, _PER_ADU]
Efficiency: TypeAlias = Annotated[float, _EFFICIENCY]
Seed: TypeAlias = Annotated[int, _SEED]
