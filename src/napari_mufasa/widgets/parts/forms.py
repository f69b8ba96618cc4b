"""Forms: magicgui Containers made from a function's signature (`widget_of`) or from a pydantic model (`PartForm`).

Labels, units, ranges, tooltips and choices come from annotations, docstrings and fields; nothing is said twice.
"""

from __future__ import annotations

import types
import typing
from collections.abc import Callable, Mapping
from typing import Any, Literal, Union, get_args, get_origin

from magicgui.widgets import CheckBox, ComboBox, Container, FunctionGui, Widget
from napari.viewer import Viewer
from psygnal import Signal
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from qtpy.QtCore import QObject
from qtpy.QtWidgets import QComboBox, QLabel, QLineEdit, QPushButton, QSizePolicy, QWidget

from napari_mufasa.model.model import Model
from napari_mufasa.report.fields import bounds_of, label_of, told
from napari_mufasa.widgets.parts.edits import ListEdit, MapEdit, NumberEdit, ShapeEdit
from napari_mufasa.widgets.parts.pieces import Words, column
from napari_mufasa.widgets.parts.preferences import preference
from napari_mufasa.widgets.turns.session import Session, session_of, unwrapped

EMPTY = {"frame_interval_s": "no dead time", "high_resolution_factor": "exact integrals"}
ERROR_STYLE = "QLineEdit { border: 1px solid #e0605e; }"


# a function's form ----------------------------------------------------------------------------------------
def widget_of(
    function: Callable[..., Any], call_button: str | Literal[False], preferences: Mapping[str, str] | None = None
) -> Callable[..., FunctionGui[..., Any]]:
    """What makes the widget of a step: its function's parameters, and called like the function.

    `preferences`: parameters that begin with a setting of the user.
    """
    # magicgui does not look for the names of annotations in the function's own module.
    function.__annotations__ = typing.get_type_hints(function, include_extras=True)
    label = call_button

    def make(viewer: Viewer | None = None, call_button: str | Literal[False] = label) -> FunctionGui[..., Any]:
        form: FunctionGui[..., Any] = FunctionGui(function, call_button=call_button, auto_call=False)
        for name, setting in (preferences or {}).items():
            form[name].value = preference(setting)
        dress(form)
        if viewer is not None:
            Shared(form, viewer)
        return form

    make.__name__ = make.__qualname__ = f"{function.__name__}_widget"
    make.__doc__ = f"The widget of `{function.__name__}`; of a viewer, with the movie and the model of all its steps."
    return make


class Shared(QObject):
    """Keeps movie, dark frames and model of a form those of the viewer's session, both ways; lives with the form."""

    def __init__(self, form: Any, viewer: Viewer) -> None:
        super().__init__(form.native)
        viewer, names = unwrapped(viewer), form.asdict()
        session = self.session = session_of(viewer)
        self._layers = [form[name] for name in ("movie", "dark", "molecules") if name in names]
        for widget in self._layers:
            widget.viewer = viewer
        self.reset_choices()
        events = viewer.layers.events
        for event in (events.inserted, events.removed, events.reordered, events.renamed):
            event.connect(self.reset_choices)
        setters = {"movie": session.set_movie, "dark": session.set_dark, "dark_frames": session.set_dark_frames}
        self._values = {name: form[name] for name in setters if name in names}
        movie = self._values.get("movie")
        if movie is not None and session.movie_layer is None and movie.value is not None:
            session.set_movie(movie.value)
        self._showing = False  # what the session says, not the user
        for name, widget in self._values.items():
            widget.changed.connect(lambda value, setter=setters[name]: None if self._showing else setter(value))
        session.movie_changed.connect(self.refresh)
        self.refresh()
        if "model" in names:
            form["model"].follow(session)

    def refresh(self) -> None:
        session = self.session
        now = {"movie": session.movie_layer, "dark": session.dark_layer, "dark_frames": session.dark_frames}
        self._showing = True
        for name, widget in self._values.items():
            if name != "movie" or now["movie"] is not None:
                widget.value = now[name]
        self._showing = False

    def reset_choices(self, _event: Any = None) -> None:
        try:
            for widget in self._layers:
                widget.reset_choices()
        except RuntimeError:  # the form is gone, the layer list is not
            self._layers = []


