"""What is missing: effects with their evidence, what to check at the microscope, Add and Undo."""

from __future__ import annotations

from typing import TYPE_CHECKING

from qtpy.QtCore import Signal  # type: ignore[attr-defined]
from qtpy.QtWidgets import QCheckBox, QHBoxLayout, QTextBrowser, QVBoxLayout, QWidget

from napari_mufasa.report.words import detectable_rows, effect_title, in_text, words_of
from napari_mufasa.widgets.parts.panel import boxed, button, wrapped
from napari_mufasa.widgets.parts.preferences import preference
from napari_mufasa.widgets.parts.tables import RowTable

if TYPE_CHECKING:
    from napari_mufasa.discover.result import Candidate, Report


class WhatPage(QWidget):
    """``add_clicked`` and ``undo_clicked``; `candidate` is the effect chosen."""

    add_clicked = Signal()
    undo_clicked = Signal()

    def __init__(self) -> None:
        super().__init__()
        self.report: Report | None = None
        self.ranking = RowTable(
            ["Effect", "Evidence", "Error after", "p"], "Effects that could be missing, the best first"
        )
        self.ranking.itemSelectionChanged.connect(self._show_candidate)
        # A text that scrolls by itself: a wrapped label would push the buttons out of sight.
        self.details = QTextBrowser()
        self.details.setMinimumHeight(110)
        self.details.setHtml("Effects that could explain the misfit appear above, the best one first.")
        self.add_button = button(
            "Add to the model", self.add_clicked.emit, "Fit this effect and put it into the model", enabled=False
        )
        self.undo_button = button("Undo", self.undo_clicked.emit, "Take the last effect out again", enabled=False)
        self.simulate_box = QCheckBox("show its movie beside the measured one")
        self.simulate_box.setToolTip("A movie of the completed model, its molecules at the measured places")
        self.simulate_box.setChecked(bool(preference("picture.show_simulated")))
        layout = QVBoxLayout(self)
        layout.addWidget(self.ranking, 2)
        layout.addWidget(self.details, 1)
        layout.addWidget(boxed((self.add_button, self.undo_button), QHBoxLayout()))
        layout.addWidget(self.simulate_box)

    @property
    def candidate(self) -> Candidate | None:
        row = self.ranking.currentRow()
        if self.report is None or not 0 <= row < len(self.report.ranking):
            return None
        return self.report.ranking[row]

    def show_report(self, report: Report) -> None:
        self.report = report
        self.ranking.fill((c.effect, _cells(c), words_of(c)) for c in report.ranking)
        if report.ranking:
            self._show_candidate()
        else:
            self.details.setHtml("No further effect was tried.")
            self.add_button.setText("Add to the model")

    def _show_candidate(self) -> None:
        candidate = self.candidate
        if candidate is not None:
            self.details.setHtml(words_of(candidate))
            self.add_button.setText(f"Add {in_text(candidate.effect)}")


def _cells(candidate: Candidate) -> list[str]:
    after = "–" if candidate.error_after is None else f"{candidate.error_after:.2f}"
    return [effect_title(candidate.effect), f"{candidate.evidence:.0f}", after, f"{candidate.p_value:.1g}"]


class DetectablePage(QWidget):
    """What this data would have shown: not seen is not absent."""

    def __init__(self) -> None:
        super().__init__()
        self.table = RowTable(
            ["Effect", "Would show from"], "Smallest strength of each effect that this data would have shown"
        )
        layout = QVBoxLayout(self)
        layout.addWidget(
            wrapped(
                "The model is adequate. That does not mean that nothing else is there: this is the smallest strength "
                "of each effect that this data would have shown in four cases of five."
            )
        )
        layout.addWidget(self.table, 1)

    def show_report(self, report: Report) -> None:
        self.table.fill((kind, [title, strength], tip) for kind, title, strength, tip in detectable_rows(report))
