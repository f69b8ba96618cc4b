"""What is missing: effects with their evidence, what to check at the microscope, Add and Undo."""

from __future__ import annotations

from typing import TYPE_CHECKING

from qtpy.QtCore import Signal  # type: ignore[attr-defined]
from qtpy.QtWidgets import QCheckBox, QHBoxLayout, QPushButton, QTextBrowser, QVBoxLayout, QWidget

from napari_mufasa.report.words import detectable_rows, effect_title, in_text, words_of
from napari_mufasa.widgets.parts.preferences import preference
from napari_mufasa.widgets.parts.tables import add_row, table

if TYPE_CHECKING:
    from napari_mufasa.discover.result import Candidate, Report


class WhatPage(QWidget):
    """``add_clicked`` and ``undo_clicked``; `candidate` is the effect chosen."""

    add_clicked = Signal()
    undo_clicked = Signal()

    def __init__(self) -> None:
        super().__init__()
        self.report: Report | None = None
        self.ranking = table(["Effect", "Evidence", "Error after", "p"])
        self.ranking.setAccessibleName("Effects that could be missing, the best first")
        self.ranking.itemSelectionChanged.connect(self._show_candidate)
        # A text that scrolls by itself: a wrapped label would push the buttons out of sight.
        self.details = QTextBrowser()
        self.details.setMinimumHeight(110)
        self.details.setHtml("Effects that could explain the misfit appear above, the best one first.")
        self.add_button, self.undo_button = QPushButton("Add to the model"), QPushButton("Undo")
        self.add_button.setToolTip("Fit this effect and put it into the model")
        self.undo_button.setToolTip("Take the last effect out again")
        self.add_button.clicked.connect(self.add_clicked)
        self.undo_button.clicked.connect(self.undo_clicked)
        self.simulate_box = QCheckBox("show its movie beside the measured one")
        self.simulate_box.setToolTip("A movie of the completed model, its molecules at the measured places")
        self.simulate_box.setChecked(bool(preference("picture.show_simulated")))
        buttons = QHBoxLayout()
        buttons.addWidget(self.add_button, 1)
        buttons.addWidget(self.undo_button)
        layout = QVBoxLayout(self)
        layout.addWidget(self.ranking, 2)
        layout.addWidget(self.details, 1)
        layout.addLayout(buttons)
        layout.addWidget(self.simulate_box)
        self.add_button.setEnabled(False)
        self.undo_button.setEnabled(False)

    @property
    def candidate(self) -> Candidate | None:
        row = self.ranking.currentRow()
        if self.report is None or not 0 <= row < len(self.report.ranking):
            return None
        return self.report.ranking[row]

    def show_report(self, report: Report) -> None:
        self.report = report
        self.ranking.blockSignals(True)
        self.ranking.setRowCount(0)
        for candidate in report.ranking:
            after = candidate.error_after
            cells = [
                effect_title(candidate.effect),
                f"{candidate.evidence:.0f}",
                "–" if after is None else f"{after:.2f}",
            ]
            add_row(self.ranking, [*cells, f"{candidate.p_value:.1g}"], words_of(candidate), candidate.effect)
        self.ranking.blockSignals(False)
        if report.ranking:
            self.ranking.selectRow(0)
            self._show_candidate()
        else:
            self.details.setHtml("No further effect was tried.")
            self.add_button.setText("Add to the model")

    def _show_candidate(self) -> None:
        candidate = self.candidate
        if candidate is not None:
            self.details.setHtml(words_of(candidate))
            self.add_button.setText(f"Add {in_text(candidate.effect)}")


class DetectablePage(QWidget):
    """What this data would have shown: not seen is not absent."""

    def __init__(self) -> None:
        super().__init__()
        from qtpy.QtWidgets import QLabel

        words = QLabel(
            "The model is adequate. That does not mean that nothing else is there: this is the smallest strength of "
            "each effect that this data would have shown in four cases of five."
        )
        words.setWordWrap(True)
        self.table = table(["Effect", "Would show from"])
        self.table.setAccessibleName("Smallest strength of each effect that this data would have shown")
        layout = QVBoxLayout(self)
        layout.addWidget(words)
        layout.addWidget(self.table, 1)

    def show_report(self, report: Report) -> None:
        self.table.setRowCount(0)
        for kind, title, strength, tip in detectable_rows(report):
            add_row(self.table, [title, strength], tip, kind)
