"""The Discover step: where the model fails, what is missing, add it, watch the error fall."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from qtpy.QtCore import Qt
from qtpy.QtWidgets import (
    QCheckBox,
    QFileDialog,
    QHBoxLayout,
    QLabel,
    QPushButton,
    QTextBrowser,
    QVBoxLayout,
    QWidget,
)

from napari_mufasa.errors import MufasaError
from napari_mufasa.widgets.jobs import Quiet, guarded
from napari_mufasa.widgets.model_panel import ModelSource
from napari_mufasa.widgets.panel import MovieChooser, Panel, Tabs, seed_row
from napari_mufasa.widgets.plot import PlotCanvas
from napari_mufasa.widgets.tables import add_row, table
from napari_mufasa.widgets.telling import headline, matching_curve, title_of, told, words_of

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
        self._reports: list[Report] = []
        self._name = ""
        #: Passed on to `Investigation`, for example ``{"effects": ["stage_drift", "laser_drift"]}``.
        self.investigation_options: dict[str, Any] = {}
        self.report: Report | None = None
        self._quiet = Quiet(self)
        self.chooser, self.source = MovieChooser(self.session), ModelSource(self.session)
        self.seed, row = seed_row()
        self.verdict = QLabel()
        self.verdict.setWordWrap(True)
        self.verdict.hide()
        self.tabs = Tabs(430)
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
        # A text that scrolls by itself: a wrapped label would push the buttons out of sight.
        self.details = QTextBrowser()
        self.details.setMinimumHeight(110)
        self.details.setHtml("Effects that could explain the misfit appear above, the best one first.")
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
        measurement = self.session.measurement().recorded()
        model, seed = self.session.matching_model(measurement.movie), self.seed.value()
        steering, options = Steering(), dict(self.investigation_options)

        def work(progress: Any, cancel: Any) -> Any:
            from napari_mufasa.discover import Investigation

            steering.take(progress, cancel)
            investigation = Investigation(
                measurement.movie, model, measurement.dark, seed=seed, progress=steering.progress,
                cancel=steering.cancel, **options,
            )  # fmt: skip
            investigation.examine()
            investigation.rank()
            return investigation, investigation.report()

        def done(found: Any) -> None:
            self.investigation, report = found
            self._steering, self._reports, self._name = steering, [report], measurement.name
            self.show_report(report)

        self.start("Looking for what is missing", work, done)

    def add_selected(self) -> None:
        """Fit the selected effect into the model, see what is still missing."""
        candidate, investigation, steering = self._selected_candidate(), self.investigation, self._steering
        if candidate is None or investigation is None:
            guarded(self.run_bar, self._complain)
            return
        with_movie, seed = self.simulate_box.isChecked(), self.seed.value()

        def work(progress: Any, cancel: Any) -> Any:
            steering.take(progress, cancel)
            n = len(investigation.chosen)
            try:
                investigation.add(candidate)
                investigation.rank()
                report = investigation.report()
                simulated = None
                if with_movie:
                    from napari_mufasa.simulation import simulate

                    simulated = simulate(report.model, seed=seed, cancel=cancel)
            except BaseException:
                if len(investigation.chosen) > n:  # stopped half-way: as if it had not been pressed
                    investigation.undo()
                raise
            return report, simulated

        self.start(f"Adding {title_of(candidate.effect).lower()}", work, self._take)
        self._enable()

    def undo(self) -> None:
        """Back to the report before the last Add."""
        if self.run_bar.running or len(self._reports) < 2:
            return
        self.investigation.undo()
        self._reports.pop()
        self.show_report(self._reports[-1])

    def _complain(self) -> None:
        raise MufasaError("nothing was examined yet: press 'Look for what is missing' first")

    # results ----------------------------------------------------------------------------------------
    def _take(self, found: Any) -> None:
        report, simulated = found
        self._reports.append(report)
        self.show_report(report)
        if simulated is not None:
            from napari_mufasa.napari_io import movie_space
            from napari_mufasa.widgets.layers import add_movie

            layer = self.session.movie_layer
            limits = {"contrast_limits": layer.contrast_limits} if layer is not None else {}
            name, space = f"{self._name}, simulated by the model now", movie_space(simulated.model)
            add_movie(self.viewer, simulated.movie, name, space, simulated.model, **limits)

    def show_report(self, report: Report) -> None:
        """Everything the panel shows follows from the report."""
        self.report = report
        line, sentence = headline(report)
        self.verdict.setText(f"<b>{line}</b><br>{sentence}")
        self.verdict.setToolTip("\n".join(report.notes))
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
        else:
            self.details.setHtml("No further effect was tried.")
        self._show_history(report)
        self._enable()
        # What was found is what is believed from now on.
        self.session.set_model(report.model, f"fitted to {self._name}")
        self.session.set_result("report", report)

    def _enable(self) -> None:
        free = not self.run_bar.running
        self.add_button.setEnabled(free and self._selected_candidate() is not None)
        self.undo_button.setEnabled(free and len(self._reports) > 1)
        self.export_button.setEnabled(self.report is not None)

    def _fill_failing(self, report: Report) -> None:
        self.failing.setRowCount(0)
        self.failing.setColumnHidden(2, not report.chosen)
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
        row = self.report.observables.query("observable == @name")
        title = told(row.iloc[0], bool(self.report.chosen)) if len(row) else ""
        if curve is None:  # a single number: show it among the others
            observables = self.report.observables

            def draw_all(figure: Any) -> Any:
                from napari_mufasa import plotting

                plotting.z_scores(figure.subplots(), observables)
                return observables

            self.curve.draw(draw_all, title)
            return

        def draw(figure: Any) -> Any:
            import pandas as pd

            from napari_mufasa import plotting

            plotting.curve(figure.subplots(), curve)
            columns = ("x", "measured", "before", "before_sd", "after", "after_sd")
            return pd.DataFrame({column: getattr(curve, column) for column in columns})

        self.curve.draw(draw, title)

    def _selected_candidate(self) -> Candidate | None:
        row = self.ranking.currentRow()
        if self.report is None or not 0 <= row < len(self.report.ranking):
            return None
        return self.report.ranking[row]

    def _show_candidate(self) -> None:
        candidate = self._selected_candidate()
        if self._quiet or candidate is None:
            return
        self.details.setHtml(words_of(candidate))
        self.add_button.setText(f"Add {title_of(candidate.effect).lower()}")
        self._enable()

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
