"""Pages of step Discover: where the model fails, and what is missing."""

from __future__ import annotations

from collections.abc import Callable
from html import escape
from typing import TYPE_CHECKING, Any

from napari.viewer import Viewer
from qtpy.QtCore import Signal  # type: ignore[attr-defined]
from qtpy.QtWidgets import QCheckBox, QTextBrowser, QWidget

from napari_mufasa.report.offscreen import drawing
from napari_mufasa.report.words import (
    check_lines,
    failing_rows,
    in_text,
    matching_curve,
    observable_text,
    ranking_rows,
    words_of,
)
from napari_mufasa.widgets.parts.edits import LayerEdit
from napari_mufasa.widgets.parts.forms import dress_one
from napari_mufasa.widgets.parts.pieces import RowTable, Words, button, column, made, row
from napari_mufasa.widgets.parts.plot import PlotCanvas
from napari_mufasa.widgets.parts.preferences import preference

if TYPE_CHECKING:
    from napari_mufasa.discover.result import Candidate, Report

NOT_CHECKED = "Diagnosed apart, do other data of the same set-up say the same?"
CLICK = "Click an observable to see its place."
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
        self.place.say(CLICK if report.failing and self.in_image.isChecked() else "")
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
            self.curve.draw(drawing("z_scores", observables, also=name), observables, title)
        else:
            data = pd.DataFrame({column: getattr(curve, column) for column in COLUMNS})
            self.curve.draw(drawing("curve", curve), data, title)


class WhatPage(QWidget):
    """Effects with their evidence, what to check at the microscope, Add, Take out and Undo; `chosen` are the effects
    selected, several with Ctrl or Shift."""

    def __init__(self, add: Callable[[], Any], take_out: Callable[[], Any], undo: Callable[[], Any]) -> None:
        super().__init__()
        self.report: Report | None = None
        columns = ["Effect", "Evidence", "Error with", "without", "p"]
        self.ranking = RowTable(
            columns, "Effects in the model (✓) and those that could be missing, the best first", True
        )
        self.ranking.itemSelectionChanged.connect(self._show_candidate)
        # A text that scrolls by itself: a wrapped label would push the buttons out of sight.
        hint = "Effects that could explain the misfit appear above, the best one first."
        self.details = made(QTextBrowser, html=hint, minimumHeight=110)
        tip = "Fit the selected effects together, with all that is in the model already"
        self.add_button = button("Add to the model", add, tip, enabled=False)
        tip = "Take the selected effects out and fit the others anew: the column “without” tells the price"
        self.take_out_button = button("Take out", take_out, tip, enabled=False)
        self.undo_button = button("Undo", undo, "Take the last step back", enabled=False)
        tip = "A movie of the completed model, its molecules at the measured places"
        self.simulate_box = preferred_box("show its movie beside the measured one", "picture.show_simulated", tip)
        buttons = row(self.add_button, self.take_out_button, self.undo_button)
        column(self, self.ranking, self.details, buttons, self.simulate_box, shares=(2, 1))

    @property
    def chosen(self) -> list[Candidate]:
        by_kind = {c.effect: c for c in self.report.ranking} if self.report is not None else {}
        return [by_kind[kind] for kind in self.ranking.keys if kind in by_kind]

    @property
    def to_add(self) -> list[Candidate]:
        return [c for c in self.chosen if self.report is not None and c.effect not in self.report.chosen]

    @property
    def to_take_out(self) -> list[str]:
        return [c.effect for c in self.chosen if self.report is not None and c.effect in self.report.chosen]

    def show_report(self, report: Report) -> None:
        self.report = report
        self.ranking.fill(ranking_rows(report))
        self._show_candidate()

    def _show_candidate(self) -> None:
        told, new = "<hr>".join(words_of(candidate) for candidate in self.chosen), self.to_add
        self.details.setHtml(told or "No further effect was tried.")
        only = f"Add {in_text(new[0].effect)}" if new else "Add to the model"
        self.add_button.setText(only if len(new) < 2 else f"Add these {len(new)} together")


class CheckPage(QWidget):
    """Does the finding hold elsewhere: in the halves of the field apart, in another movie of the same set-up?"""

    def __init__(self, viewer: Viewer, halves: Callable[[], Any], other: Callable[[], Any]) -> None:
        super().__init__()
        tip = "Diagnose the two halves of the field apart: do they name the same effects, with the same parameters?"
        self.halves_button = button("Check on two halves", halves, tip, enabled=False)
        self.other = dress_one(LayerEdit(label="Other movie", nullable=True))
        self.other.viewer, self.other.null_string = viewer, "another movie of the same set-up …"
        self.other.reset_choices()
        for event in (viewer.layers.events.inserted, viewer.layers.events.removed):
            event.connect(self.other.reset_choices)
        tip = "Diagnose this other movie of the same set-up, and try the completed model on it"
        self.other_button = button("Check on it", other, tip, enabled=False)
        self.outcome = made(QTextBrowser, html=NOT_CHECKED)
        column(self, self.halves_button, row(self.other.native, self.other_button), self.outcome, shares=(2,))

    def show_report(self, report: Report) -> None:
        self.outcome.setHtml("<br>".join(escape(line) for line in check_lines(report.check)) or NOT_CHECKED)


def preferred_box(text: str, setting: str, tooltip: str) -> QCheckBox:
    """A check box that begins as the user prefers."""
    return made(QCheckBox, text, toolTip=tooltip, checked=bool(preference(setting)))
