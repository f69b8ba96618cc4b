"""The Data step: which layer is the movie, where the dark frames are, what is known about them."""

from __future__ import annotations

from collections.abc import Generator
from typing import TYPE_CHECKING, Any

from qtpy.QtWidgets import QComboBox, QFileDialog, QFormLayout, QHBoxLayout, QLabel, QPushButton, QSpinBox, QWidget

from napari_mufasa.errors import MufasaError
from napari_mufasa.widgets.parts.layers import resolution_um, slim
from napari_mufasa.widgets.parts.panel import MovieChooser, Panel
from napari_mufasa.widgets.turns.gently import gently, room_for, shown_later
from napari_mufasa.widgets.turns.jobs import guarded
from napari_mufasa.widgets.turns.session import model_in, stack_of, stored

if TYPE_CHECKING:
    from napari.viewer import Viewer

SAMPLES = {
    "Sample: hidden effect": "hidden_effect",
    "Sample: FF": "ff",
    "Sample: Blinking": "blinking",
    "Sample: STORM": "storm",
    "Sample: PALM": "palm",
}


class DataPanel(Panel):
    """Choose the measurement. Opening a movie that carries its model takes that model over."""

    title = "Data"
    words = "Open a movie, say which layer it is and where its dark frames are."
    run_label = "Open movie …"

    def __init__(self, viewer: Viewer) -> None:
        super().__init__(viewer)

    def build(self) -> None:
        self.sample = QComboBox()
        self.sample.addItems(list(SAMPLES))
        self.sample.setAccessibleName("Sample")
        slim(self.sample)
        self.sample_button = QPushButton("Open sample")
        self.sample_button.clicked.connect(self._open_sample)
        row = QHBoxLayout()
        row.addWidget(self.sample, 1)
        row.addWidget(self.sample_button)
        self.column.addWidget(self.run_bar)
        self.column.addLayout(row)
        self.chooser = MovieChooser(self.session)
        self.column.addWidget(self.chooser)
        self.first_dark = QSpinBox()
        self.first_dark.setRange(0, 100_000)
        self.first_dark.setSpecialValueText("none")
        self.first_dark.setToolTip("Number of frames at the start of the movie that were taken without light")
        self.first_dark.valueChanged.connect(self.session.set_first_dark_frames)
        form = QFormLayout()
        form.addRow("… or first frames dark", self.first_dark)
        self.column.addLayout(form)
        self.facts = QLabel()
        self.facts.setWordWrap(True)
        self.column.addWidget(self.facts)
        self.use_model = QPushButton("Believe the model in the metadata")
        self.use_model.setToolTip("Take over the model that travelled with the movie")
        self.use_model.clicked.connect(self._use_model)
        self.column.addWidget(self.use_model)
        self.use_scale = QPushButton()
        self.use_scale.clicked.connect(self._use_scale)
        self.column.addWidget(self.use_scale)
        self.column.addStretch(1)
        self.session.movie_changed.connect(self.refresh)
        self.session.model_changed.connect(self.refresh)
        self.refresh()

    def prepare(self) -> None:
        path, _ = QFileDialog.getOpenFileName(self, "Open movie", filter="Movies (*.tif *.tiff);;All files (*)")
        if path:
            self.open_movie(path)

    def open_movie(self, path: str) -> None:
        """Open any TIFF or zarr movie, ours or foreign, lazily; in the background, for a header may be long."""

        def work(progress: Any, cancel: Any) -> Any:
            from napari_mufasa.files.layers import movie_layer

            return [movie_layer(path)]

        self.start("Opening", work, self._add)

    def open_sample(self, key: str) -> None:
        """Open one of the plugin's samples: it is simulated in the background."""

        def work(progress: Any, cancel: Any) -> Any:
            from napari_mufasa import samples

            return getattr(samples, f"sample_{key}")()

        self.start("Simulating the sample", work, self._add)

    def _add(self, found: list[Any]) -> Generator[None, None, None]:
        from napari.layers import Image

        yield from room_for(self.viewer, found[-1][0].shape, found[-1][1].get("scale"))
        added = []
        for data, options, _ in found:
            layer = Image(data, **(options | {"visible": False}))
            yield
            with gently(self.viewer):
                added.append(self.viewer.add_layer(layer))
            if options.get("visible", True):
                yield from shown_later(self.viewer, layer)
            yield
        self._take(next(layer for layer in added if stored(layer, "role") != "dark frames"))
        self.viewer.dims.set_point(0, 0)

    def refresh(self) -> None:
        layer = self.session.movie_layer
        self.use_model.setVisible(False)
        self.use_scale.setVisible(False)
        if layer is None:
            self.facts.setText("No movie yet.")
            return
        try:
            shape = stack_of(layer).shape
            believed = model_in(layer)
        except MufasaError as error:
            self.facts.setText(str(error))
            return
        size = resolution_um(layer)
        lines = [f"<b>{layer.name}</b>: {shape[0]} frames of {shape[1]} × {shape[2]} px, {layer.dtype}"]
        lines.append(f"pixel size {size * 1000:.4g} nm" if size else "pixel size not stated: the model's is used")
        if not size and self.session.model_chosen:
            self.use_scale.setText(
                f"Give it the model's pixel size, {self.session.model.acquisition.pixel_size_nm:g} nm"
            )
            self.use_scale.setVisible(True)
        if believed is None:
            lines.append("carries no model: choose one in step Model, the camera in step Camera")
        else:
            same = self.session.model == believed
            lines.append(f"carries a model ({believed.protocol}, {believed.camera.type})" + (", in use" * same))
            self.use_model.setVisible(not same)
        self.facts.setText("<br>".join(lines))

    def _open_sample(self) -> None:
        guarded(self.run_bar, lambda: self.open_sample(SAMPLES[self.sample.currentText()]))

    def _use_scale(self) -> None:
        from napari_mufasa.files.layers import movie_space

        layer = self.session.movie_layer
        if layer is not None and layer.ndim == 3:
            space = movie_space(self.session.model.acquisition.pixel_size_nm)
            layer.scale, layer.units = space["scale"], space["units"]
            self.viewer.reset_view()
        self.refresh()

    def _take(self, layer: Any) -> None:
        self.session.set_movie(layer)
        self._use_model()

    def _use_model(self) -> None:
        layer = self.session.movie_layer
        model = model_in(layer) if layer is not None else None
        if layer is not None and model is not None:
            self.session.set_model(model, f"metadata of {layer.name}")
        self.refresh()


class CameraPanel(QWidget):
    """The camera of every later step."""

    title = "Camera"

    def __init__(self, viewer: Viewer) -> None:
        from qtpy.QtWidgets import QVBoxLayout

        from napari_mufasa.widgets.steps.model import ModelSource, PartEditor
        from napari_mufasa.widgets.turns.session import session_of

        super().__init__()
        session = self.session = session_of(viewer)
        words = QLabel("The camera that recorded the movie. It is used in every later step.")
        words.setWordWrap(True)
        self.source = ModelSource(session)
        self.editor = PartEditor(session, "camera")
        self.timing = PartEditor(session, "acquisition", ("frame_length_s", "frame_interval_s", "pixel_size_nm"))
        column = QVBoxLayout(self)
        column.setContentsMargins(6, 6, 6, 6)
        for widget in (words, self.source, self.editor, QLabel("<b>Timing and pixels</b>"), self.timing):
            column.addWidget(widget)
        column.addStretch(1)
