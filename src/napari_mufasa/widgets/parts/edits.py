"""Value widgets for what magicgui has none for: numbers in any notation, tuples, per-pixel maps, layers."""

from __future__ import annotations

import re
from typing import Any, get_args, get_origin

import napari
import numpy as np
from magicgui.widgets import ComboBox, FileEdit, LineEdit
from napari.layers import Image, Layer, Points, Shapes
from napari.viewer import Viewer
from pydantic import TypeAdapter, ValidationError

from napari_mufasa.errors import MufasaError
from napari_mufasa.files.layers import stored
from napari_mufasa.report.fields import number_text

PLACE = "where the model fails"  # role of layers that show misfit: never a movie


class TypedEdit(LineEdit):
    """A value of a type, typed as text that pydantic reads; ``changed`` once it was typed to its end, or set.

    Numbers come in any notation (0.02, 2e-9), tuples as `0, 0.5, 1`, of pairs as `0:0, 200:180`, a shape as `96 × 128`.
    Empty is None where None is allowed. Its value raises `MufasaError` while the text is none.
    """

    def __init__(self, *, of: Any, empty: str = "", **options: Any) -> None:
        self.of = of
        self._shown, self._kept = "", None  # the text last shown or read, and what it stands for
        super().__init__(**options)
        self.native.setPlaceholderText(empty or ("none" if self._nullable else ""))
        self.native.editingFinished.connect(self._on_finished)

    def get_value(self) -> Any:
        text = self.native.text()
        if text == self._shown:  # the digits that are not shown count, too
            return self._kept
        if not text.strip() and self._nullable:
            return None
        try:
            return TypeAdapter(self.of).validate_python(_parts(text, self.of))
        except ValidationError as error:
            raise MufasaError(f"{self.name} = {text!r}: {error.errors()[0]['msg']}{_notation(self.of)}") from None

    def set_value(self, value: Any) -> None:
        text = "" if value is None else _spelled(value, " × " if _is_pair(self.of) else ", ")
        is_new = text != self.native.text()
        self._shown, self._kept = text, value
        self.native.setText(text)
        self.native.setCursorPosition(0)
        if is_new:
            self.changed.emit(value)

    def _on_value_change(self, value: Any = None) -> None:
        """Not at every key."""

    def _on_finished(self) -> None:
        if self.native.text() != self._shown:
            self.changed.emit(self.native.text())


def _is_pair(kind: Any) -> bool:
    return get_origin(kind) is tuple and get_args(kind)[-1] is not Ellipsis


def _parts(text: str, kind: Any) -> Any:
    """A text as pydantic takes it for a type: tuples taken apart, numbers with a decimal point."""
    if get_origin(kind) is tuple:
        parts = re.split(r"[\s×x:,]+" if _is_pair(kind) else ",", text.strip())
        return [_parts(part, get_args(kind)[0]) for part in parts if part.strip()]
    text = text.strip()
    try:
        return text if kind is str else float(text.replace("−", "-").replace(",", "."))
    except ValueError:
        return text


def _spelled(value: Any, sign: str) -> str:
    if np.ndim(value):
        return sign.join(_spelled(part, ":") for part in value)
    return value if isinstance(value, str) else number_text(value)


def _notation(kind: Any) -> str:
    """An example of how a tuple is typed."""
    if get_origin(kind) is not tuple:
        return ""
    return f"; give {'96 × 128' if _is_pair(kind) else '0:0, 200:180' if _is_pair(get_args(kind)[0]) else '0, 0.5, 1'}"


