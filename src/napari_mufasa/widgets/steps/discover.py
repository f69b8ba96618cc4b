"""Discover: where the model fails, what is missing, add it, watch the error fall."""

from __future__ import annotations

import weakref
from collections.abc import Generator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from napari.layers import Layer

from napari_mufasa.errors import MufasaError
from napari_mufasa.report.offscreen import drawing
from napari_mufasa.report.words import headline, in_text
from napari_mufasa.widgets.parts.edits import ListEdit
from napari_mufasa.widgets.parts.forms import step_form
from napari_mufasa.widgets.parts.layers import ours
from napari_mufasa.widgets.parts.panel import Panel, Tabs, button, section, wrapped
from napari_mufasa.widgets.parts.parameters import SEED, Believed, Dark, DarkFrames, Movie, Seed
from napari_mufasa.widgets.parts.place_layers import PlaceLayers, map_of, molecules_of, simulated_of
from napari_mufasa.widgets.parts.plot import PlotCanvas
from napari_mufasa.widgets.parts.suspects import Suspects
from napari_mufasa.widgets.parts.what_page import DetectablePage, WhatPage
from napari_mufasa.widgets.parts.where_page import WherePage
from napari_mufasa.widgets.turns.jobs import guarded
from napari_mufasa.widgets.turns.session import believed, measurement_of
from napari_mufasa.widgets.turns.steering import Helm, steered, steering

if TYPE_CHECKING:
    from magicgui.widgets import FunctionGui
    from napari.viewer import Viewer

    from napari_mufasa.discover.places import Places
    from napari_mufasa.discover.result import Report


def discover(
    movie: Movie,
    dark: Dark = None,
    dark_frames: DarkFrames = 0,
    model: Believed = None,
    effects: Annotated[
        tuple[str, ...] | None,
        {
            "widget_type": ListEdit, "of": "words", "label": "Suspects", "empty": "all that suit the camera",
            "tooltip": "Effects to consider, as triplet_blinking, stage_drift: few are examined sooner",
        },
    ] = None,
    max_effects: Annotated[
        int,
        {"label": "Add at most", "min": 0, "max": 10, "tooltip": "Effects that may be added; 0: only look"},
    ] = 3,
    seed: Seed = 1,
) -> list[Layer]:  # fmt: skip
    """Find where the model fails and which physical effects it lacks; add those that the data ask for.

    Returns the completed model's movie beside the measured one, the misfit left in the mean image, and the molecules
    with theirs in standard deviations. The first one's ``metadata["napari_mufasa"]`` holds the "report" (a `Report`),
    the "places" and the completed "model"; where nothing may be added also the "investigation" and its "helm".
    """
    progress, cancel = steering()
    measurement = measurement_of(movie, dark, dark_frames).recorded()
    model, recorded = believed(model, movie), measurement.movie
    if max_effects:
        from napari_mufasa.discover import diagnose
        from napari_mufasa.discover.measurement import prepare

        report = diagnose(
            recorded, model, measurement.dark, seed=seed, effects=effects, max_effects=max_effects,
            progress=progress, cancel=cancel,
        )  # fmt: skip
        found: dict[str, Any] = {"report": report}
        places = _places(prepare(recorded, model, measurement.dark), report, recorded.shape[1:], seed)
    else:
        helm = Helm()
        with helm:
            investigation = _examined(recorded, model, measurement.dark, seed, effects, helm)
            report = investigation.report()
            places = _places(investigation.measurement, report, recorded.shape[1:], seed)
        found = {"report": report, "investigation": investigation, "helm": helm}
    name = f"{movie.name}, simulated" + (f" with {_listed(report.chosen)}" if report.chosen else "")
    first = measurement.first_frame
    layers: list[Layer] = [simulated_of(places, movie, name, first, found | {"places": places})]
    layers.append(map_of("light", places, movie, first))
    if len(places.molecules):
        layers.append(molecules_of("brightness", places, movie))
    return layers


def discover_widget(viewer: Viewer | None = None, call_button: Any = "Discover") -> FunctionGui[..., Any]:
    return step_form(discover, viewer, call_button, SEED)


