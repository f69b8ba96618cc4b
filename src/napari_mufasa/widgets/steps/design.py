"""Design: what a model predicts before any movie is taken."""

from functools import partial
from typing import Annotated, Any

import pandas as pd
from magicgui import magic_factory, magicgui
from magicgui.widgets import ComboBox
from qtpy.QtWidgets import QWidget

from napari_mufasa.design import design as predicted
from napari_mufasa.design import numbers
from napari_mufasa.design.solve import POWER, QUANTITIES, solve
from napari_mufasa.errors import MufasaError
from napari_mufasa.report.fields import number_text, told
from napari_mufasa.report.lines import solution_lines
from napari_mufasa.report.plots import power_curve, predictions
from napari_mufasa.widgets.parts.edits import TypedEdit
from napari_mufasa.widgets.parts.forms import DerivedValues, begin, dress, dress_one, shared
from napari_mufasa.widgets.parts.panel import Panel
from napari_mufasa.widgets.parts.parameters import NUMBER, AnyMovie, Believed
from napari_mufasa.widgets.parts.pieces import RowTable, Tabs, Words, button, column, into_view, row, section
from napari_mufasa.widgets.parts.plot import PlotCanvas
from napari_mufasa.widgets.steps.power import power, power_widget
from napari_mufasa.widgets.turns.session import believed

NUMBERS = [(told(path.split(".")[1]), path) for path in numbers()]
TARGETS = [(told(name), name) for name in QUANTITIES]
NOTHING = [("nothing else", "")]
TARGET: dict[str, Any] = {"widget_type": "ComboBox", "label": "Wanted"}
VALUES: dict[str, Any] = {"widget_type": TypedEdit, "of": tuple[float, ...]}
VALUE = NUMBER | {"label": "is"}


def design(
    movie: AnyMovie = None,
    model: Believed = None,
    vary: Annotated[str, {"widget_type": "ComboBox", "label": "Vary", "choices": NUMBERS}] = POWER,
    values: Annotated[tuple[float, ...], VALUES | {"label": "Values"}] = (1.0, 10.0, 100.0),
    vary_also: Annotated[str, {"widget_type": "ComboBox", "label": "Vary also", "choices": NOTHING + NUMBERS}] = "",
    also_values: Annotated[tuple[float, ...], VALUES | {"label": "Its values"}] = (),
) -> pd.DataFrame:
    """Predict signal, noise, precision and life time for some values of one parameter of a model, or of two.

    Without a model: the one in the movie's metadata.

    Parameters:
        vary: What to try several values of
        values: A column of the table for each, e.g. 1, 10, 100
        vary_also: A second parameter: every value of one with every value of the other
        also_values: The values of the second

    Returns:
        The table, a row for each value.
    """
    asked = {vary: [numbers()[vary](value) for value in values]}
    if vary_also:
        if vary_also == vary or not also_values:
            raise MufasaError("vary_also needs another parameter than vary, and values of it: give also_values")
        asked[vary_also] = [numbers()[vary_also](value) for value in also_values]
    return predicted(believed(model, movie), asked)


design_widget = magic_factory(design, call_button="Predict", widget_init=begin)


def targets(
    wanted: str = "snr_spot", value: float = 5.0, and_also: str = "frames_before_bleaching", other: float = 200.0
) -> dict[str, float]:
    """Predictions that are wanted: at least, of errors and losses at most."""
    return {wanted: value} | ({and_also: other} if and_also else {})