class HeldEdit(FileEdit):
    """The path of a file, or what such a file holds; empty: none."""

    filter_of, choose, tip = "", "…", ""

    def __init__(self, **options: Any) -> None:
        self._shown, self._kept = "", None
        super().__init__(**(options | {"filter": self.filter_of, "nullable": True}))
        self.choose_btn.text, self.choose_btn.tooltip = self.choose, self.tip
        line = self.line_edit.native
        line.setPlaceholderText("none")
        line.setClearButtonEnabled(True)
        self.line_edit.changed.disconnect()  # at every key
        line.editingFinished.connect(lambda: self.changed.emit(self.value) if line.text() != self._shown else None)

    def get_value(self) -> Any:
        text = self.line_edit.native.text()
        return self._kept if text == self._shown else text or None

    def set_value(self, value: Any) -> None:
        text = "" if value is None else self.told(value)
        is_new = text != self.line_edit.native.text()
        self._shown, self._kept = text, value
        self.line_edit.native.setText(text)
        self.line_edit.native.setCursorPosition(0)
        if is_new:
            self.changed.emit(value)

    def told(self, value: Any) -> str:
        """What is shown of a value that is there."""
        return str(value)


class MapEdit(HeldEdit):
    """A per-pixel map: the path of a TIFF, or the map itself; empty: none."""

    filter_of, choose, tip = "TIFF (*.tif *.tiff)", "TIFF …", "Read the map from a 2-D TIFF"

    def told(self, value: Any) -> str:
        return " × ".join(str(n) for n in value.shape) + " map" if np.ndim(value) == 2 else str(value)


class ChannelsEdit(HeldEdit):
    """Registered channels: the path of a channels.json, or the `Channels`; empty: the movie has one channel."""

    filter_of, choose, tip = "Channels (*.json)", "File …", "Read channels.json, which register writes"

    def told(self, value: Any) -> str:
        sides = getattr(value, "donor", None), getattr(value, "acceptor", None)
        return str(value) if None in sides else f"donor {sides[0]}, acceptor {sides[1]}"


NOTHING = {"points": "the sample's layout", "shapes": "none: halves of the frames"}


class LayerEdit(ComboBox):
    """A layer of the viewer, or any other that it is given; a "movie", "dark" frames, "points" or "shapes"."""

    def __init__(self, *, kind: str = "movie", **options: Any) -> None:
        self.kind = kind
        self.null_string = NOTHING.get(kind, "none")
        self.viewer: Viewer | None = None  # None: the current one
        self._given: Layer | None = None
        super().__init__(**(options | {"choices": LayerEdit.offered}))

    def offered(self) -> list[tuple[str, Layer]]:
        """Names and layers to choose from. Dark frames and pictures of misfit are never the movie."""
        viewer = self.viewer or napari.current_viewer()
        kind = {"points": Points, "shapes": Shapes}.get(self.kind, Image)
        barred = {"points": (), "shapes": (), "dark": (PLACE,), "movie": (PLACE, "dark frames")}[self.kind]
        layers = [*viewer.layers] if viewer is not None else []
        layers = [layer for layer in layers if isinstance(layer, kind) and stored(layer, "role") not in barred]
        if self._given is not None and self._given not in layers:
            layers.append(self._given)
        return [(layer.name, layer) for layer in layers]

    @property
    def value(self) -> Any:
        return ComboBox.value.fget(self)  # type: ignore[attr-defined]

    @value.setter
    def value(self, layer: Any) -> None:
        if layer is not None and layer not in self.choices:
            if not isinstance(layer, Layer):
                given = type(layer).__name__
                raise MufasaError(f"{self.name} is a {given}: give a layer, as napari.layers.Image(array)")
            self.reset_choices()  # the list may not yet have heard of it
            if layer not in self.choices:
                self._given = layer
                self.reset_choices()
        ComboBox.value.fset(self, layer)  # type: ignore[attr-defined]

    def reset_choices(self, *_: Any) -> None:
        """Follow the layer list; what was chosen stays chosen, also under a new name."""
        before = self.get_value()
        with self.changed.blocked():
            super().reset_choices()
            if before in self.choices:
                ComboBox.value.fset(self, before)  # type: ignore[attr-defined]
        after: Any = self.get_value()
        if after is not before:
            self.changed.emit(after)
