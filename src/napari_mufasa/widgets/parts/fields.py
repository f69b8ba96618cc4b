"""Editors made from pydantic fields: label, unit, tooltip and range come from the model itself."""

from __future__ import annotations

import types
import typing
from typing import Any, Literal, Union, get_args, get_origin

import numpy as np
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from qtpy.QtCore import Signal  # type: ignore[attr-defined]
from qtpy.QtWidgets import (
    QComboBox,
    QFileDialog,
    QFormLayout,
    QHBoxLayout,
    QLabel,
    QLineEdit,
    QPushButton,
    QWidget,
)

UNITS = {  # endings of names; longer ones first where one ends the other
    "_per_M_cm": "1/(M cm)",
    "_w_per_cm2": "W/cm²",
    "_photons_per_px": "photons/px",
    "_per_s": "1/s",
    "_frames": "frames",
    "_adu": "ADU",
    "_e2": "(e⁻)²",
    "_deg": "°",
    "_nm": "nm",
    "_px": "px",
    "_e": "e⁻",
    "_s": "s",
}
NAMED_UNITS = {"electrons_per_adu": "e⁻/ADU", "n_frames": ""}
LABELS = {
    "n_frames": "Frames",
    "n_molecules": "Molecules",
    "shape_px": "Detector (height, width)",
    "psf_fwhm_nm": "PSF width (FWHM)",
    "adc_max": "Largest count",
    "em_gain": "EM gain",
    "electrons_per_adu": "Electrons per count",
    "cmos_gain_curve": "CMOS gain curve",
    "isc_ratio": "Triplet crossing α_isc",
    "type": "Type",
}
EMPTY = {"frame_interval_s": "no dead time", "high_resolution_factor": "exact integrals"}
ERROR_STYLE = "QLineEdit { border: 1px solid #e0605e; }"


def unit_of(name: str, owner: type[BaseModel] | None = None) -> str:
    """The unit in a parameter's name (`psf_fwhm_nm` → nm), or the one an effect declares."""
    declared = getattr(owner, "unit", None)
    if callable(declared) and declared(name):
        return "°" if declared(name) == "deg" else str(declared(name))
    if name in NAMED_UNITS:
        return NAMED_UNITS[name]
    return next((unit for ending, unit in UNITS.items() if name.endswith(ending)), "")


def label_of(name: str) -> str:
    """`frame_length_s` → "Frame length"."""
    if name in LABELS:
        return LABELS[name]
    for ending in UNITS:
        name = name.removesuffix(ending) if len(name) > len(ending) + 1 else name
    words = name.replace("_", " ").strip()
    return words[:1].upper() + words[1:]


def bounds_of(field: FieldInfo) -> str:
    """The allowed range in words."""
    signs = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}
    found = []
    for constraint in field.metadata:
        for name, sign in signs.items():
            limit = getattr(constraint, name, None)
            if limit is not None:
                found.append(f"{sign} {limit:g}")
    return " and ".join(found)


def number_text(value: float | None) -> str:
    """A number as one types it: no noise digits, powers of ten where they help."""
    if value is None:
        return ""
    if isinstance(value, int) or (float(value).is_integer() and abs(value) < 1e7):
        return str(int(value))
    return f"{value:.6g}"


