"""Design: what a model predicts before any movie is taken."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import pandas as pd

from napari_mufasa.errors import MufasaError
from napari_mufasa.model.model import Model
from napari_mufasa.report.fields import number_text, told
from napari_mufasa.widgets.parts.edits import ListEdit
from napari_mufasa.widgets.parts.forms import step_form
from napari_mufasa.widgets.parts.panel import Panel, button, section, takes_the_rest
from napari_mufasa.widgets.parts.parameters import AnyMovie, Believed
from napari_mufasa.widgets.parts.part_editor import DerivedValues
from napari_mufasa.widgets.parts.tables import RowTable
from napari_mufasa.widgets.turns.session import believed

if TYPE_CHECKING:
    from magicgui.widgets import FunctionGui
    from napari.viewer import Viewer


def varied() -> list[tuple[str, str]]:
    """Label and dotted path of every number of a set-up that can be varied."""
    found = []
    for part in ("excitation", "fluorophore", "optics", "camera", "acquisition", "sample"):
        kind: Any = Model.model_fields[part].annotation
        for name, field in kind.model_fields.items():
            if field.annotation in (int, float, float | None, int | None):
                found.append((told(name), f"{part}.{name}"))
    return found


def design(
    movie: AnyMovie = None,
    model: Believed = None,
    vary: Annotated[
        str,
        {"widget_type": "ComboBox", "label": "Vary", "choices": varied(), "tooltip": "What to try several values of"},
    ] = ("excitation.power_density_w_per_cm2"),
    values: Annotated[
        tuple[float, ...],
        {"widget_type": ListEdit, "label": "Values", "tooltip": "A column of the table for each, e.g. 1, 10, 100"},
    ] = (1.0, 10.0, 100.0),
) -> pd.DataFrame:
    """Predict signal, noise, life time and detectability for some values of one parameter of a model.

    Without a model: the one in the movie's metadata. Returns the table, a row for each value.
    """
    from napari_mufasa.design import design as run

    model, whole = believed(model, movie), isinstance(_now(vary), int)
    return run(model, {vary: [int(value) if whole else value for value in values]})


def design_widget(viewer: Viewer | None = None, call_button: Any = "Predict") -> FunctionGui[..., Any]:
    return step_form(design, viewer, call_button)


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
        self.save_button = button(
            "Save table as CSV …", lambda: self.ask_where("Save predictions", self.save, "design.csv"), enabled=False
        )
        self.add(self.form.native, self.run_bar, section("What follows", DerivedValues(self.session)))
        self.column.addWidget(self.table, 1)
        self.add(self.save_button)

    def take(self, found: pd.DataFrame) -> None:
        self.prediction = found
        varied, *names = found.columns
        self.table.setColumnCount(1 + len(found))
        self.table.setHorizontalHeaderLabels(["Prediction", *(f"{value:g}" for value in found[varied])])
        self.table.fill((name, [told(name), *(_short(value) for value in found[name])], told(name)) for name in names)
        self.save_button.setEnabled(True)

    def save(self, path: str) -> None:
        from napari_mufasa.files.whole import write_table

        if self.prediction is None:
            raise MufasaError("nothing was predicted yet: press Predict first")
        write_table(path, self.prediction)
        self.run_bar.say(f"Written: {path}")


def _now(path: str) -> Any:
    """What kind of number a path of the model is."""
    part, name = path.split(".")
    owner: Any = Model.model_fields[part].annotation
    kind = owner.model_fields[name].annotation
    return 0 if kind in (int, int | None) else 0.0


def _short(value: Any) -> str:
    return "–" if value is None or value != value else number_text(float(f"{value:.3g}"))