class DiscoverPanel(Panel):
    """Looks with `discover`, adding nothing; the user adds, one effect at a time, and takes out again."""

    words = "Find where the model fails and which physical effect it lacks. Add it, and watch the error fall."
    run_label, running = "Look for what is missing", "Looking for what is missing"
    form_factory = discover_widget
    hidden = ("dark_frames", "effects", "max_effects")

    def build(self) -> None:
        self.investigation: Any = None
        self._helm = Helm()
        self._steps: list[tuple[Report, Places | None]] = []
        self._name, self._first_frame = "", 0
        self._examined: Any = lambda: None  # a weak reference to the layer
        self.report: Report | None = None
        self.places: Places | None = None
        self.layers = PlaceLayers(self.viewer)
        self.suspects = Suspects(self.session)
        self.verdict = wrapped()
        self.verdict.hide()
        self.where, self.what, self.unseen = WherePage(self.viewer), WhatPage(), DetectablePage()
        self.history = PlotCanvas(self.viewer, "The error after each step appears here.", 260)
        self.where.chosen.connect(self._show_place)
        self.where.in_image.toggled.connect(lambda _on: self._show_place(self.where.selected()))
        self.what.ranking.itemSelectionChanged.connect(self._enable)
        self.what.add_clicked.connect(self.add_selected)
        self.what.undo_clicked.connect(self.undo)
        pages = {"Where it fails": self.where, "What is missing": self.what, "Error": self.history}
        self.tabs = Tabs(430, pages | {"What would show": self.unseen})
        self.tabs.setTabVisible(self.tabs.indexOf(self.unseen), False)
        self.export_button = button(
            "Export report and model …", lambda: self.ask_where("Folder for report.json and model.json", self.export),
            enabled=False,
        )  # fmt: skip
        self.add(self.form.native, section("Suspects", self.suspects), self.run_bar, self.verdict)
        self.column.addWidget(self.tabs, 1)
        self.add(self.export_button)
        self.run_bar.finished.connect(self._enable)

    # runs -------------------------------------------------------------------------------------------
    def prepare(self) -> None:
        measurement, movie = self.measurement().recorded(), self.form.movie.value

        def done(layers: list[Any]) -> Generator[None, None, None]:
            found = ours(layers[0])
            self.investigation, self._helm = found["investigation"], found["helm"]
            self._steps = [(found["report"], found["places"])]
            self._name, self._first_frame, self._examined = (
                measurement.name,
                measurement.first_frame,
                weakref.ref(movie),
            )
            yield from self.layers.clear()
            yield from self._showing(*self._steps[0])

        self.call(self.running, done, effects=self.suspects.chosen(), max_effects=0)

    def add_selected(self) -> None:
        """Fit the selected effect into the model, see what is still missing."""
        candidate, investigation, helm = self.what.candidate, self.investigation, self._helm
        if candidate is None or investigation is None:
            guarded(self.run_bar, self._complain)
            return
        seed, shape_px = self.form.seed.value, self._steps[0][0].model.acquisition.shape_px

        def work(progress: Any, cancel: Any) -> Any:
            with steered(progress, cancel), helm:
                n = len(investigation.chosen)
                try:
                    investigation.add(candidate)
                    investigation.rank()
                    report = investigation.report()
                    return report, _places(investigation.measurement, report, shape_px, seed)
                except BaseException:
                    if len(investigation.chosen) > n:  # stopped half-way: as if it had not been pressed
                        investigation.undo()
                    raise

        self.start(f"Adding {in_text(candidate.effect)}", work, self.take)
        self._enable()

    def undo(self) -> None:
        """Back to the report before the last Add."""
        if self.run_bar.running or len(self._steps) < 2:
            return
        if not self._helm.lock.acquire(blocking=False):
            self.run_bar.say("The run that was cancelled is still leaving: try again in a moment.")
            return
        try:
            self.investigation.undo()
        finally:
            self._helm.lock.release()
        self._steps.pop()
        self.show_report(*self._steps[-1])

    def _complain(self) -> None:
        raise MufasaError("nothing was examined yet: press 'Look for what is missing' first")

    # results ----------------------------------------------------------------------------------------
    def take(self, found: tuple[Report, Places | None]) -> Generator[None, None, None]:
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
        for page in (self.where, self.what, self.unseen):
            page.show_report(report)
        self.tabs.setTabVisible(self.tabs.indexOf(self.unseen), bool(report.detectable))
        self.history.draw(drawing("staircase", report), pd.DataFrame(report.history))
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
            name = f"{self._name}, simulated with {_listed(self.report.chosen)}"
            self.layers.show_simulated(self.places, movie, name, self._first_frame)
            self.run_bar.say("Left the measured movie, right the completed model's.")

    # files ------------------------------------------------------------------------------------------
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


def _examined(movie: Any, model: Any, dark: Any, seed: int, effects: Any, helm: Helm) -> Any:
    """An `Investigation` with its ranking, nothing added."""
    from napari_mufasa.discover import Investigation

    investigation = Investigation(
        movie, model, dark, seed=seed, effects=effects, progress=helm.progress, cancel=helm.cancel
    )
    investigation.examine()
    investigation.rank()
    return investigation


def _places(measurement: Any, report: Report, shape_px: Any, seed: int) -> Places:
    """Where the model as it stands fails: the base model until an effect was added."""
    from napari_mufasa.discover.places import find_places

    model = report.model if report.chosen else report.base
    return find_places(measurement, model, tuple(shape_px), seed=seed, cancel=steering()[1])


def _listed(effects: Any) -> str:
    return " and ".join(in_text(kind) for kind in effects)