# a pydantic model's form ----------------------------------------------------------------------------------
class PartForm(Container[Widget]):
    """All fields of one pydantic model, a widget each; ``edited(name)`` when the user changed one.

    An edit is handed to ``take(name, value)``; what that raises is told below the form.
    """

    edited = Signal(str)

    def __init__(
        self,
        model: type[BaseModel],
        names: tuple[str, ...] | None = None,
        take: Callable[[str, Any], Any] | None = None,
    ) -> None:
        fields = {n: field for n, field in model.model_fields.items() if names is None or n in names}
        super().__init__(widgets=[widget_for(name, field, model) for name, field in fields.items()])
        dress(self)
        self.problem = Words()
        self.native.layout().addWidget(self.problem)
        for widget in self:
            widget.changed.connect(lambda _value, name=widget.name: self.edited.emit(name))  # type: ignore[attr-defined]
        if take is not None:
            self.edited.connect(lambda name: self._hand_over(name, take))

    def show_values(self, values: BaseModel) -> None:
        """Show the fields of an instance; nobody is told."""
        with self.edited.blocked():
            for widget in self:
                widget.value = getattr(values, widget.name)  # type: ignore[attr-defined]
                self._mark(widget, False)
        self.problem.say("")

    def read(self, name: str) -> Any:
        """What is typed; raises `MufasaError` when it is no value."""
        return self[name].value  # type: ignore[attr-defined]

    def _hand_over(self, name: str, take: Callable[[str, Any], Any]) -> None:
        problem = ""
        try:
            take(name, self.read(name))
        except ValidationError as error:
            problem = f"{name}: {error.errors()[0]['msg']}"
        except ValueError as error:  # MufasaError is one
            problem = str(error)
        self._mark(self[name], bool(problem))
        self.problem.say(problem, error=True)

    def _mark(self, widget: Widget, wrong: bool) -> None:
        for line in (widget.native, *widget.native.findChildren(QLineEdit)):
            style = ERROR_STYLE if wrong else ""
            if isinstance(line, QLineEdit) and line.styleSheet() != style:  # Qt lays the whole form out again
                line.setStyleSheet(style)


def widget_for(name: str, field: FieldInfo, owner: type[BaseModel] | None = None) -> Any:
    """The widget that fits a field's type."""
    annotation: Any = field.annotation
    kinds = get_args(annotation) if get_origin(annotation) in (Union, types.UnionType) else (annotation,)
    kind: Any = next(k for k in kinds if k is not type(None))
    bounds, optional = bounds_of(field), type(None) in kinds
    tip = (field.description or label_of(name)) + (f"\nallowed: {bounds}" if bounds else "")
    shared: dict[str, Any] = {"name": name, "label": told(name, owner), "tooltip": tip}
    if get_origin(kind) is Literal:
        return ComboBox(choices=get_args(kind), **shared)
    if kind is bool:
        return CheckBox(**shared)
    if kind in (int, float):
        shared["tooltip"] += "\nempty: off" if optional else ""
        empty = EMPTY.get(name, "off" if optional else "")
        return NumberEdit(whole=kind is int, nullable=optional, empty=empty, **shared)
    if get_origin(kind) is tuple:
        first, *_, last = get_args(kind)
        if last is not Ellipsis:
            return ShapeEdit(**shared)
        return ListEdit(of="pairs" if get_origin(first) is tuple else "numbers", **shared)
    if kind is typing.Any:
        return MapEdit(**shared)
    raise TypeError(f"no widget for {name}: {annotation}")


# of a session's model ------------------------------------------------------------------------------------
class PartEditor(QWidget):
    """The form of one part of the session's model; every valid edit goes into the session at once."""

    def __init__(self, session: Session, part: str, names: tuple[str, ...] | None = None) -> None:
        super().__init__()
        self.session, self.part = session, part
        kind: Any = Model.model_fields[part].annotation
        self.form = PartForm(kind, names, self._take)
        column(self, self.form.native)
        session.model_changed.connect(self.refresh)
        self.refresh()

    def refresh(self) -> None:
        values = getattr(self.session.model, self.part)
        self.form.show_values(values)
        if self.part == "camera":
            self.form["em_gain"].visible = values.type == "EMCCD"
            self.form["cmos_gain_curve"].visible = values.type == "CMOS"

    def _take(self, name: str, value: Any) -> None:
        values = {f"{self.part}.{name}": value}
        if (self.part, name) == ("camera", "type"):
            gain = self.session.model.camera.em_gain
            values["camera.em_gain"] = (gain or 300) if value == "EMCCD" else None
        origin = self.session.model_origin.removesuffix(" (edited)")
        self.session.set_model(self.session.model.with_values(values), f"{origin} (edited)")


class DerivedValues(QLabel):
    """What follows from the model, live."""

    def __init__(self, session: Session) -> None:
        super().__init__()
        self.session = session
        self.setWordWrap(True)
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Minimum)
        session.model_changed.connect(self.refresh)
        self.refresh()

    def refresh(self) -> None:
        from napari_mufasa.report.words import derived_values

        rows = derived_values(self.session.model)
        cells = "".join(f"<tr><td>{n}&nbsp;&nbsp;</td><td><b>{v}</b></td></tr>" for n, v, _ in rows)
        self.setText(f"<table>{cells}</table>")
        self.setToolTip("\n".join(f"{name}: {why}" for name, _, why in rows))


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
    """A widget with a name for screen readers, its combo boxes narrower than their longest entry: docks are narrow."""
    for native in (widget.native, *widget.native.findChildren(QLineEdit), *widget.native.findChildren(QComboBox)):
        if not isinstance(native, QPushButton) and not native.accessibleName():
            native.setAccessibleName(widget.label)
        if isinstance(native, QComboBox):
            native.setMinimumContentsLength(10)
            native.setSizeAdjustPolicy(QComboBox.SizeAdjustPolicy.AdjustToMinimumContentsLengthWithIcon)
            native.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)
    return widget
