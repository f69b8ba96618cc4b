"""Forms of the parts of a session's model, and what follows from it."""

from __future__ import annotations

from typing import Any

from qtpy.QtWidgets import QLabel, QSizePolicy, QVBoxLayout, QWidget

from napari_mufasa.model.model import Model
from napari_mufasa.widgets.parts.forms import PartForm
from napari_mufasa.widgets.parts.panel import wrapped
from napari_mufasa.widgets.turns.session import Session


class PartEditor(QWidget):
    """The form of one part of the session's model; every valid edit goes into the session at once."""

    def __init__(self, session: Session, part: str, names: tuple[str, ...] | None = None) -> None:
        super().__init__()
        self.session, self.part = session, part
        kind: Any = Model.model_fields[part].annotation
        self.form = PartForm(kind, names)
        self.problem = wrapped(error=True)
        self.problem.hide()
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addWidget(self.form.native)
        layout.addWidget(self.problem)
        self.form.edited.connect(self._on_edited)
        session.model_changed.connect(self.refresh)
        self.refresh()

    def refresh(self) -> None:
        values = getattr(self.session.model, self.part)
        self.form.show_values(values)
        self.problem.hide()
        if self.part == "camera":
            self.form.show_row("em_gain", values.type == "EMCCD")
            self.form.show_row("cmos_gain_curve", values.type == "CMOS")

    def _on_edited(self, name: str) -> None:
        try:
            values = {f"{self.part}.{name}": self.form.read(name)}
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
