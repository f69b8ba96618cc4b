"""The Model step: where the believed model comes from, every parameter, effects on and off, what follows from it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from qtpy.QtWidgets import (
    QComboBox,
    QFileDialog,
    QHBoxLayout,
    QLabel,
    QPushButton,
    QSizePolicy,
    QVBoxLayout,
    QWidget,
)
from superqt import QCollapsible

from napari_mufasa.errors import MufasaError
from napari_mufasa.model.presets import PRESETS
from napari_mufasa.widgets.parts.effects_list import EffectsList
from napari_mufasa.widgets.parts.fields import Form
from napari_mufasa.widgets.parts.layers import slim
from napari_mufasa.widgets.turns.jobs import Quiet, report_error
from napari_mufasa.widgets.turns.live import LiveLine
from napari_mufasa.widgets.turns.session import Session, model_in, session_of

if TYPE_CHECKING:
    from napari.viewer import Viewer

PARTS = ("acquisition", "fluorophore", "excitation", "optics", "camera", "sample")
FROM_FILE = "model.json …"
FROM_LAYER = "from the movie's metadata"


class ModelSource(QWidget):
    """Choose the believed model: a preset, a model.json, or what the movie's metadata say."""

    def __init__(self, session: Session) -> None:
        super().__init__()
        self.session = session
        self.combo = QComboBox()
        self.combo.addItems([*PRESETS, FROM_FILE, FROM_LAYER])
        slim(self.combo)
        self.combo.setToolTip("Where the believed model comes from")
        self.combo.activated.connect(self._on_chosen)
        self.save_button = QPushButton("Save …")
        self.save_button.setToolTip("Write the model as model.json")
        self.save_button.clicked.connect(self._save)
        self.origin = QLabel()
        self.origin.setWordWrap(True)
        self.combo.setAccessibleName("Model")
        row = QHBoxLayout()
        row.addWidget(QLabel("Model"))
        row.addWidget(self.combo, 1)
        row.addWidget(self.save_button)
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addLayout(row)
        layout.addWidget(self.origin)
        session.model_changed.connect(self._show)
        self._show()

    def choose(self, name: str) -> None:
        """As if the user had chosen `name` from the list."""
        self.combo.setCurrentText(name)
        self._on_chosen(self.combo.currentIndex())

    def open_file(self, path: str) -> None:
        from napari_mufasa.model.model import Model

        self._try(lambda: self.session.set_model(Model.from_json(path), Path(path).name))

    def _on_chosen(self, index: int) -> None:
        name = self.combo.itemText(index)
        if name == FROM_FILE:
            path, _ = QFileDialog.getOpenFileName(self, "Believed model", filter="Model (*.json)")
            if path:
                self.open_file(path)
        elif name == FROM_LAYER:
            self._try(self._from_layer)
        else:
            from napari_mufasa.model.presets import preset

            self._try(lambda: self.session.set_model(preset(name), f"preset {name}"))

    def _from_layer(self) -> None:
        layer = self.session.movie_layer
        model = model_in(layer) if layer is not None else None
        if layer is None or model is None:
            where = f"layer {layer.name}" if layer is not None else "no movie is chosen, so it"
            raise MufasaError(f"{where} carries no model: choose a preset or a model.json")
        self.session.set_model(model, f"metadata of {layer.name}")

    def _save(self) -> None:
        path, _ = QFileDialog.getSaveFileName(self, "Save model", "model.json", filter="Model (*.json)")
        if path:
            self._try(lambda: self.session.model.to_json(path))

    def _try(self, action: Any) -> None:
        try:
            action()
        except MufasaError as error:
            report_error(error)

    def _show(self) -> None:
        model, origin = self.session.model, self.session.model_origin
        plain = origin.removeprefix("preset ")
        known = plain if plain in PRESETS else FROM_LAYER if origin.startswith("metadata of") else ""
        self.combo.setPlaceholderText(origin)
        self.combo.setCurrentIndex(self.combo.findText(known))  # -1 shows the placeholder
        effects = ", ".join((effect.title or effect.kind).lower() for effect in model.effects)
        self.origin.setText(
            f"In use: {origin} · {model.protocol}, {model.camera.type}" + (f" · with {effects}" if effects else "")
        )


class PartEditor(QWidget):
    """The form of one part of the session's model; every valid edit goes into the session at once."""

    def __init__(self, session: Session, part: str, names: tuple[str, ...] | None = None) -> None:
        super().__init__()
        from napari_mufasa.model.model import Model

        self.session, self.part = session, part
        kind: Any = Model.model_fields[part].annotation
        self.form = Form(kind, names)
        self.problem = QLabel()
        self.problem.setWordWrap(True)
        self.problem.setStyleSheet("QLabel { color: #e0605e; }")
        self.problem.hide()
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addWidget(self.form)
        layout.addWidget(self.problem)
        self._quiet = Quiet(self)
        self.form.edited.connect(self._on_edited)
        session.model_changed.connect(self.refresh)
        self.refresh()

    def refresh(self) -> None:
        values = getattr(self.session.model, self.part)
        with self._quiet:
            self.form.show_values(values)
        self.problem.hide()
        if self.part == "camera":
            self.form.show_row("em_gain", values.type == "EMCCD")
            self.form.show_row("cmos_gain_curve", values.type == "CMOS")

    def _on_edited(self, name: str) -> None:
        if self._quiet:
            return
        try:
            values = {f"{self.part}.{name}": self.form.value(name)}
            if (self.part, name) == ("camera", "type"):
                gain = self.session.model.camera.em_gain
                values["camera.em_gain"] = (gain or 300) if values["camera.type"] == "EMCCD" else None
            model = self.session.model.with_values(values)
        except ValueError as error:  # MufasaError is one
            self.form.mark(name, True)
            self.problem.setText(str(error))
            self.problem.show()
            return
        self.form.mark(name, False)
        self.problem.hide()
        origin = self.session.model_origin
        self.session.set_model(model, origin if origin.endswith("(edited)") else f"{origin} (edited)")


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


class ModelPanel(QWidget):
    """Sources, effects, all parameters in folding sections, derived values."""

    title = "Model"

    def __init__(self, viewer: Viewer) -> None:
        super().__init__()
        session = self.session = session_of(viewer)
        self.source = ModelSource(session)
        self.derived, self.live = DerivedValues(session), LiveLine(session)
        self.effects = EffectsList(session)
        self.parts = {part: PartEditor(session, part) for part in PARTS}
        layout = QVBoxLayout(self)
        layout.setContentsMargins(6, 6, 6, 6)
        layout.addWidget(self.source)
        layout.addWidget(self.live)
        layout.addWidget(section("What follows", self.derived, True))
        layout.addWidget(section("Effects", self.effects, True))
        for part, editor in self.parts.items():
            layout.addWidget(section(part.capitalize(), editor, False))
        layout.addStretch(1)


def section(title: str, content: QWidget, is_open: bool) -> QCollapsible:
    """A part of a panel that folds away."""
    folding = QCollapsible(title)
    folding.setDuration(0)  # animations make the layout jump
    folding.setCollapsedIcon("▸")
    folding.setExpandedIcon("▾")
    folding.addWidget(content)
    layout: Any = folding.layout()
    layout.setContentsMargins(0, 0, 0, 0)
    if is_open:
        folding.expand(animate=False)
    return folding
