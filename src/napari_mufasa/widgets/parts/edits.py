"""Value widgets for what magicgui has none for: numbers in any notation, lists, per-pixel maps, layers."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

import napari
import numpy as np
from magicgui.widgets import ComboBox, FileEdit, LineEdit
from napari.layers import Image, Layer, Points
from napari.viewer import Viewer

from napari_mufasa.errors import MufasaError
from napari_mufasa.files.layers import stored
from napari_mufasa.report.fields import number_text

PLACE = "where the model fails"  # role of layers that show misfit: never a movie


class TypedEdit(LineEdit):
    """A value typed as text; ``changed`` once it was typed to its end, or set. Empty is None where None is allowed.

    Its value raises `MufasaError` while the text is none.
    """

    def __init__(self, *, empty: str = "", **options: Any) -> None:
        self._shown, self._kept = "", None  # the text last shown or read, and what it stands for
        super().__init__(**options)
        self.native.setPlaceholderText(empty or ("none" if self._nullable else ""))
        self.native.editingFinished.connect(self._on_finished)

    def parse(self, text: str) -> Any:
        """The value of a text; raises ValueError that says what to type."""
        raise NotImplementedError(f"{type(self).__name__} has no parse()")

    def spell(self, value: Any) -> str:
        """The text of a value."""
        raise NotImplementedError(f"{type(self).__name__} has no spell()")

    def get_value(self) -> Any:
        text = self.native.text()
        if text == self._shown:  # the digits that are not shown count, too
            return self._kept
        if not text.strip() and self._nullable:
            return None
        try:
            return self.parse(text.strip())
        except ValueError as error:
            raise MufasaError(f"{self.name} = {text!r}: {error}") from None

    def set_value(self, value: Any) -> None:
        text = "" if value is None else self.spell(value)
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


class NumberEdit(TypedEdit):
    """A number in any notation (0.02, 2e-9), `min` to `max`."""

    def __init__(
        self, *, whole: bool = False, min: float | None = None, max: float | None = None, **options: Any
    ) -> None:
        self.whole, self.min, self.max = whole, min, max
        super().__init__(**options)

    def parse(self, text: str) -> float | int:
        try:
            number = float(text.replace("−", "-").replace(",", "."))
            value = int(number) if self.whole else number
        except (ValueError, OverflowError):
            raise ValueError("give a number") from None
        if self.whole and value != number:
            raise ValueError("give a whole number")
        if (self.min is not None and value < self.min) or (self.max is not None and value > self.max):
            most = " or more" if self.max is None else f" … {number_text(self.max)}"
            raise ValueError(f"give {number_text(self.min)}{most}")
        return value

    def spell(self, value: float) -> str:
        return number_text(value)


class ListEdit(TypedEdit):
    """Numbers, `0:0, 200:180` pairs of them, or words, separated by commas; nothing: none. A tuple."""

    def __init__(self, *, of: str = "numbers", **options: Any) -> None:
        self.of = of
        super().__init__(**options)

    def parse(self, text: str) -> tuple[Any, ...]:
        parts = [part.strip() for part in text.split(",") if part.strip()]
        if self.of == "words":
            return tuple(parts)
        in_pairs = self.of == "pairs"
        try:
            groups = [tuple(float(number) for number in part.split(":")) for part in parts]
            if any(len(group) != 1 + in_pairs for group in groups):
                raise ValueError
        except ValueError:
            raise ValueError(f"give {'pairs, e.g. 0:0, 200:180' if in_pairs else 'numbers, e.g. 0, 0.5, 1'}") from None
        return tuple(groups) if in_pairs else tuple(number for (number,) in groups)

    def spell(self, value: Iterable[Any]) -> str:
        if self.of == "words":
            return ", ".join(value)
        return ", ".join(":".join(f"{number:g}" for number in np.atleast_1d(group)) for group in value)


class ShapeEdit(TypedEdit):
    """A pair of whole numbers: `96 × 128`."""

    def parse(self, text: str) -> tuple[int, int]:
        parts = re.split(r"[\s×x,]+", text)
        if len(parts) != 2 or not all(part.isdecimal() for part in parts):
            raise ValueError("give two whole numbers: height × width")
        return int(parts[0]), int(parts[1])

    def spell(self, value: Any) -> str:
        return f"{value[0]} × {value[1]}"


class MapEdit(FileEdit):
    """A per-pixel map: the path of a TIFF, or the map itself; empty: none."""

    def __init__(self, **options: Any) -> None:
        self._shown, self._kept = "", None
        super().__init__(filter="TIFF (*.tif *.tiff)", nullable=True, **options)
        self.choose_btn.text, self.choose_btn.tooltip = "TIFF …", "Read the map from a 2-D TIFF"
        line = self.line_edit.native
        line.setPlaceholderText("none")
        line.setClearButtonEnabled(True)
        self.line_edit.changed.disconnect()  # at every key
        line.editingFinished.connect(lambda: self.changed.emit(self.value) if line.text() != self._shown else None)

    def get_value(self) -> Any:
        text = self.line_edit.native.text()
        return self._kept if text == self._shown else text or None

    def set_value(self, value: Any) -> None:
        text = "" if value is None else str(value)
        if np.ndim(value) == 2:
            text = " × ".join(str(n) for n in value.shape) + " map"
        is_new = text != self.line_edit.native.text()
        self._shown, self._kept = text, value
        self.line_edit.native.setText(text)
        if is_new:
            self.changed.emit(value)


class LayerEdit(ComboBox):
    """A layer of the viewer, or any other that it is given; of a `kind`: "movie", "dark" frames, or "points"."""

    def __init__(self, *, kind: str = "movie", **options: Any) -> None:
        self.kind = kind
        self.null_string = "the sample's layout" if kind == "points" else "none"
        self.viewer: Viewer | None = None  # None: the current one
        self._given: Layer | None = None
        super().__init__(**(options | {"choices": LayerEdit.offered}))

    def offered(self) -> list[tuple[str, Layer]]:
        """Names and layers to choose from. Dark frames and pictures of misfit are never the movie."""
        viewer = self.viewer or napari.current_viewer()
        kind = Points if self.kind == "points" else Image
        barred = {"points": (), "dark": (PLACE,), "movie": (PLACE, "dark frames")}[self.kind]
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
