"""Discover: where the model fails, what is missing, add it, watch the error fall."""

import weakref
from collections.abc import Callable, Generator
from dataclasses import replace
from functools import partial
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from magicgui import magic_factory
from napari.layers import Layer
from qtpy.QtWidgets import QWidget

from napari_mufasa.errors import MufasaError
from napari_mufasa.files.layers import measurement_of
from napari_mufasa.report.offscreen import drawing
from napari_mufasa.report.words import detectable_rows, headline, in_text, listed, standing_lines
from napari_mufasa.widgets.parts.doubts import Doubts
from napari_mufasa.widgets.parts.edits import TypedEdit
from napari_mufasa.widgets.parts.effects import Suspects
from napari_mufasa.widgets.parts.findings import CheckPage, WhatPage, WherePage
from napari_mufasa.widgets.parts.forms import begin
from napari_mufasa.widgets.parts.layers import ours
from napari_mufasa.widgets.parts.panel import Panel
from napari_mufasa.widgets.parts.parameters import Believed, Dark, DarkFrames, Movie, Seed
from napari_mufasa.widgets.parts.pieces import RowTable, Tabs, Words, column, section
from napari_mufasa.widgets.parts.place_layers import PlaceLayers, map_of, molecules_of, simulated_of
from napari_mufasa.widgets.parts.plot import PlotCanvas
from napari_mufasa.widgets.turns.session import believed
from napari_mufasa.widgets.turns.steering import Helm, steering

if TYPE_CHECKING:
    from napari_mufasa.discover.places import Places
    from napari_mufasa.discover.result import Report

KINDS: dict[str, Any] = {
    "widget_type": TypedEdit, "of": tuple[str, ...], "label": "Suspects", "empty": "all that suit the camera",
}  # fmt: skip
EXPORTED = ("report.json", "model.json", "observables.csv")
UNSEEN = (
    "What is not named may still be there: this is the smallest strength of each effect not in the model that this "
    "data would have shown in four cases of five."
)


def discover(
    movie: Movie,
    dark: Dark = None,
    dark_frames: DarkFrames = 0,
    model: Believed = None,
    effects: Annotated[tuple[str, ...] | None, KINDS] = None,
    max_effects: Annotated[int, {"label": "Add at most", "min": 0, "max": 10}] = 10,
    seed: Seed = 1,
) -> list[Layer]:
    """Find where the model fails and which physical effects it lacks; add those that the data ask for.

    Parameters:
        effects: Effects to consider, as triplet_blinking, stage_drift: few are examined sooner
        max_effects: Effects that may be added; 0: only look

    Returns:
        The completed model's movie beside the measured one, the misfit left in the mean image, and the molecules with
        theirs in standard deviations. The first one's ``metadata["napari_mufasa"]`` holds the "report" (a `Report`),
        the "places", the completed "model", the "investigation" with its "helm", and the "measurement".
    """
    from napari_mufasa.discover import Investigation
    from napari_mufasa.discover.automatic import play

    helm = Helm()
    measurement, model = measurement_of(movie, dark, dark_frames).recorded(), believed(model, movie)
    with helm:
        investigation = Investigation(
            measurement.movie, model, measurement.dark, seed=seed, effects=effects,
            progress=helm.progress, cancel=helm.cancel,
        )  # fmt: skip
        if max_effects:
            report = play(investigation, max_effects)
        else:
            investigation.examine()
            investigation.rank()
            report = investigation.report()
        places = _places(investigation.measurement, report, measurement, seed)
    found = {"report": report, "places": places, "investigation": investigation, "helm": helm}
    name, more = _name(movie.name, report), found | {"measurement": measurement}
    layers: list[Layer] = [simulated_of(places, movie, name, more), map_of("light", places, movie)]
    if len(places.molecules):
        layers.append(molecules_of("brightness", places, movie))
    return layers


discover_widget = magic_factory(discover, call_button="Discover", widget_init=begin)