class NumberEdit(QLineEdit):
    """A number in any notation (0.02, 2e-9); empty means `null` where the field allows it."""

    edited = Signal()

    def __init__(self, whole: bool = False, optional: bool = False, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._whole, self._optional = whole, optional
        self._value: float | None = None
        if optional:
            self.setPlaceholderText("off")
        self.editingFinished.connect(self._on_editing_finished)

    def value(self) -> float | int | None:
        """What is typed; raises ValueError when it is no number."""
        text = self.text().strip().replace("−", "-").replace(",", ".")
        if not text:
            if self._optional:
                return None
            raise ValueError("give a number")
        number = float(text)
        if self._whole:
            if number != int(number):
                raise ValueError(f"{text}: give a whole number")
            return int(number)
        return number

    def set_value(self, value: float | None) -> None:
        self._value = value
        self.setText(number_text(value))
        self.setStyleSheet("")

    def _on_editing_finished(self) -> None:
        if self.text() != number_text(self._value):
            self.edited.emit()


class ShapeEdit(QLineEdit):
    """A pair of whole numbers: `96 × 128`."""

    edited = Signal()

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._shown = ""
        self.editingFinished.connect(lambda: self.edited.emit() if self.text() != self._shown else None)

    def value(self) -> tuple[int, int]:
        parts = self.text().replace("×", " ").replace("x", " ").replace(",", " ").split()
        if len(parts) != 2:
            raise ValueError("give two whole numbers: height × width")
        return int(parts[0]), int(parts[1])

    def set_value(self, value: Any) -> None:
        self._shown = f"{value[0]} × {value[1]}"
        self.setText(self._shown)
        self.setStyleSheet("")


class ChoiceEdit(QComboBox):
    """One of a few words."""

    edited = Signal()

    def __init__(self, choices: tuple[str, ...], parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.addItems([str(choice) for choice in choices])
        self.activated.connect(lambda _i: self.edited.emit())

    def value(self) -> str:
        return self.currentText()

    def set_value(self, value: str) -> None:
        self.setCurrentText(str(value))


class MapEdit(QWidget):
    """A per-pixel map: its shape, a button that reads a TIFF, one that takes it away."""

    edited = Signal()

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._value: Any = None
        self._label = QLabel("none")
        choose, clear = QPushButton("TIFF …"), QPushButton("×")
        choose.setToolTip("Read the map from a 2-D TIFF")
        clear.setMaximumWidth(26)
        clear.setToolTip("No map")
        choose.clicked.connect(self._choose)
        clear.clicked.connect(lambda: self._take(None))
        layout = QHBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        for widget in (self._label, choose, clear):
            layout.addWidget(widget, 1 if widget is self._label else 0)

    def value(self) -> Any:
        return self._value

    def set_value(self, value: Any) -> None:
        self._value = value
        self._label.setText("none" if value is None else str(value) if isinstance(value, str) else _shape(value))

    def _choose(self) -> None:
        path, _ = QFileDialog.getOpenFileName(self, "Per-pixel map", filter="TIFF (*.tif *.tiff)")
        if path:
            self._take(path)

    def _take(self, value: Any) -> None:
        self.set_value(value)
        self.edited.emit()


class ListEdit(QLineEdit):
    """Numbers, or `0:0, 200:180` pairs of them, separated by commas; nothing: none."""

    edited = Signal()

    def __init__(self, pairs: bool = False, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._shown, self._pairs = "", pairs
        self.editingFinished.connect(lambda: self.edited.emit() if self.text() != self._shown else None)

    def value(self) -> tuple[Any, ...]:
        parts = [part for part in self.text().split(",") if part.strip()]
        try:
            pairs = [tuple(float(number) for number in part.split(":")) for part in parts]
        except ValueError:
            pairs = [()]
        if any(len(pair) != 1 + self._pairs for pair in pairs):
            raise ValueError("give pairs, e.g. 0:0, 200:180" if self._pairs else "give numbers, e.g. 0, 0.5, 1")
        return tuple(pairs) if self._pairs else tuple(pair[0] for pair in pairs)

    def set_value(self, value: Any) -> None:
        pairs = value if self._pairs else [(number,) for number in value]
        self._shown = ", ".join(":".join(f"{number:g}" for number in pair) for pair in pairs)
        self.setText(self._shown)
        self.setCursorPosition(0)
        self.setStyleSheet("")


def _shape(value: Any) -> str:
    return " × ".join(str(n) for n in np.shape(value)) + " map"


def editor_for(field: FieldInfo) -> Any:
    """The editor that fits a field's type."""
    annotation: Any = field.annotation
    options = [annotation]
    if get_origin(annotation) in (Union, types.UnionType):
        options = [arg for arg in get_args(annotation) if arg is not type(None)]
    optional = type(None) in get_args(annotation)
    kind = options[0]
    if get_origin(kind) is Literal:
        return ChoiceEdit(get_args(kind))
    if kind in (int, float):
        return NumberEdit(whole=kind is int, optional=optional)
    if get_origin(kind) is tuple:
        first, *_, last = get_args(kind)
        return ListEdit(pairs=get_origin(first) is tuple) if last is Ellipsis else ShapeEdit()
    if kind is typing.Any:
        return MapEdit()
    raise TypeError(f"no editor for {annotation}")


class Form(QWidget):
    """All fields of one pydantic model, one row each; ``edited(name)`` when the user changed one."""

    edited = Signal(str)

    def __init__(self, model: type[BaseModel], names: tuple[str, ...] | None = None) -> None:
        super().__init__()
        self._layout = QFormLayout(self)
        self._layout.setContentsMargins(4, 2, 4, 4)
        self._layout.setVerticalSpacing(3)
        self._layout.setFieldGrowthPolicy(QFormLayout.FieldGrowthPolicy.AllNonFixedFieldsGrow)
        self.editors: dict[str, Any] = {}
        for name, field in model.model_fields.items():
            if names is not None and name not in names:
                continue
            editor = editor_for(field)
            unit, bounds = unit_of(name, model), bounds_of(field)
            tip = (field.description or label_of(name)) + (f"\nallowed: {bounds}" if bounds else "")
            tip += "\nempty: off" if isinstance(editor, NumberEdit) and editor._optional else ""
            editor.setToolTip(tip)
            editor.edited.connect(lambda name=name: self.edited.emit(name))
            label = QLabel(label_of(name))
            label.setToolTip(tip)
            label.setBuddy(editor)
            editor.setAccessibleName(f"{label_of(name)} {unit}".strip())
            if isinstance(editor, NumberEdit) and name in EMPTY:
                editor.setPlaceholderText(EMPTY[name])
            row = QWidget()
            inside = QHBoxLayout(row)
            inside.setContentsMargins(0, 0, 0, 0)
            inside.setSpacing(4)
            unit_label = QLabel(unit)
            unit_label.setFixedWidth(64)
            inside.addWidget(editor, 1)
            inside.addWidget(unit_label)
            self._layout.addRow(label, row)
            self.editors[name] = editor

    def show_values(self, values: BaseModel) -> None:
        for name, editor in self.editors.items():
            editor.set_value(getattr(values, name))

    def value(self, name: str) -> Any:
        return self.editors[name].value()

    def mark(self, name: str, wrong: bool) -> None:
        self.editors[name].setStyleSheet(ERROR_STYLE if wrong else "")

    def show_row(self, name: str, visible: bool) -> None:
        index = list(self.editors).index(name)
        self._layout.setRowVisible(index, visible)
