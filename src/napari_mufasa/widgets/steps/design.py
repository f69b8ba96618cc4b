"""Design: what a model predicts before any movie is taken."""

from __future__ import annotations

from typing import Annotated, Any

import pandas as pd

from napari_mufasa.design import design as predicted
from napari_mufasa.design import numbers
from napari_mufasa.errors import MufasaError
from napari_mufasa.report.fields import number_text, told
from napari_mufasa.widgets.parts.edits import ListEdit
from napari_mufasa.widgets.parts.forms import DerivedValues, widget_of
from napari_mufasa.widgets.parts.panel import Panel
from napari_mufasa.widgets.parts.parameters import AnyMovie, Believed
from napari_mufasa.widgets.parts.pieces import RowTable, section, takes_the_rest
from napari_mufasa.widgets.turns.session import believed

NUMBERS = [(told(path.split(".")[1]), path) for path in numbers()]


def design(
    movie: AnyMovie = None,
    model: Believed = None,
    vary: Annotated[
        str, {"widget_type": "ComboBox", "label": "Vary", "choices": NUMBERS}
    ] = "excitation.power_density_w_per_cm2",
    values: Annotated[tuple[float, ...], {"widget_type": ListEdit, "label": "Values"}] = (1.0, 10.0, 100.0),
) -> pd.DataFrame:
    """Predict signal, noise, life time and detectability for some values of one parameter of a model.

    Without a model: the one in the movie's metadata.

    Parameters:
        vary: What to try several values of
        values: A column of the table for each, e.g. 1, 10, 100

    Returns:
        The table, a row for each value.
    """
    return predicted(believed(model, movie), {vary: [numbers()[vary](value) for value in values]})


design_widget = widget_of(design, "Predict")


class DesignPanel(Panel):
    words = "What the model predicts before any movie is taken, by formulas. To see an effect, simulate."
    run_label, running = "Predict", "Predicting"
    form_factory = design_widget
    hidden = ("movie",)

    def build(self) -> None:
        self.prediction: pd.DataFrame | None = None
        self.table = RowTable(["Prediction"], "Predictions, a column for each value")
        header: Any = self.table.horizontalHeader()
        header.setSectionResizeMode(0, header.ResizeMode.ResizeToContents)  # what it is must not be cut
        takes_the_rest(self.table, 300)
        self.save_button = self.saver("Save table as CSV …", "Save predictions", self.save, "design.csv")
        what_follows = section("What follows", DerivedValues(self.session))
        self.add(self.form.native, self.run_bar, what_follows, last=self.table)
        self.add(self.save_button)

    def take(self, found: pd.DataFrame) -> None:
        self.prediction = found
        varied, *names = found.columns
        self.table.setColumnCount(1 + len(found))
        self.table.setHorizontalHeaderLabels(["Prediction", *(f"{value:g}" for value in found[varied])])
        self.table.fill((name, [told(name), *(_short(value) for value in found[name])], told(name)) for name in names)
        self.save_button.setEnabled(True)

    def save(self, path: str) -> str:
        from napari_mufasa.files.whole import write_table

        if self.prediction is None:
            raise MufasaError("nothing was predicted yet: press Predict first")
        write_table(path, self.prediction)
        return path


def _short(value: Any) -> str:
    return "–" if value is None or value != value else number_text(float(f"{value:.3g}"))
