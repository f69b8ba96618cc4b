"""Pages of step Discover: where the model fails, and what is missing."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from napari.viewer import Viewer
from qtpy.QtCore import Signal  # type: ignore[attr-defined]
from qtpy.QtWidgets import QCheckBox, QTextBrowser, QWidget

from napari_mufasa.report.offscreen import drawing
from napari_mufasa.report.words import failing_rows, in_text, matching_curve, observable_text, ranking_rows, words_of
from napari_mufasa.widgets.parts.pieces import RowTable, Words, button, column, made, row
from napari_mufasa.widgets.parts.plot import PlotCanvas
from napari_mufasa.widgets.parts.preferences import preference

if TYPE_CHECKING:
    from napari_mufasa.discover.result import Candidate, Report

COLUMNS = ("x", "measured", "before", "before_sd", "after", "after_sd")


class WherePage(QWidget):
    """Observables with their distance from the model; one clicked is plotted, and ``chosen(observable)`` tells of it.
    `place` says in words where in the image it is."""

    chosen = Signal(str)

    def __init__(self, viewer: Viewer) -> None:
        super().__init__()
        self.report: Report | None = None
        self.failing = RowTable(["What is measured", "z before", "z now"], "Observables that the model misses")
        self.failing.itemSelectionChanged.connect(self._on_selected)
        self.failing.cellClicked.connect(lambda *_: self._on_selected())  # the row may be selected already
        self.curve = PlotCanvas(viewer, "Click an observable to see it measured and as the model has it.", 240)
        tip = "A layer of measured minus simulated in standard deviations, or the molecules it is of"
        self.in_image = preferred_box("show its place in the image", "picture.show_place", tip)
        self.place = Words()
        column(self, self.failing, self.curve, self.in_image, self.place, shares=(1, 2))

    def show_report(self, report: Report) -> None:
        self.report = report
        self.place.say("")
        self.failing.setColumnHidden(2, not report.chosen)
        self.failing.fill(failing_rows(report))
        if report.failing:
            self._draw(self.failing.key)
        else:
            self.curve.clear("The model describes every observable within its noise.")

    def _on_selected(self) -> None:
        if name := self.failing.key:
            self._draw(name)
            self.chosen.emit(name)

    def _draw(self, name: str) -> None:
        import pandas as pd

        assert self.report is not None
        observables, curve = self.report.observables, matching_curve(name, self.report.curves)
        found = observables[observables["observable"] == name]
        title = observable_text(found.iloc[0], bool(self.report.chosen)) if len(found) else ""
        if curve is None:  # a single number: it is shown among the others
            self.curve.draw(drawing("z_scores", observables), observables, title)
        else:
            data = pd.DataFrame({column: getattr(curve, column) for column in COLUMNS})
            self.curve.draw(drawing("curve", curve), data, title)


class WhatPage(QWidget):
    """Effects with their evidence, what to check at the microscope, Add and Undo; `candidate` is the effect chosen."""

    def __init__(self, add: Callable[[], Any], undo: Callable[[], Any]) -> None:
        super().__init__()
        self.report: Report | None = None
        columns = ["Effect", "Evidence", "Error after", "p"]
        self.ranking = RowTable(columns, "Effects that could be missing, the best first")
        self.ranking.itemSelectionChanged.connect(self._show_candidate)
        # A text that scrolls by itself: a wrapped label would push the buttons out of sight.
        hint = "Effects that could explain the misfit appear above, the best one first."
        self.details = made(QTextBrowser, html=hint, minimumHeight=110)
        self.add_button = button("Add to the model", add, "Fit this effect and put it into the model", enabled=False)
        self.undo_button = button("Undo", undo, "Take the last effect out again", enabled=False)
        tip = "A movie of the completed model, its molecules at the measured places"
        self.simulate_box = preferred_box("show its movie beside the measured one", "picture.show_simulated", tip)
        buttons = row(self.add_button, self.undo_button)
        column(self, self.ranking, self.details, buttons, self.simulate_box, shares=(2, 1))

    @property
    def candidate(self) -> Candidate | None:
        number = self.ranking.currentRow()
        ranking = self.report.ranking if self.report is not None else ()
        return ranking[number] if 0 <= number < len(ranking) else None

    def show_report(self, report: Report) -> None:
        self.report = report
        self.ranking.fill(ranking_rows(report))
        self._show_candidate()

    def _show_candidate(self) -> None:
        candidate = self.candidate
        self.details.setHtml(words_of(candidate) if candidate is not None else "No further effect was tried.")
        self.add_button.setText(f"Add {in_text(candidate.effect)}" if candidate is not None else "Add to the model")


def preferred_box(text: str, setting: str, tooltip: str) -> QCheckBox:
    """A check box that begins as the user prefers."""
    return made(QCheckBox, text, toolTip=tooltip, checked=bool(preference(setting)))
