"""Forms: magicgui Containers made from a function's signature (`step_form`) or from a pydantic model (`PartForm`).

Labels, units, ranges, tooltips and choices come from annotations and fields; nothing is said twice.
"""

from __future__ import annotations

import types
import typing
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Literal, Union, get_args, get_origin

from magicgui.widgets import CheckBox, ComboBox, Container, FunctionGui, Widget
from psygnal import Signal
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from qtpy.QtWidgets import QComboBox, QLabel, QLineEdit, QPushButton, QSizePolicy

from napari_mufasa.report.fields import bounds_of, label_of, told
from napari_mufasa.widgets.parts.edits import ListEdit, MapEdit, NumberEdit, ShapeEdit
from napari_mufasa.widgets.parts.preferences import preference

if TYPE_CHECKING:
    from napari.viewer import Viewer

EMPTY = {"frame_interval_s": "no dead time", "high_resolution_factor": "exact integrals"}
ERROR_STYLE = "QLineEdit { border: 1px solid #e0605e; }"


# a function's form ----------------------------------------------------------------------------------------
def step_form(
    function: Callable[..., Any],
    viewer: Viewer | None = None,
    call_button: str | Literal[False] = "Run",
    preferences: Mapping[str, str] | None = None,
) -> FunctionGui[..., Any]:
    """The widget of a step: its function's parameters, and called like the function.

    With a viewer its movie, dark frames and model are those of all other steps there. `preferences`: parameters that
    begin with a setting of the user.
    """
    # magicgui does not look for the names of annotations in the function's own module.
    function.__annotations__ = typing.get_type_hints(function, include_extras=True)
    form: FunctionGui[..., Any] = FunctionGui(function, call_button=call_button, auto_call=False)
    for name, setting in (preferences or {}).items():
        form[name].value = preference(setting)
    dress(form)
    if viewer is not None:
        from napari_mufasa.widgets.parts.shared import Shared

        Shared(form, viewer)
    return form


# a pydantic model's form ----------------------------------------------------------------------------------
class PartForm(Container[Widget]):
    """All fields of one pydantic model, a widget each; ``edited(name)`` when the user changed one."""

    edited = Signal(str)

    def __init__(self, model: type[BaseModel], names: tuple[str, ...] | None = None) -> None:
        fields = {n: field for n, field in model.model_fields.items() if names is None or n in names}
        made = [widget_for(name, field, model) for name, field in fields.items()]
        super().__init__(widgets=made)
        for widget in made:
            widget.changed.connect(lambda _value, name=widget.name: self.edited.emit(name))
        dress(self)

    def show_values(self, values: BaseModel) -> None:
        """Show the fields of an instance; nobody is told."""
        with self.edited.blocked():
            for widget in self:
                widget.value = getattr(values, widget.name)  # type: ignore[attr-defined]
                self.mark(widget.name, False)

    def read(self, name: str) -> Any:
        """What is typed; raises `MufasaError` when it is no value."""
        return self[name].value  # type: ignore[attr-defined]

    def mark(self, name: str, wrong: bool) -> None:
        for line in (self[name].native, *self[name].native.findChildren(QLineEdit)):
            style = ERROR_STYLE if wrong else ""
            if isinstance(line, QLineEdit) and line.styleSheet() != style:  # Qt lays the whole form out again
                line.setStyleSheet(style)

    def show_row(self, name: str, visible: bool) -> None:
        self[name].visible = visible


def widget_for(name: str, field: FieldInfo, owner: type[BaseModel] | None = None) -> Any:
    """The widget that fits a field's type."""
    annotation: Any = field.annotation
    kinds = get_args(annotation) if get_origin(annotation) in (Union, types.UnionType) else (annotation,)
    optional = type(None) in kinds
    kind: Any = next(k for k in kinds if k is not type(None))
    bounds = bounds_of(field)
    tip = (field.description or label_of(name)) + (f"\nallowed: {bounds}" if bounds else "")
    shared: dict[str, Any] = {"name": name, "label": told(name, owner)}
    if get_origin(kind) is Literal:
        return ComboBox(choices=get_args(kind), tooltip=tip, **shared)
    if kind is bool:
        return CheckBox(tooltip=tip, **shared)
    if kind in (int, float):
        tip += "\nempty: off" if optional else ""
        empty = EMPTY.get(name, "off" if optional else "")
        return NumberEdit(whole=kind is int, nullable=optional, empty=empty, tooltip=tip, **shared)
    if get_origin(kind) is tuple:
        first, *_, last = get_args(kind)
        if last is not Ellipsis:
            return ShapeEdit(tooltip=tip, **shared)
        return ListEdit(of="pairs" if get_origin(first) is tuple else "numbers", tooltip=tip, **shared)
    if kind is typing.Any:
        return MapEdit(tooltip=tip, **shared)
    raise TypeError(f"no widget for {name}: {annotation}")


# looks ------------------------------------------------------------------------------------------------
def dress(form: Container[Any]) -> None:
    """What magicgui leaves to others: labels in a column, names for screen readers, narrow combo boxes."""
    form.margins = (4, 2, 4, 4)
    form.native.layout().setSpacing(3)
    for widget in form:
        dress_one(widget)
    labels = [label for label in form.native.findChildren(QLabel) if label.parent().parent() is form.native]
    for label in labels:  # napari's font is larger than the one that magicgui measures with
        label.setMinimumWidth(round(1.25 * max(other.sizeHint().width() for other in labels)))


def dress_one(widget: Any) -> Any:
    """A widget with a name for screen readers, its combo boxes no wider than they need to be; the same widget."""
    for native in (widget.native, *widget.native.findChildren(QLineEdit), *widget.native.findChildren(QComboBox)):
        if not isinstance(native, QPushButton) and not native.accessibleName():
            native.setAccessibleName(widget.label)
        if isinstance(native, QComboBox):
            slim(native)
    return widget


def slim(combo: QComboBox) -> None:
    """Let a combo box be narrower than its longest entry: docks are narrow."""
    combo.setMinimumContentsLength(10)
    combo.setSizeAdjustPolicy(QComboBox.SizeAdjustPolicy.AdjustToMinimumContentsLengthWithIcon)
    combo.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)
