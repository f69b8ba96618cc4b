"""Forms: how a step's magicgui widget begins, and magicgui Containers made from a pydantic model (`PartForm`).

Labels, units, ranges, tooltips and choices come from annotations, docstrings and fields; nothing is said twice.
"""

from __future__ import annotations

import types
import typing
from collections.abc import Callable
from functools import partial
from typing import Any, Literal, Union, get_args, get_origin

from magicgui.widgets import CheckBox, ComboBox, Container, FunctionGui, Widget, create_widget
from napari.viewer import Viewer
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from qtpy.QtCore import QObject
from qtpy.QtWidgets import QComboBox, QLabel, QLineEdit, QPushButton, QSizePolicy, QWidget

from napari_mufasa.model.model import Model
from napari_mufasa.report.fields import bounds_of, label_of, told
from napari_mufasa.widgets.parts.edits import MapEdit, TypedEdit
from napari_mufasa.widgets.parts.pieces import Words, column
from napari_mufasa.widgets.parts.preferences import preference
from napari_mufasa.widgets.turns.session import Session, session_of, unwrapped

EMPTY = {
    "frame_interval_s": "no dead time", "high_resolution_factor": "exact integrals", "excess_noise_factor": "2",
}  # fmt: skip
ERROR_STYLE = "QLineEdit { border: 1px solid #e0605e; }"
PREFERRED = {"seed": "steps.seed", "threshold_sigma": "steps.threshold_sigma", "fit": "steps.fit_before_comparing"}


# a function's form ----------------------------------------------------------------------------------------
def begin(form: FunctionGui[..., Any]) -> None:
    """The `widget_init` of every step: what the user prefers, our looks; in a dock of napari's it is `shared`."""
    for name in PREFERRED.keys() & form.asdict():
        form[name].value = preference(PREFERRED[name], form[name].value)
    whose: Any = create_widget(annotation=Viewer, gui_only=True)  # napari binds it to the viewer that it is put into
    form.append(whose)
    dress(form)

    def docked(parent: Any) -> None:
        if parent is not None and whose.value is not None:
            shared(form, whose.value)

    form.native_parent_changed.connect(docked)


def shared(form: Any, viewer: Viewer) -> Any:
    """A form whose movie, dark frames and model are those of a viewer's session, from now on."""
    if form.native.findChild(Shared) is None:
        Shared(form, viewer)
    return form


class Shared(QObject):
    """Keeps movie, dark frames and model of a form those of the viewer's session, both ways; lives with the form."""

    def __init__(self, form: Any, viewer: Viewer) -> None:
        super().__init__(form.native)
        viewer, names = unwrapped(viewer), form.asdict()
        session = self.session = session_of(viewer)
        self._layers = [form[name] for name in ("movie", "dark", "molecules", "beads", "regions") if name in names]
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
        if "channels" in names:
            self._channels = form["channels"]
            session.channels_changed.connect(self.show_channels)
            self.show_channels()

    def show_channels(self) -> None:
        self._channels.value = self.session.channels

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
    """The fields of one pydantic model, a widget each.

    What the user edits is handed to ``take(name, value)``; what that raises is told below the form.
    """

    def __init__(
        self, model: type[BaseModel], take: Callable[[str, Any], Any], names: tuple[str, ...] | None = None
    ) -> None:
        fields = {n: field for n, field in model.model_fields.items() if names is None or n in names}
        super().__init__(widgets=[widget_for(name, field, model) for name, field in fields.items()])
        dress(self)
        self.problem = Words()
        self.native.layout().addWidget(self.problem)
        for name in fields:
            self[name].changed.connect(partial(self._hand_over, name, take))  # type: ignore[attr-defined]

    def show_values(self, values: BaseModel) -> None:
        """Show the fields of an instance; nobody is told."""
        for widget in self:
            with widget.changed.blocked():  # type: ignore[attr-defined]
                widget.value = getattr(values, widget.name)  # type: ignore[attr-defined]
            self._mark(widget, False)
        self.problem.say("")

    def _hand_over(self, name: str, take: Callable[[str, Any], Any], _typed: Any = None) -> None:
        problem = ""
        try:
            take(name, self[name].value)  # type: ignore[attr-defined]
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


def widget_for(name: str, field: FieldInfo, owner: type[BaseModel]) -> Any:
    """The widget that fits a field's type."""
    annotation: Any = field.annotation
    kinds = get_args(annotation) if get_origin(annotation) in (Union, types.UnionType) else (annotation,)
    kind: Any = next(k for k in kinds if k is not type(None))
    bounds, optional = bounds_of(field), type(None) in kinds
    tip = (field.description or label_of(name)) + (f"\nallowed: {bounds}" if bounds else "")
    options: dict[str, Any] = {"name": name, "label": told(name, owner), "tooltip": tip}
    if get_origin(kind) is Literal:
        return ComboBox(choices=get_args(kind), **options)
    if kind is bool:
        return CheckBox(**options)
    if kind is typing.Any:
        return MapEdit(**options)
    empty = EMPTY.get(name, "off") if optional else ""
    options["tooltip"] += f"\nempty: {empty}" if optional else ""
    return TypedEdit(of=kind, nullable=optional, empty=empty, **options)


# of a session's model ------------------------------------------------------------------------------------
class PartEditor(QWidget):
    """The form of one part of the session's model; every valid edit goes into the session at once."""

    def __init__(self, session: Session, part: str, names: tuple[str, ...] | None = None) -> None:
        super().__init__()
        self.session, self.part = session, part
        kind: Any = Model.model_fields[part].annotation
        self.form = PartForm(kind, self._take, names)
        column(self, self.form.native)
        session.model_changed.connect(self.refresh)
        self.refresh()

    def refresh(self) -> None:
        values = getattr(self.session.model, self.part)
        self.form.show_values(values)
        if self.part == "camera":
            self.form["em_gain"].visible = self.form["excess_noise_factor"].visible = values.type == "EMCCD"
            self.form["cmos_gain_curve"].visible = values.type == "CMOS"

    def _take(self, name: str, value: Any) -> None:
        values = {f"{self.part}.{name}": value}
        if (self.part, name) == ("camera", "type"):
            gain = self.session.model.camera.em_gain
            values["camera.em_gain"] = (gain or 300) if value == "EMCCD" else None
            values["camera.excess_noise_factor"] = None  # the register's
        self.session.change_model(self.session.model.with_values(values), "edited")


class DerivedValues(Words):
    """What follows from the model, live."""

    def __init__(self, session: Session) -> None:
        super().__init__("…")
        self.session = session
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
