"""The Compare step: how far the model's emission is from the measured one, beside its floor and two simpler models."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from qtpy.QtWidgets import QCheckBox, QComboBox, QFileDialog, QLabel, QPushButton, QVBoxLayout, QWidget

from napari_mufasa.widgets.parts.fields import number_text
from napari_mufasa.widgets.parts.panel import MovieChooser, Panel, Tabs, seed_row
from napari_mufasa.widgets.parts.plot import PlotCanvas
from napari_mufasa.widgets.parts.preferences import preference
from napari_mufasa.widgets.steps.model import ModelSource
from napari_mufasa.widgets.turns.jobs import guarded
from napari_mufasa.widgets.turns.live import LiveLine

if TYPE_CHECKING:
    from napari_mufasa.compare import Comparison

CURVES = {
    "counts": "Signal per frame",
    "autocorrelation": "Autocorrelation",
    "on_times": "On times",
    "off_times": "Off times",
    "survival": "Not yet bleached",
    "levels": "On levels",
}


class ComparePanel(Panel):
    """Over `napari_mufasa.compare.compare_movie`."""

    title = "Compare"
    words = (
        "Simulate the believed model, read its movie like the measured one, and compare the molecules' signals. "
        "The floor is the distance between two halves of the measurement: no model gets below it."
    )
    run_label = "Compare"

    def build(self) -> None:
        self.chooser = MovieChooser(self.session)
        self.source = ModelSource(self.session)
        self.seed, row = seed_row()
        self.fit = QCheckBox("also fit brightness, background and bleaching")
        self.fit.setToolTip("A wrong laser power is then not read as wrong physics")
        self.fit.setChecked(bool(preference("steps.fit_before_comparing")))
        self.column.addWidget(self.chooser)
        self.column.addWidget(self.source)
        self.column.addLayout(row)
        self.column.addWidget(self.fit)
        self.column.addWidget(self.run_bar)
        self.result = QLabel()
        self.result.setWordWrap(True)
        self.result.hide()
        self.column.addWidget(self.result)
        self.live_line = LiveLine(self.session)
        self.live = PlotCanvas(self.viewer, "Measured signal and that of the model as it is being edited.", 230)
        self.traces = PlotCanvas(self.viewer, "Measured and simulated traces appear here.", 230)
        self.session.live.changed.connect(self._show_live)
        self.column.addWidget(self.live_line)
        self.distances = PlotCanvas(self.viewer, "The distances appear here.", 260)
        self.curves = PlotCanvas(self.viewer, "The distributions appear here.", 230)
        self.which = QComboBox()
        self.which.setAccessibleName("Distribution")
        for name, words in CURVES.items():
            self.which.addItem(words, name)
        self.which.currentIndexChanged.connect(self._show_curves)
        page = QWidget()
        inside = QVBoxLayout(page)
        inside.setContentsMargins(0, 4, 0, 0)
        inside.addWidget(self.which)
        inside.addWidget(self.curves, 1)
        self.tabs = Tabs(320)
        self.tabs.addTab(self.distances, "Distances")
        self.tabs.addTab(page, "Distributions")
        self.tabs.addTab(self.live, "Live")
        self.tabs.addTab(self.traces, "Traces")
        self.column.addWidget(self.tabs, 1)
        self.use_button = QPushButton("Believe the fitted model")
        self.use_button.setToolTip("Take the fitted brightness, background and bleaching into the model")
        self.use_button.clicked.connect(self._use_fitted)
        self.use_button.hide()
        self.export_button = QPushButton("Export report …")
        self.export_button.clicked.connect(self._ask_and_export)
        self.export_button.setEnabled(False)
        self.column.addWidget(self.use_button)
        self.column.addWidget(self.export_button)
        self.comparison: Comparison | None = None

    def prepare(self) -> None:
        measurement = self.session.measurement().recorded()
        model, seed, fit = self.session.matching_model(measurement.movie), self.seed.value(), self.fit.isChecked()

        def work(progress: Any, cancel: Any) -> Any:
            from napari_mufasa.compare import compare_movie

            return compare_movie(
                measurement.movie, model, measurement.dark, seed=seed, fit=fit, progress=progress, cancel=cancel
            )

        self.start("Comparing", work, self._show)

    def _show(self, comparison: Comparison) -> None:
        import pandas as pd

        from napari_mufasa.report.plots.emission import MODELS

        self.comparison = comparison
        w1, interval = comparison.w1, comparison.w1_interval
        rows = []
        for name in ("mufasa", "fitted", "poisson", "sofi"):
            if w1.get(name) is not None:
                low, high = interval[name]
                words = f"{number_text(round(w1[name], 2))} ({low:.2f} … {high:.2f})"
                rows.append(f"<tr><td>{MODELS[name]}&nbsp;&nbsp;</td><td><b>{words}</b></td></tr>")
        floor = comparison.floor
        rows.append(f"<tr><td>floor</td><td>{floor.value:.2f} ({floor.low:.2f} … {floor.high:.2f})</td></tr>")
        molecules = len(comparison.samples["measured"].traces)
        notes = "".join(f"<br>{note}" for note in comparison.notes)
        self.result.setText(
            f"W1 distance in {w1['unit']}, {molecules} molecules (95 % interval)<table>{''.join(rows)}</table>{notes}"
        )
        self.result.show()
        self.use_button.setVisible(comparison.fit is not None)
        self.export_button.setEnabled(True)
        self.distances.draw(lambda figure: _draw_distances(figure, w1), pd.DataFrame([w1]))
        self._show_curves()
        best = "fitted" if comparison.fit is not None else "mufasa"
        samples, name = comparison.samples, MODELS[best]
        self._show_traces(samples["measured"].traces, samples[best].traces, name)
        self.session.set_result("comparison", comparison)

    def _show_curves(self, _index: int = 0) -> None:
        import pandas as pd

        if self.comparison is None:
            return
        shown = self.comparison.distributions[self.which.currentData()]
        data = pd.DataFrame({shown.x_label: shown.x, **shown.curves})
        self.curves.draw(lambda figure: _draw_distribution(figure, shown), data)

    def _show_live(self) -> None:
        """The signal of measured traces and of the model now, with their distance."""
        import pandas as pd

        distance = self.session.live.distance
        if distance is None or self.session.live.busy:
            return
        shown = distance.distribution
        data = pd.DataFrame({shown.x_label: shown.x, **shown.curves})
        w1 = {"mufasa": distance.w1}
        self.live.draw(lambda figure: _draw_distribution(figure, shown, w1), data)
        if self.comparison is None:
            self._show_traces(distance.measured, distance.simulated, "this model")

    def _show_traces(self, measured: Any, simulated: Any, name: str) -> None:
        """A few measured traces on the left, as many of the model on the right."""
        if len(measured) and len(simulated):
            self.traces.draw(lambda figure: _draw_traces(figure, measured, simulated, name))

    def _use_fitted(self) -> None:
        if self.comparison is not None and self.comparison.fit is not None:
            self.session.set_model(self.comparison.fit.model, f"{self.session.model_origin}, fitted")

    def _ask_and_export(self) -> None:
        path, _ = QFileDialog.getSaveFileName(self, "Export comparison", "report.json", filter="Report (*.json)")
        if path:
            guarded(self.run_bar, lambda: self.export(path))

    def export(self, path: str) -> None:
        """Write report.json (SPEC.md §10)."""
        from napari_mufasa.files.whole import write_json

        if self.comparison is not None:
            write_json(path, self.comparison.report())
            self.run_bar.say(f"Written: {path}")


def _draw_distances(figure: Any, w1: dict[str, Any]) -> None:
    from napari_mufasa.report import plots as plotting

    plotting.w1_bars(figure.subplots(), w1)


def _draw_distribution(figure: Any, shown: Any, w1: dict[str, Any] | None = None) -> None:
    from napari_mufasa.report import plots as plotting

    plotting.distribution(figure.subplots(), shown, w1)


def _draw_traces(figure: Any, measured: Any, simulated: Any, name: str) -> None:
    from napari_mufasa.report import plots as plotting

    plotting.side_by_side(figure, measured, simulated, name)
