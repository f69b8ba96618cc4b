"""The Simulate widget: a movie from the believed model."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

from qtpy.QtWidgets import QCheckBox, QComboBox, QFormLayout, QSpinBox

from napari_mufasa.files.layers import movie_space
from napari_mufasa.widgets.parts.layers import add_movie, points_on
from napari_mufasa.widgets.parts.panel import Panel
from napari_mufasa.widgets.parts.preferences import preference
from napari_mufasa.widgets.steps.model import DerivedValues, ModelSource, PartEditor, section
from napari_mufasa.widgets.turns.gently import gently, room_for, shown_later


class SimulatePanel(Panel):
    """Over `napari_mufasa.simulate`: movie, positions and, if asked for, the noise-free image."""

    title = "Simulate"
    words = "Simulate a movie: molecules, optics and camera of the model, effects included."
    run_label = "Simulate"

    def build(self) -> None:
        self.source = ModelSource(self.session)
        self.column.addWidget(self.source)
        self.acquisition = PartEditor(
            self.session, "acquisition", ("n_frames", "frame_length_s", "pixel_size_nm", "shape_px")
        )
        self.sample = PartEditor(self.session, "sample")
        for editor, name in ((self.acquisition, "Acquisition"), (self.sample, "Sample")):
            self.column.addWidget(section(name, editor, True))
        self.parts = {}
        for part in ("fluorophore", "excitation", "optics", "camera"):
            self.parts[part] = PartEditor(self.session, part)
            self.column.addWidget(section(part.capitalize(), self.parts[part], False))
        self.column.addWidget(section("What follows", DerivedValues(self.session), False))
        self.seed = QSpinBox()
        self.seed.setRange(0, 2**31 - 1)
        self.seed.setValue(int(preference("steps.seed")))
        self.seed.setToolTip("The same seed gives the same movie")
        self.engine = QComboBox()
        self.engine.addItems(["fast", "exact"])
        self.engine.setToolTip("exact draws every jump of every molecule; fast gives the same statistics, sooner")
        self.optical = QCheckBox("also the image before the camera (photons)")
        self.positions = QCheckBox("also the true positions")
        self.positions.setChecked(True)
        form = QFormLayout()
        form.addRow("Seed", self.seed)
        form.addRow("Engine", self.engine)
        self.column.addLayout(form)
        for widget in (self.positions, self.optical, self.run_bar):
            self.column.addWidget(widget)
        self.column.addStretch(1)

    def prepare(self) -> None:
        model, seed = self.session.model, self.seed.value()
        exact = self.engine.currentText() == "exact"

        def work(progress: Any, cancel: Any) -> Any:
            from napari_mufasa.simulate.movie import simulate

            return simulate(model, seed=seed, engine="exact" if exact else "fast", progress=progress, cancel=cancel)

        self.start("Simulating", work, self._show)

    def _show(self, result: Any) -> Generator[None, None, None]:
        model, space = result.model, movie_space(result.model.acquisition.pixel_size_nm)
        yield from room_for(self.viewer, result.movie.shape, space["scale"])
        name = f"{model.protocol} simulated"
        if self.optical.isChecked():
            add_movie(
                self.viewer, result.optical, f"{name}, photons", space, model, result.seed,
                role="photons", visible=False,
            )  # fmt: skip
            yield
        movie = add_movie(self.viewer, result.movie, name, space, model, result.seed, visible=False)
        yield from shown_later(self.viewer, movie)
        self.session.set_movie(movie)
        self.viewer.dims.set_point(0, 0)
        yield
        if self.positions.isChecked():
            import pandas as pd

            photons = pd.DataFrame({"photons": result.emission[: len(result.positions_px)].sum(axis=1)})
            points = points_on(
                movie, result.positions_px, photons, f"{name}, true positions",
                size=6, border_width=0.12, face_color="transparent", border_color="#5ec4ff", visible=False,
            )  # fmt: skip
            with gently(self.viewer):
                self.viewer.add_layer(points)
            if movie in self.viewer.layers:
                self.viewer.layers.selection.active = movie
            yield
        self.run_bar.say(f"{model.acquisition.n_frames} frames, {len(result.positions_px)} molecules.")
