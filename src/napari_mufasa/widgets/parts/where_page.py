"""Where it fails: observables with their distance from the model; one clicked is plotted and shown in the image."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from qtpy.QtCore import Signal  # type: ignore[attr-defined]
from qtpy.QtWidgets import QCheckBox, QVBoxLayout, QWidget

from napari_mufasa.report.offscreen import drawing
from napari_mufasa.report.words import matching_curve, observable_text
from napari_mufasa.widgets.parts.panel import wrapped
from napari_mufasa.widgets.parts.plot import PlotCanvas
from napari_mufasa.widgets.parts.preferences import preference
from napari_mufasa.widgets.parts.tables import RowTable

if TYPE_CHECKING:
    from napari.viewer import Viewer

    from napari_mufasa.discover.result import Report

COLUMNS = ("x", "measured", "before", "before_sd", "after", "after_sd")


class WherePage(QWidget):
    """``chosen(observable)`` when the user chooses a row; `place` says in words where in the image it is."""

    chosen = Signal(str)

    def __init__(self, viewer: Viewer) -> None:
        super().__init__()
        self.report: Report | None = None
        self.failing = RowTable(["What is measured", "z before", "z now"], "Observables that the model misses")
        self.failing.itemSelectionChanged.connect(self._on_selected)
        self.failing.cellClicked.connect(lambda *_: self._on_selected())  # the row may be selected already
        self.curve = PlotCanvas(viewer, "Click an observable to see it measured and as the model has it.", 240)
        self.in_image = QCheckBox("show its place in the image")
        self.in_image.setToolTip(
            "A layer of measured minus simulated in standard deviations, or the molecules it is of"
        )
        self.in_image.setChecked(bool(preference("picture.show_place")))
        self.place = wrapped()
        self.place.hide()
        layout = QVBoxLayout(self)
        layout.addWidget(self.failing, 1)
        layout.addWidget(self.curve, 2)
        layout.addWidget(self.in_image)
        layout.addWidget(self.place)

    def show_report(self, report: Report) -> None:
        self.report = report
        self.say_place("")
        self.failing.setColumnHidden(2, not report.chosen)
        self.failing.fill(_row(item) for item in report.failing)
        if report.failing:
            self._draw(self.selected())
        else:
            self.curve.clear("The model describes every observable within its noise.")

    def selected(self) -> str:
        """The chosen observable, empty when there is none."""
        return self.failing.key

    def say_place(self, words: str) -> None:
        self.place.setText(words)
        self.place.setVisible(bool(words))

    def _on_selected(self) -> None:
        name = self.selected()
        if name:
            self._draw(name)
            self.chosen.emit(name)

    def _draw(self, name: str) -> None:
        import pandas as pd

        assert self.report is not None
        observables, curve = self.report.observables, matching_curve(name, self.report.curves)
        row = observables[observables["observable"] == name]
        title = observable_text(row.iloc[0], bool(self.report.chosen)) if len(row) else ""
        if curve is None:  # a single number: it is shown among the others
            self.curve.draw(drawing("z_scores", observables), observables, title)
        else:
            data = pd.DataFrame({column: getattr(curve, column) for column in COLUMNS})
            self.curve.draw(drawing("curve", curve), data, title)


def _row(item: dict[str, Any]) -> tuple[str, list[str], str]:
    where = f"\n{item['where']}" if item.get("where") else ""
    title, now = str(item.get("title", item["observable"])), item.get("z_after")
    return str(item["observable"]), [title, f"{item['z']:+.1f}", "" if now is None else f"{now:+.1f}"], title + where