class DesignPanel(Panel):
    words = "What the model predicts before any movie is taken: by formulas, and of effects by simulated movies."
    run_label, running = "Predict", "Predicting"
    form_factory = design_widget
    hidden = ("movie",)

    def build(self) -> None:
        self.prediction: Any = None
        self.varied: list[str] = []
        self.table = RowTable(["Prediction"], "Predictions, a column for each value")
        header: Any = self.table.horizontalHeader()
        header.setSectionResizeMode(0, header.ResizeMode.ResizeToContents)  # what it is must not be cut
        self.plot = PlotCanvas(self.viewer, "Press Predict: curves over one value, maps over two.", 260)
        self.shown = dress_one(ComboBox(choices=TARGETS, value="snr_spot", label="Prediction drawn"))
        self.shown.changed.connect(self._draw)
        self.power_plot = PlotCanvas(self.viewer, "The share of movies in which a diagnosis sees the effect.", 270)
        page = QWidget()
        column(page, self.shown.native, self.plot, shares=(0, 1))
        self.save_button = self.saver("Save table as CSV …", "Save predictions", self.save, "design.csv")
        what_follows = section("What follows", DerivedValues(self.session))
        self.add(self.form.native, self.run_bar, what_follows, section("Solve for a target", self._solver()))
        self.power_section = section("Would an effect be seen?", self._power())
        self.add(self.power_section)
        self.tabs = Tabs(300, {"Table": self.table, "Plot": page, "Effect seen?": self.power_plot})
        self.add(last=self.tabs)
        self.add(self.save_button)

    def _solver(self) -> Any:
        """Targets, and a button that changes the varied value of the model until the first is met."""
        also = TARGET | {"label": "and", "choices": NOTHING + TARGETS}
        self.targets: Any = magicgui(
            targets, call_button=False, wanted=TARGET | {"choices": TARGETS}, value=VALUE, and_also=also, other=VALUE
        )
        dress(self.targets)
        self.solution = Words()
        self.solve_button = button(
            "Solve", partial(self.guarded, self.solve), "Change the varied value of the model until the first is met"
        )
        owner = QWidget()
        column(owner, self.targets.native, row(self.solve_button), self.solution)
        return owner

    def solve(self) -> None:
        """Set the varied value of the model so that the first target is met, and say where all are."""
        found = solve(self.session.model, self.targets(), self.form.vary.value)
        self.session.change_model(found.model, "solved")
        self.solution.say("<br>".join(solution_lines(found)))

    def _power(self) -> Any:
        """An effect, its strengths, and a button that simulates movies with them."""
        self.hidden_effect: Any = shared(power_widget(call_button=False), self.viewer)
        self.hidden_effect.movie.visible = self.hidden_effect.model.visible = False
        self.power_button = button(
            "How often is it seen?", partial(self.guarded, self.simulate_power), "Simulate movies with each strength"
        )
        self.run_bar.besides.append(self.power_button)
        owner = QWidget()
        column(owner, self.hidden_effect.native, row(self.power_button))
        return owner

    def simulate_power(self) -> None:
        """Simulate movies with an effect, and draw in how many of them it is seen."""
        asked = self.hidden_effect.asdict()

        def show(found: pd.DataFrame) -> None:
            self.tabs.setCurrentWidget(self.power_plot)
            self.power_plot.draw(lambda figure: power_curve(figure, found, asked["effect"]), found)
            into_view(self.tabs)

        self.run_bar.start("Simulating movies with the effect", lambda: power(**asked), show)
        into_view(self.run_bar)

    def take(self, found: pd.DataFrame) -> None:
        self.prediction = found
        self.varied = [name for name in found.columns if "." in name]
        names = [name for name in found.columns if name not in self.varied]
        self.table.setColumnCount(1 + len(found))
        heads = [" / ".join(f"{value:g}" for value in values) for values in found[self.varied].to_numpy()]
        self.table.setHorizontalHeaderLabels(["Prediction", *heads])
        self.table.fill((name, [told(name), *(_short(value) for value in found[name])], told(name)) for name in names)
        self.save_button.setEnabled(True)
        self._draw()

    def _draw(self, _shown: Any = None) -> None:
        if self.prediction is not None:
            table, varied, shown = self.prediction, self.varied, [str(self.shown.value)]
            self.plot.draw(lambda figure: predictions(figure, table, varied, shown), table)

    def save(self, path: str) -> str:
        from napari_mufasa.files.whole import write_table

        write_table(path, self.prediction)
        return path


def _short(value: Any) -> str:
    return "–" if value is None or value != value else number_text(float(f"{value:.3g}"))