class DiscoverPanel(Panel):
    """Looks with `discover`, adding nothing; the user adds effects, takes them out again, and checks what was found."""

    words = "Find where the model fails and which physical effect it lacks. Add it, and watch the error fall."
    run_label, running = "Look for what is missing", "Looking for what is missing"
    form_factory = discover_widget
    hidden = ("dark_frames", "effects", "max_effects")

    def build(self) -> None:
        self._examined: dict[str, Any] = {}  # what `discover` found, and the layer it is of
        self._steps: list[tuple[Report, Places | None]] = []  # what is known at first and after each Add
        self.layers = PlaceLayers(self.viewer)
        self.suspects, self.verdict = Suspects(self.session), Words()
        self.where, self.unseen, self.error = WherePage(self.viewer), QWidget(), QWidget()
        add, take_out, other = (
            partial(self.guarded, action) for action in (self.add_selected, self.take_out_selected, self.check_other)
        )
        self.what, self.check = WhatPage(add, take_out, self.undo), CheckPage(self.viewer, self.check_halves, other)
        self.history = PlotCanvas(self.viewer, "The error after each step appears here.", 260)
        self.standing = Words()
        column(self.error, self.history, self.standing, shares=(1, 0))
        wanted = "Smallest strength of each effect that this data would have shown"
        self.detectable = RowTable(["Effect", "Would show from"], wanted)
        column(self.unseen, Words(UNSEEN), self.detectable, shares=(0, 1))
        self.where.chosen.connect(self._show_place)
        self.where.in_image.toggled.connect(self._show_place)
        self.what.ranking.itemSelectionChanged.connect(self._enable)
        pages = {
            "Where it fails": self.where,
            "What is missing": self.what,
            "Error": self.error,
            "Does it hold?": self.check,
        }
        self.tabs = Tabs(430, pages | {"May hide": self.unseen})
        self.tabs.setTabVisible(self.tabs.indexOf(self.unseen), False)
        caption = "Folder for report.json and model.json"
        self.export_button = self.saver("Export report and model …", caption, self.export, files=lambda: EXPORTED)
        suspects = section("Suspects", self.suspects)
        self.add(self.form.native, Doubts(self.session, self), suspects, self.run_bar, self.verdict, last=self.tabs)
        self.add(self.export_button)
        self.run_bar.finished.connect(self._enable)
        self.session.movie_changed.connect(self._show_verdict)

    @property
    def report(self) -> "Report | None":
        return self._steps[-1][0] if self._steps else None

    # runs -------------------------------------------------------------------------------------------
    def prepare(self) -> None:
        self.session.measurement().recorded()
        layer, suspects = weakref.ref(self.form.movie.value), self.suspects.chosen()

        def done(layers: list[Any]) -> Generator[None, None, None]:
            found = ours(layers[0])
            self._examined, self._steps = found | {"layer": layer, "suspects": suspects}, []
            yield from self.layers.clear()
            yield from self.take((found["report"], found["places"]))

        self.call(self.running, done, effects=suspects, max_effects=0)

    def add_selected(self) -> None:
        """Fit the selected effects into the model together, see what is still missing."""
        candidates = self.what.to_add
        names = " and ".join(in_text(candidate.effect) for candidate in candidates)
        self._step(f"Adding {names}", lambda investigation: investigation.add(*candidates))

    def take_out_selected(self) -> None:
        """Fit the model without the selected effects, see what that costs."""
        kinds = self.what.to_take_out
        names = " and ".join(in_text(kind) for kind in kinds)
        self._step(f"Taking out {names}", lambda investigation: investigation.remove(*kinds))

    def _step(self, title: str, change: Callable[[Any], None]) -> None:
        if not self._examined:
            raise MufasaError("nothing was examined yet: press 'Look for what is missing' first")
        investigation, helm, measurement = (self._examined[name] for name in ("investigation", "helm", "measurement"))
        seed = self.form.seed.value

        def work() -> Any:
            with helm:
                n = len(investigation.stands)
                try:
                    change(investigation)
                    investigation.rank()
                    report = investigation.report()
                    return report, _places(investigation.measurement, report, measurement, seed)
                except BaseException:
                    if len(investigation.stands) > n:  # stopped half-way: as if it had not been pressed
                        investigation.undo()
                    raise

        self.run_bar.start(title, work, self.take)
        self._enable()

    def check_halves(self) -> None:
        """Diagnose the two halves of the field apart."""
        from napari_mufasa.discover import confirm_halves

        movie, model, dark = self._recorded()
        self._check("the two halves of the field, apart", lambda **how: confirm_halves(movie, model, dark, **how))

    def check_other(self) -> None:
        """Diagnose another movie of the same set-up, and try the completed model on it."""
        from napari_mufasa.discover import confirm

        layer, report = self.check.other.value, self.report
        if layer is None or report is None or layer is self._examined["layer"]():
            raise MufasaError("choose another movie of the same set-up: open it, it is a layer then")
        movie = measurement_of(layer).recorded().movie
        _, model, dark = self._recorded()
        self._check(layer.name, lambda **how: confirm(report, movie, model, dark, **how))

    def _recorded(self) -> tuple[Any, Any, Any]:
        measurement = self._examined["measurement"]
        return measurement.movie, self._examined["investigation"].believed, measurement.dark

    def _check(self, against: str, confirmed: Callable[..., Any]) -> None:
        seed, suspects = self.form.seed.value, self._examined["suspects"]

        def work() -> Any:
            progress, cancel = steering()
            return confirmed(seed=seed, effects=suspects, progress=progress, cancel=cancel)

        def done(held: Any) -> None:
            report, places = self._steps[-1]
            report = replace(report, check=held.to_dict(against))
            self._steps[-1] = report, places
            self.check.show_report(report)

        self.run_bar.start(f"Checking on {against}", work, done)
        self._enable()

    def undo(self) -> None:
        """Back to the report before the last Add."""
        if self.run_bar.running or len(self._steps) < 2:
            return
        if self._examined["helm"].lock.locked():
            self.run_bar.say("The run that was cancelled is still leaving: try again in a moment.")
            return
        self._examined["investigation"].undo()
        self._steps.pop()
        self.show_report(*self._steps.pop())

    # results ----------------------------------------------------------------------------------------
    def show_report(self, report: "Report", places: "Places | None" = None) -> None:
        for _ in self.take((report, places)):
            pass

    def take(self, found: "tuple[Report, Places | None]") -> Generator[None, None, None]:
        """Everything the panel shows follows from the report and the places; one thing at a time."""
        import pandas as pd

        self._steps.append(found)
        report, _ = found
        self._show_verdict()
        self.verdict.setToolTip("\n".join(report.notes))
        self.standing.say("<br>".join(escape(line) for line in standing_lines(report)))
        self.where.show_report(report)
        self.what.show_report(report)
        self.check.show_report(report)
        self.detectable.fill(detectable_rows(report))
        self.tabs.setTabVisible(self.tabs.indexOf(self.unseen), bool(report.detectable))
        self.history.draw(drawing("staircase", report), pd.DataFrame(report.history))
        self._enable()
        yield
        # What was found is what is believed from now on.
        name = self._examined["measurement"].name if self._examined else "a measurement"
        self.session.set_model(report.model, f"fitted to {name}")
        yield
        self._show_simulated()
        if self.layers.showing:
            yield
            self._show_place()

    def _show_verdict(self) -> None:
        """The verdict; and of which movie it is, where that is not the one chosen."""
        if self.report is None:
            return
        line, sentence = headline(self.report)
        found = self._examined
        of = self.whose(found["layer"](), found["measurement"].name) if found else ""
        self.verdict.say(f"{of}<b>{line}</b><br>{sentence}")

    def _enable(self) -> None:
        free = not self.run_bar.running
        self.what.add_button.setEnabled(free and bool(self.what.to_add))
        self.what.take_out_button.setEnabled(free and bool(self.what.to_take_out))
        for check in (self.check.halves_button, self.check.other_button):
            check.setEnabled(free and bool(self._examined))
        self.what.undo_button.setEnabled(free and len(self._steps) > 1)
        self.export_button.setEnabled(bool(self._steps))

    def _placed(self) -> "tuple[Places, Any] | None":
        """The places, and the layer that was examined, if it is still there and chosen."""
        layer, places = self.session.movie_layer, self._steps[-1][1] if self._steps else None
        if not self._examined or places is None or layer is None or layer is not self._examined["layer"]():
            return None
        return places, layer

    def _show_place(self, *_: Any) -> None:
        """The place in the image of the observable that is chosen."""
        placed, observable = self._placed(), self.where.failing.key
        if placed is None or not observable or not self.where.in_image.isChecked():
            self.layers.hide_place()
            self.where.place.say("")
        else:
            self.where.place.say(self.layers.show_place(observable, *placed))

    def _show_simulated(self) -> None:
        placed, report = self._placed(), self.report
        if placed is None or report is None or not report.chosen:
            self.layers.remove("simulated")
        elif self.what.simulate_box.isChecked():
            self.layers.show_simulated(*placed, name=_name(placed[1].name, report))
            self.run_bar.say("Left the measured movie, right the completed model's.")

    # files ------------------------------------------------------------------------------------------
    def export(self, folder: str) -> str:
        """Write report.json, model.json and the table of observables."""
        from napari_mufasa.files.whole import write_table

        assert self.report is not None
        report, model, table = (Path(folder) / name for name in EXPORTED)
        self.report.to_json(str(report))
        self.report.model.to_json(model)
        write_table(table, self.report.observables)
        return f"{listed(EXPORTED)} in {folder}"


def _places(looked_at: Any, report: "Report", measurement: Any, seed: int) -> "Places":
    """Where the model as it stands fails: the base model until an effect was added. Of the layer's frames `measurement`
    holds those that were recorded with light, by the Data step; of them a diagnosis may look at fewer yet."""
    from napari_mufasa.discover.places import find_places

    model = report.model if report.chosen else report.base
    shape_px, first = measurement.movie.shape[1:], measurement.first_frame
    return find_places(looked_at, model, tuple(shape_px), first, seed=seed, cancel=steering()[1])


def _name(movie: str, report: "Report") -> str:
    added = " and ".join(in_text(kind) for kind in report.chosen)
    return f"{movie}, simulated" + (f" with {added}" if added else "")
