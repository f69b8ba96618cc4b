"""The Discover step: where the model fails, what is missing, add it, watch the error fall."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Generator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from qtpy.QtWidgets import QFileDialog, QLabel, QPushButton

from napari_mufasa.errors import MufasaError
from napari_mufasa.report.words import headline, in_text
from napari_mufasa.widgets.parts.panel import MovieChooser, Panel, Tabs, seed_row
from napari_mufasa.widgets.parts.place_layers import PlaceLayers
from napari_mufasa.widgets.parts.plot import PlotCanvas
from napari_mufasa.widgets.parts.suspects import Suspects
from napari_mufasa.widgets.parts.what_page import DetectablePage, WhatPage
from napari_mufasa.widgets.parts.where_page import WherePage
from napari_mufasa.widgets.steps.model import ModelSource, section
from napari_mufasa.widgets.turns.jobs import guarded

if TYPE_CHECKING:
    from napari_mufasa.discover.places import Places
    from napari_mufasa.discover.result import Report


class Steering:
    """Progress and cancel of the run under way, for an `Investigation` that outlives single runs.

    ``with steering.run(progress, cancel):`` lets one run at it at a time: one that was cancelled may still be leaving.
    """

    def __init__(self) -> None:
        self._progress: Any = None
        self._cancel: Any = None
        self.lock = threading.Lock()

    def __call__(self, progress: Any, cancel: Any) -> Steering:
        self.wanted = progress, cancel
        return self

    def __enter__(self) -> None:
        self.lock.acquire()
        self._progress, self._cancel = self.wanted

    def __exit__(self, *_: object) -> None:
        self.lock.release()

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
        self._steps: list[tuple[Report, Places | None]] = []
        self._name, self._first_frame = "", 0
        self._examined: Any = lambda: None  # a weak reference to the layer
        self.report: Report | None = None
        self.places: Places | None = None
        self.layers = PlaceLayers(self.viewer)
        self.chooser, self.source = MovieChooser(self.session), ModelSource(self.session)
        self.seed, row = seed_row()
        self.suspects = Suspects(self.session)
        self.verdict = QLabel()
        self.verdict.setWordWrap(True)
        self.verdict.hide()
        self.where, self.what, self.unseen = WherePage(self.viewer), WhatPage(), DetectablePage()
        self.history = PlotCanvas(self.viewer, "The error after each step appears here.", 260)
        self.where.chosen.connect(self._show_place)
        self.where.in_image.toggled.connect(lambda _on: self._show_place(self.where.selected()))
        self.what.ranking.itemSelectionChanged.connect(self._enable)
        self.what.add_clicked.connect(self.add_selected)
        self.what.undo_clicked.connect(self.undo)
        self.tabs = Tabs(430)
        pages = {"Where it fails": self.where, "What is missing": self.what, "Error": self.history}
        for name, page in (pages | {"What would show": self.unseen}).items():
            self.tabs.addTab(page, name)
        self.tabs.setTabVisible(self.tabs.indexOf(self.unseen), False)
        self.export_button = QPushButton("Export report and model …")
        self.export_button.setEnabled(False)
        self.export_button.clicked.connect(self._ask_and_export)
        self.column.addWidget(self.chooser)
        self.column.addWidget(self.source)
        self.column.addLayout(row)
        self.column.addWidget(section("Suspects", self.suspects, False))
        for widget in (self.run_bar, self.verdict):
            self.column.addWidget(widget)
        self.column.addWidget(self.tabs, 1)
        self.column.addWidget(self.export_button)
        self.run_bar.finished.connect(self._enable)

    # runs -------------------------------------------------------------------------------------------
    def prepare(self) -> None:
        measurement = self.session.measurement().recorded()
        model, seed = self.session.matching_model(measurement.movie), self.seed.value()
        steering, effects = Steering(), self.suspects.chosen()
        shape_px, layer = tuple(measurement.movie.shape[1:]), weakref.ref(self.session.movie_layer)

        def work(progress: Any, cancel: Any) -> Any:
            from napari_mufasa.discover import Investigation

            with steering(progress, cancel):
                investigation = Investigation(
                    measurement.movie, model, measurement.dark, seed=seed, effects=effects,
                    progress=steering.progress, cancel=steering.cancel,
                )  # fmt: skip
                investigation.examine()
                investigation.rank()
                report = investigation.report()
                return investigation, report, _places(investigation, report, shape_px, seed, cancel)

        def done(found: Any) -> Generator[None, None, None]:
            self.investigation, report, places = found
            self._steering, self._steps = steering, [(report, places)]
            self._name, self._first_frame, self._examined = measurement.name, measurement.first_frame, layer
            yield from self.layers.clear()
            yield from self._showing(report, places)

        self.start("Looking for what is missing", work, done)

    def add_selected(self) -> None:
        """Fit the selected effect into the model, see what is still missing."""
        candidate, investigation, steering = self.what.candidate, self.investigation, self._steering
        if candidate is None or investigation is None:
            guarded(self.run_bar, self._complain)
            return
        seed, shape_px = self.seed.value(), self._steps[0][0].model.acquisition.shape_px

        def work(progress: Any, cancel: Any) -> Any:
            with steering(progress, cancel):
                n = len(investigation.chosen)
                try:
                    investigation.add(candidate)
                    investigation.rank()
                    report = investigation.report()
                    return report, _places(investigation, report, shape_px, seed, cancel)
                except BaseException:
                    if len(investigation.chosen) > n:  # stopped half-way: as if it had not been pressed
                        investigation.undo()
                    raise

        self.start(f"Adding {in_text(candidate.effect)}", work, self._take)
        self._enable()

    def undo(self) -> None:
        """Back to the report before the last Add."""
        if self.run_bar.running or len(self._steps) < 2:
            return
        if not self._steering.lock.acquire(blocking=False):
            self.run_bar.say("The run that was cancelled is still leaving: try again in a moment.")
            return
        try:
            self.investigation.undo()
        finally:
            self._steering.lock.release()
        self._steps.pop()
        self.show_report(*self._steps[-1])

    def _complain(self) -> None:
        raise MufasaError("nothing was examined yet: press 'Look for what is missing' first")

    # results ----------------------------------------------------------------------------------------
    def _take(self, found: tuple[Report, Places | None]) -> Generator[None, None, None]:
        self._steps.append(found)
        yield from self._showing(*found)

    def show_report(self, report: Report, places: Places | None = None) -> None:
        for _ in self._showing(report, places):
            pass

    def _showing(self, report: Report, places: Places | None = None) -> Generator[None, None, None]:
        """Everything the panel shows follows from the report and the places; one thing at a time."""
        import pandas as pd

        self.report, self.places = report, places
        line, sentence = headline(report)
        self.verdict.setText(f"<b>{line}</b><br>{sentence}")
        self.verdict.setToolTip("\n".join(report.notes))
        self.verdict.show()
        self.where.show_report(report)
        self.what.show_report(report)
        self.unseen.show_report(report)
        self.tabs.setTabVisible(self.tabs.indexOf(self.unseen), bool(report.detectable))
        self.history.draw(lambda figure: _draw_history(figure, report), pd.DataFrame(report.history))
        self._enable()
        yield
        # What was found is what is believed from now on.
        self.session.set_model(report.model, f"fitted to {self._name}")
        self.session.set_result("report", report)
        yield
        self._show_simulated()
        if self.layers.showing:
            yield
            self._show_place(self.where.selected())

    def _enable(self) -> None:
        free = not self.run_bar.running
        self.what.add_button.setEnabled(free and self.what.candidate is not None)
        self.what.undo_button.setEnabled(free and len(self._steps) > 1)
        self.export_button.setEnabled(self.report is not None)

    def _movie(self) -> Any:
        """The layer that was examined, if it is still there."""
        layer = self.session.movie_layer
        return layer if layer is not None and layer is self._examined() else None

    def _show_place(self, observable: str) -> None:
        movie = self._movie()
        if not self.where.in_image.isChecked() or movie is None or self.places is None or not observable:
            self.layers.hide_place()
            self.where.say_place("")
            return
        self.where.say_place(self.layers.show(observable, self.places, movie, self._first_frame))

    def _show_simulated(self) -> None:
        movie = self._movie()
        if self.report is None or not self.report.chosen or self.places is None or movie is None:
            self.layers.hide_simulated()
        elif self.what.simulate_box.isChecked():
            name = f"{self._name}, simulated with {' and '.join(in_text(k) for k in self.report.chosen)}"
            self.layers.show_simulated(self.places, movie, name, self._first_frame)
            self.run_bar.say("Left the measured movie, right the completed model's.")

    # files ------------------------------------------------------------------------------------------
    def _ask_and_export(self) -> None:
        folder = QFileDialog.getExistingDirectory(self, "Folder for report.json and model.json")
        if folder:
            guarded(self.run_bar, lambda: self.export(folder))

    def export(self, folder: str) -> None:
        """Write report.json, model.json and the table of observables."""
        from napari_mufasa.files.whole import write_table

        if self.report is None:
            self._complain()
            return
        target = Path(folder)
        self.report.to_json(str(target / "report.json"))
        self.report.model.to_json(target / "model.json")
        write_table(target / "observables.csv", self.report.observables)
        self.run_bar.say(f"Written: report.json, model.json and observables.csv in {folder}")


def _places(investigation: Any, report: Report, shape_px: Any, seed: int, cancel: Any) -> Places:
    """Where the model as it stands fails: the base model until an effect was added."""
    from napari_mufasa.discover.places import find_places

    model = report.model if report.chosen else report.base
    return find_places(investigation.measurement, model, shape_px, seed=seed, cancel=cancel)


def _draw_history(figure: Any, report: Report) -> None:
    from napari_mufasa.report import plots as plotting

    plotting.staircase(figure.subplots(), report)
