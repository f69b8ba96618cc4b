"""The Data step: which layer is the movie, where the dark frames are, what is known about them."""

from __future__ import annotations

from collections.abc import Generator
from typing import TYPE_CHECKING, Any

from magicgui.widgets import ComboBox
from qtpy.QtWidgets import QFileDialog, QHBoxLayout

from napari_mufasa.errors import MufasaError
from napari_mufasa.widgets.parts.forms import dress_one, step_form
from napari_mufasa.widgets.parts.layers import added_hidden, resolution_um
from napari_mufasa.widgets.parts.panel import Panel, boxed, button, wrapped
from napari_mufasa.widgets.parts.parameters import Dark, DarkFrames, Movie
from napari_mufasa.widgets.turns.jobs import guarded
from napari_mufasa.widgets.turns.session import Measurement, measurement_of, model_in, stack_of, stored

if TYPE_CHECKING:
    from magicgui.widgets import FunctionGui
    from napari.viewer import Viewer

SAMPLES = [
    ("Sample: hidden effect", "hidden_effect"), ("Sample: FF", "ff"), ("Sample: Blinking", "blinking"),
    ("Sample: STORM", "storm"), ("Sample: PALM", "palm"),
]  # fmt: skip


def measurement(movie: Movie, dark: Dark = None, dark_frames: DarkFrames = 0) -> Measurement:
    """What was recorded."""
    return measurement_of(movie, dark, dark_frames)


def data_widget(viewer: Viewer | None = None, call_button: Any = False) -> FunctionGui[..., Any]:
    return step_form(measurement, viewer, call_button)


class DataPanel(Panel):
    """Choose the measurement. Opening a movie that carries its model takes that model over."""

    words = "Open a movie, say which layer it is and where its dark frames are."
    run_label = "Open movie …"
    form_factory = data_widget
    hidden = ()

    def build(self) -> None:
        self.sample = dress_one(ComboBox(choices=SAMPLES, label="Sample"))
        self.sample_button = button("Open sample", self._open_sample)
        self.facts = wrapped()
        self.use_model = button(
            "Believe the model in the metadata", self._use_model, "Take over the model that travelled with the movie"
        )
        self.use_scale = button("", self._use_scale)
        row = boxed((self.sample.native, self.sample_button), QHBoxLayout())
        self.add(self.run_bar, row, self.form.native, self.facts, self.use_model, self.use_scale)
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

            return _made([movie_layer(path)])

        self.start("Opening", work, self.take)

    def open_sample(self, key: str) -> None:
        """Open one of the plugin's samples: it is simulated in the background."""

        def work(progress: Any, cancel: Any) -> Any:
            from napari_mufasa import samples

            return _made(getattr(samples, f"sample_{key}")())

        self.start("Simulating the sample", work, self.take)

    def take(self, made: list[tuple[Any, bool]]) -> Generator[None, None, None]:
        for layer, shown in made:
            yield from added_hidden(self.viewer, layer, shown)
        self.session.set_movie(next(layer for layer, _ in made if stored(layer, "role") != "dark frames"))
        yield
        self._use_model()
        yield
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
            carried = model_in(layer)
        except MufasaError as error:
            self.facts.setText(str(error))
            return
        size = resolution_um(layer)
        lines = [f"<b>{layer.name}</b>: {shape[0]} frames of {shape[1]} × {shape[2]} px, {layer.dtype}"]
        lines.append(f"pixel size {size * 1000:.4g} nm" if size else "pixel size not stated: the model's is used")
        if not size and self.session.model_chosen:
            size_nm = self.session.model.acquisition.pixel_size_nm
            self.use_scale.setText(f"Give it the model's pixel size, {size_nm:g} nm")
            self.use_scale.setVisible(True)
        if carried is None:
            lines.append("carries no model: choose one in step Model, the camera in step Camera")
        else:
            same = self.session.model == carried
            lines.append(f"carries a model ({carried.protocol}, {carried.camera.type})" + (", in use" * same))
            self.use_model.setVisible(not same)
        self.facts.setText("<br>".join(lines))

    def _open_sample(self) -> None:
        guarded(self.run_bar, lambda: self.open_sample(str(self.sample.value)))

    def _use_scale(self) -> None:
        from napari_mufasa.files.layers import movie_space

        layer = self.session.movie_layer
        if layer is not None and layer.ndim == 3:
            space = movie_space(self.session.model.acquisition.pixel_size_nm)
            layer.scale, layer.units = space["scale"], space["units"]
            self.viewer.reset_view()
        self.refresh()

    def _use_model(self) -> None:
        layer = self.session.movie_layer
        if layer is not None and model_in(layer) is not None:
            self.session.take_model_of_movie()
        self.refresh()


def _made(found: list[Any]) -> list[tuple[Any, bool]]:
    """Layers, not visible, and whether they are to be."""
    from napari.layers import Layer

    return [(Layer.create(data, o | {"visible": False}, kind), o.get("visible", True)) for data, o, kind in found]
