"""Compare: how far the model's emission is from the measured one, beside its floor and two simpler models."""

from typing import TYPE_CHECKING, Annotated, Any

from magicgui import magic_factory
from magicgui.widgets import ComboBox
from napari.layers import Layer
from qtpy.QtWidgets import QWidget

from napari_mufasa.files.layers import measurement_of
from napari_mufasa.report.lines import comparison_table
from napari_mufasa.report.offscreen import drawing
from napari_mufasa.widgets.parts.doubts import Doubts
from napari_mufasa.widgets.parts.forms import begin, dress_one
from napari_mufasa.widgets.parts.layers import ours
from napari_mufasa.widgets.parts.panel import Panel
from napari_mufasa.widgets.parts.parameters import Believed, Dark, DarkFrames, Movie, Seed
from napari_mufasa.widgets.parts.pieces import Tabs, Words, button, column
from napari_mufasa.widgets.parts.plot import PlotCanvas
from napari_mufasa.widgets.steps.traces import molecules_on
from napari_mufasa.widgets.turns.live import NOT_YET, LiveLine, live_of
from napari_mufasa.widgets.turns.session import believed
from napari_mufasa.widgets.turns.steering import steering

if TYPE_CHECKING:
    from napari_mufasa.compare import Comparison

CURVES = [
    ("Signal per frame", "counts"), ("Autocorrelation", "autocorrelation"), ("On times", "on_times"),
    ("Off times", "off_times"), ("Not yet bleached", "survival"), ("On levels", "levels"),
]  # fmt: skip


def compare(
    movie: Movie,
    dark: Dark = None,
    dark_frames: DarkFrames = 0,
    model: Believed = None,
    seed: Seed = 1,
    fit: Annotated[bool, {"label": "also fit brightness, background and bleaching"}] = True,
) -> list[Layer]:
    """Simulate the believed model, read its movie like the measured one, and compare the molecules' signals.

    Parameters:
        fit: A wrong laser power is then not read as wrong physics

    Returns:
        One layer of points, the molecules compared; its ``metadata["napari_mufasa"]["comparison"]`` is the
        `Comparison`.
    """
    from napari_mufasa.compare import compare_movie

    progress, cancel = steering()
    measurement = measurement_of(movie, dark, dark_frames).recorded()
    found = compare_movie(
        measurement.movie, believed(model, movie), measurement.dark,
        seed=seed, fit=fit, progress=progress, cancel=cancel,
    )  # fmt: skip
    assert found.measured is not None  # it was a movie
    return [molecules_on(movie, found.measured, measurement.first_frame, comparison=found)]


compare_widget = magic_factory(compare, call_button="Compare", widget_init=begin)


class ComparePanel(Panel):
    words = (
        "Simulate the believed model, read its movie like the measured one, and compare the molecules' signals. "
        "The floor is the distance between two halves of the measurement: no model can be expected to do better."
    )
    run_label, running, needs_counts = "Compare", "Comparing", True
    form_factory = compare_widget

    def build(self) -> None:
        self.comparison: Comparison | None = None
        self.result, self.live_line = Words(), LiveLine(self.session)
        self.distances = PlotCanvas(self.viewer, "The distances appear here.", 260)
        self.curves = PlotCanvas(self.viewer, "The distributions appear here.", 230)
        self.live = PlotCanvas(self.viewer, "Measured signal and that of the model as it is being edited.", 230)
        self.traces = PlotCanvas(self.viewer, "Measured and simulated traces appear here.", 230)
        self.which = dress_one(ComboBox(choices=CURVES, label="Distribution"))
        self.which.changed.connect(self._show_curves)
        page = QWidget()
        column(page, self.which.native, self.curves, margins=(0, 4, 0, 0))
        pages = {"Distances": self.distances, "Distributions": page, "Live": self.live, "Traces": self.traces}
        self.tabs = Tabs(320, pages)
        self.use_button = button(
            "Believe the fitted model", self._use_fitted,
            "Take the fitted brightness, background and bleaching into the model",
        )  # fmt: skip
        self.use_button.hide()
        self.export_button = self.saver("Export report …", "Export comparison", self.export, "report.json")
        self.add(
            self.form.native, Doubts(self.session, self), self.run_bar, self.result, self.live_line, last=self.tabs
        )
        self.add(self.use_button, self.export_button)
        live_of(self.session).changed.connect(self._show_live)
        self.session.movie_changed.connect(self._show_result)

    def take(self, layers: list[Any]) -> None:
        """The molecules are step Molecules' to show: here are the distances."""
        import pandas as pd

        from napari_mufasa.report.plots.emission import MODELS

        comparison: Comparison = ours(layers[0])["comparison"]
        self.comparison, self._movie = comparison, ours(layers[0])["movie"]
        movie = self._movie()
        self._name = movie.name if movie is not None else "a movie that was removed"
        self._show_result()
        self.export_button.setEnabled(True)
        self.distances.draw(drawing("w1_bars", comparison.w1), pd.DataFrame([comparison.w1]))
        self._show_curves()
        nearer = comparison.nearer
        self._show_traces(comparison.samples["measured"].traces, comparison.samples[nearer].traces, MODELS[nearer])
        if comparison.measured is not None:
            self.session.set_traces(comparison.measured, movie)

    def _show_result(self) -> None:
        """The distances; where they are of another movie than the one chosen, its name, and no offer to believe."""
        if self.comparison is None:
            return
        of = self.whose(self._movie(), self._name)
        self.result.say(of + comparison_table(self.comparison))
        self.use_button.setVisible(not of and self.comparison.nearer == "fitted")

    def _show_curves(self, _which: Any = None) -> None:
        if self.comparison is not None:
            _draw(self.curves, self.comparison.distributions[str(self.which.value)])

    def _show_live(self) -> None:
        """The signal of measured traces and of the model now, with their distance."""
        live = live_of(self.session)
        distance = live.distance
        if self.session.traces is None:
            self.live.clear(NOT_YET)
        if distance is None or live.busy:
            return
        _draw(self.live, distance.distribution, {"mufasa": distance.w1})
        if self.comparison is None:
            self._show_traces(distance.measured, distance.simulated, "this model")

    def _show_traces(self, measured: Any, simulated: Any, name: str) -> None:
        """A few measured traces on the left, as many of the model on the right."""
        if len(measured) and len(simulated):
            self.traces.draw(drawing("side_by_side", measured, simulated, name, whole=True))

    def _use_fitted(self) -> None:
        if self.comparison is not None and self.comparison.fit is not None:
            self.session.set_model(self.comparison.fit.model, f"{self.session.model_origin}, fitted")

    def export(self, path: str) -> str:
        """Write report.json (docs/files.md)."""
        from napari_mufasa.files.whole import write_json

        assert self.comparison is not None
        write_json(path, self.comparison.report())
        return path


def _draw(canvas: PlotCanvas, shown: Any, w1: dict[str, Any] | None = None) -> None:
    import pandas as pd

    canvas.draw(drawing("distribution", shown, w1), pd.DataFrame({shown.x_label: shown.x, **shown.curves}))
