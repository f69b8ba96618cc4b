"""The Discover step: where the model fails, what is missing, add it, watch the error fall."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from qtpy.QtCore import Qt
from qtpy.QtWidgets import (
    QCheckBox,
    QFileDialog,
    QHBoxLayout,
    QHeaderView,
    QLabel,
    QPushButton,
    QTableWidget,
    QTableWidgetItem,
    QTabWidget,
    QVBoxLayout,
    QWidget,
)

from napari_mufasa.errors import Cancelled, MufasaError
from napari_mufasa.widgets.jobs import Quiet, guarded
from napari_mufasa.widgets.model_panel import ModelSource
from napari_mufasa.widgets.panel import MovieChooser, Panel, seed_row
from napari_mufasa.widgets.plot import PlotCanvas

if TYPE_CHECKING:
    from napari_mufasa.discover.result import Candidate, Report


class Steering:
    """The progress and cancel of the run under way, for an `Investigation` that outlives single runs."""

    def __init__(self) -> None:
        self._progress: Any = None
        self._cancel: Any = None

    def take(self, progress: Any, cancel: Any) -> None:
        self._progress, self._cancel = progress, cancel

    def progress(self, done: int, total: int) -> None:
        if self._progress is not None:
            self._progress(done, total)

    def cancel(self) -> bool:
        return bool(self._cancel is not None and self._cancel())


class DiscoverPanel(Panel):
    """Over `napari_mufasa.discover.Investigation`."""

    title = "Discover"
    words = "Find where the model fails and which physical effect it lacks. Add it, and watch the error fall."
    run_label = "Look for what is missing"

    def build(self) -> None:
        self.investigation: Any = None
        self._steering = Steering()
        self.report: Report | None = None
        self._quiet = Quiet(self)
        self.chooser, self.source = MovieChooser(self.session), ModelSource(self.session)
        self.seed, row = seed_row()
        self.verdict = QLabel()
        self.verdict.setWordWrap(True)
        self.verdict.hide()
        self.tabs = QTabWidget()
        self.tabs.addTab(self._where(), "Where it fails")
        self.tabs.addTab(self._what(), "What is missing")
        self.history = PlotCanvas(self.viewer, "The error after each step appears here.", 260)
        self.tabs.addTab(self.history, "Error")
        self.export_button = QPushButton("Export report and model …")
        self.export_button.setEnabled(False)
        self.export_button.clicked.connect(self._ask_and_export)
        for item in (self.chooser, self.source, row, self.run_bar, self.verdict):
            if isinstance(item, QWidget):
                self.column.addWidget(item)
            else:
                self.column.addLayout(item)
        self.column.addWidget(self.tabs, 1)
        self.column.addWidget(self.export_button)

    def _where(self) -> QWidget:
        page = QWidget()
        layout = QVBoxLayout(page)
        self.failing = table(["What is measured", "z before", "z now"])
        self.failing.itemSelectionChanged.connect(self._show_curve)
        self.curve = PlotCanvas(self.viewer, "Click an observable to see it measured and as the model has it.", 240)
        layout.addWidget(self.failing, 1)
        layout.addWidget(self.curve, 2)
        return page

    def _what(self) -> QWidget:
        page = QWidget()
        layout = QVBoxLayout(page)
        self.ranking = table(["Effect", "Evidence", "Error after", "p"])
        self.ranking.itemSelectionChanged.connect(self._show_candidate)
        self.details = QLabel("Effects that could explain the misfit appear above, the best one first.")
        self.details.setWordWrap(True)
        self.details.setAlignment(Qt.AlignmentFlag.AlignTop)
        self.details.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
        self.add_button, self.undo_button = QPushButton("Add to the model"), QPushButton("Undo")
        self.add_button.setToolTip("Fit this effect and put it into the model")
        self.undo_button.setToolTip("Take the last effect out again")
        self.add_button.clicked.connect(self.add_selected)
        self.undo_button.clicked.connect(self.undo)
        self.simulate_box = QCheckBox("show the new model's movie beside the measured one")
        buttons = QHBoxLayout()
        buttons.addWidget(self.add_button, 1)
        buttons.addWidget(self.undo_button)
        for widget in (self.ranking, self.details):
            layout.addWidget(widget, 2 if widget is self.ranking else 1)
        layout.addLayout(buttons)
        layout.addWidget(self.simulate_box)
        self.add_button.setEnabled(False)
        self.undo_button.setEnabled(False)
        return page

    # runs -------------------------------------------------------------------------------------------
    def prepare(self) -> None:
        measurement = self.session.measurement()
        model, seed = self.session.matching_model(measurement.movie), self.seed.value()
        steering = self._steering = Steering()

        def work(progress: Any, cancel: Any) -> Any:
            import numpy as np

            from napari_mufasa.discover import Investigation

            steering.take(progress, cancel)
            dark = np.asarray(measurement.dark) if measurement.dark is not None else None
            investigation = Investigation(
                measurement.movie, model, dark, seed=seed, progress=steering.progress, cancel=steering.cancel
            )
            investigation.examine()
            investigation.rank()
            return investigation, investigation.report()

        self.start("Looking for what is missing", work, self._take)

    def add_selected(self) -> None:
        candidate = self._selected_candidate()
        if candidate is not None:
            self._change(f"Adding {title_of(candidate.effect)}", lambda investigation: investigation.add(candidate))

    def undo(self) -> None:
        self._change("Undoing", lambda investigation: investigation.undo())

    def _change(self, title: str, step: Any) -> None:
        investigation, steering, seed = self.investigation, self._steering, self.seed.value()
        if investigation is None:
            guarded(self.run_bar, self._complain)
            return
        with_movie = self.simulate_box.isChecked()
        self._enable(False)

        def work(progress: Any, cancel: Any) -> Any:
            steering.take(progress, cancel)
            step(investigation)
            if cancel():
                raise Cancelled
            investigation.rank()
            report = investigation.report()
            simulated = None
            if with_movie:
                from napari_mufasa.simulation import simulate

                simulated = simulate(report.model, seed=seed, cancel=cancel)
            return investigation, report, simulated

        self.start(title, work, self._take)

    def _complain(self) -> None:
        raise MufasaError("nothing was examined yet: press 'Look for what is missing' first")

    # results ----------------------------------------------------------------------------------------
    def _take(self, found: Any) -> None:
        self.investigation, report, *simulated = found
        self.show_report(report)
        if simulated and simulated[0] is not None:
            from napari_mufasa.widgets.layers import add_movie, movie_scale

            result = simulated[0]
            layer = self.session.movie_layer
            limits = {"contrast_limits": layer.contrast_limits} if layer is not None else {}
            space = movie_scale(result.model)
            add_movie(self.viewer, result.movie, "simulated by the model now", space, result.model, **limits)

    def show_report(self, report: Report) -> None:
        """Everything the panel shows follows from the report."""
        self.report = report
        from napari_mufasa.wording import verdict_text

        line, sentence = verdict_text(report)
        notes = "\n".join(report.notes)
        self.verdict.setText(f"<b>{line}</b><br>{sentence}")
        self.verdict.setToolTip(notes)
        self.verdict.show()
        with self._quiet:
            self._fill_failing(report)
            self._fill_ranking(report)
        if self.failing.rowCount():
            self.failing.selectRow(0)
        else:
            self.curve.clear("The model describes every observable within its noise.")
        if self.ranking.rowCount():
            self.ranking.selectRow(0)
        self._show_history(report)
        self._enable(True)
        # What was found is what is believed from now on.
        self.session.set_model(report.model, f"found in {self.chooser.movie.currentText()}")
        self.session.set_result("report", report)

    def _enable(self, free: bool) -> None:
        self.add_button.setEnabled(free and self._selected_candidate() is not None)
        self.undo_button.setEnabled(free and self.report is not None and bool(self.report.chosen))
        self.export_button.setEnabled(self.report is not None)

    def _fill_failing(self, report: Report) -> None:
        self.failing.setRowCount(0)
        for item in report.failing:
            where = f"\n{item['where']}" if item.get("where") else ""
            tip = f"{item.get('title', item['observable'])}{where}"
            now = item.get("z_after")
            add_row(
                self.failing,
                [str(item.get("title", item["observable"])), f"{item['z']:+.1f}", "" if now is None else f"{now:+.1f}"],
                tip, str(item["observable"]),
            )  # fmt: skip

    def _fill_ranking(self, report: Report) -> None:
        self.ranking.setRowCount(0)
        for candidate in report.ranking:
            after = candidate.error_after
            cells = [title_of(candidate.effect), f"{candidate.evidence:.0f}", "–" if after is None else f"{after:.2f}"]
            add_row(self.ranking, [*cells, f"{candidate.p_value:.1g}"], words_of(candidate), candidate.effect)

    def _show_curve(self) -> None:
        if self._quiet or self.report is None or not self.failing.selectedItems():
            return
        chosen: Any = self.failing.selectedItems()[0]
        name = str(chosen.data(Qt.ItemDataRole.UserRole))
        curve = matching_curve(name, self.report.curves)
        if curve is None:
            self.curve.clear(f"{name} is a single number, not a curve.")
            return

        def draw(figure: Any) -> Any:
            import pandas as pd

            from napari_mufasa import plotting

            plotting.curve(figure.subplots(), curve)
            columns = ("x", "measured", "before", "before_sd", "after", "after_sd")
            return pd.DataFrame({column: getattr(curve, column) for column in columns})

        self.curve.draw(draw)

    def _selected_candidate(self) -> Candidate | None:
        row = self.ranking.currentRow()
        if self.report is None or not 0 <= row < len(self.report.ranking):
            return None
        return self.report.ranking[row]

    def _show_candidate(self) -> None:
        candidate = self._selected_candidate()
        if self._quiet or candidate is None:
            return
        self.details.setText(words_of(candidate))
        self.add_button.setText(f"Add {title_of(candidate.effect).lower()}")
        self._enable(not self.run_bar.running)

    def _show_history(self, report: Report) -> None:
        def draw(figure: Any) -> Any:
            import pandas as pd

            from napari_mufasa import plotting

            plotting.staircase(figure.subplots(), report)
            return pd.DataFrame(report.history)

        self.history.draw(draw)

    def _ask_and_export(self) -> None:
        folder = QFileDialog.getExistingDirectory(self, "Folder for report.json and model.json")
        if folder:
            guarded(self.run_bar, lambda: self.export(folder))

    def export(self, folder: str) -> None:
        """Write report.json, model.json and the table of observables."""
        from napari_mufasa.io import write_table

        if self.report is None:
            self._complain()
            return
        target = Path(folder)
        self.report.to_json(str(target / "report.json"))
        self.report.model.to_json(target / "model.json")
        write_table(target / "observables.csv", self.report.observables)
        self.run_bar.say(f"Written: report.json, model.json and observables.csv in {folder}")


def table(headers: list[str]) -> QTableWidget:
    """A table of rows to choose one from; the first column takes the room."""
    made: Any = QTableWidget(0, len(headers))
    made.setHorizontalHeaderLabels(headers)
    made.verticalHeader().setVisible(False)
    made.setSelectionBehavior(QTableWidget.SelectionBehavior.SelectRows)
    made.setSelectionMode(QTableWidget.SelectionMode.SingleSelection)
    made.setEditTriggers(QTableWidget.EditTrigger.NoEditTriggers)
    made.setTextElideMode(Qt.TextElideMode.ElideRight)
    made.setMinimumHeight(120)
    header = made.horizontalHeader()
    header.setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
    header.setSectionResizeMode(0, QHeaderView.ResizeMode.Stretch)
    return made  # type: ignore[no-any-return]


def add_row(made: QTableWidget, cells: list[str], tip: str, key: str) -> None:
    row = made.rowCount()
    made.insertRow(row)
    for column, text in enumerate(cells):
        item = QTableWidgetItem(text)
        item.setToolTip(tip)
        item.setData(Qt.ItemDataRole.UserRole, key)
        if column:
            item.setTextAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
        made.setItem(row, column, item)


def title_of(kind: str) -> str:
    from napari_mufasa.wording import effect_title

    return effect_title(kind)


def words_of(candidate: Candidate) -> str:
    """What the effect is, its fitted numbers, what to check at the microscope."""
    from napari_mufasa.effects import catalogue
    from napari_mufasa.wording import parameter_lines

    effect = catalogue().get(candidate.effect)
    lines = [f"{effect.what_it_is} {effect.what_it_does}"] if effect is not None else []
    fitted = parameter_lines(candidate)
    if fitted:
        lines.append(f"<b>Fitted:</b> {', '.join(fitted)}")
    if candidate.indistinguishable_from:
        others = ", ".join(title_of(kind).lower() for kind in candidate.indistinguishable_from)
        separate = f" To separate: {effect.separated_by}." if effect is not None and effect.separated_by else ""
        lines.append(f"<b>Cannot be told apart from:</b> {others}.{separate}")
    if effect is not None and effect.how_to_check:
        lines.append(f"<b>Check:</b> {effect.how_to_check}")
    return "<br>".join(lines)


def matching_curve(observable: str, curves: Any) -> Any:
    """The curve an observable belongs to: the one whose name it starts with (the longest such)."""
    fitting = [curve for curve in curves if observable.startswith(curve.name)]
    return max(fitting, key=lambda curve: len(curve.name), default=None)
