"""The Data step: which layer is the movie, where the dark frames are, what is known about them."""

import os
from collections.abc import Callable, Generator
from typing import Any

from magicgui import magic_factory
from magicgui.widgets import ComboBox
from napari.layers import Layer
from qtpy.QtWidgets import QFileDialog

from napari_mufasa.errors import MufasaError
from napari_mufasa.files.layers import (
    MOVIE_SUFFIXES,
    LayerData,
    Measurement,
    instrument_of,
    measurement_of,
    movie_space,
    pixel_size_um,
    read_layers,
    stack_of,
    stored,
)
from napari_mufasa.propose.written import as_written, values_written
from napari_mufasa.report.lines import instrument_line, movie_facts
from napari_mufasa.samples import SAMPLES
from napari_mufasa.widgets.parts.doubts import Doubts
from napari_mufasa.widgets.parts.forms import begin, dress_one
from napari_mufasa.widgets.parts.layers import added
from napari_mufasa.widgets.parts.panel import Panel
from napari_mufasa.widgets.parts.parameters import Dark, DarkFrames, Movie
from napari_mufasa.widgets.parts.pieces import Words, button, row, section
from napari_mufasa.widgets.steps.register import TwoChannels
from napari_mufasa.widgets.turns.session import model_in

ZARR_FILES = ("zarr.json", ".zarray", ".zattrs")  # that describe a folder


def measurement(movie: Movie, dark: Dark = None, dark_frames: DarkFrames = 0) -> Measurement:
    """What was recorded."""
    return measurement_of(movie, dark, dark_frames)


class DataPanel(Panel):
    """Choose the measurement. Opening a movie that carries its model takes that model over."""

    words = "Open a movie, say which layer it is and where its dark frames are."
    run_label = "Open movie …"
    form_factory = magic_factory(measurement, call_button=False, widget_init=begin)
    hidden = ()

    def build(self) -> None:
        choices = [(f"Sample: {name}", key) for key, (name, _) in SAMPLES.items()]
        self.sample: Any = dress_one(ComboBox(choices=choices, label="Sample"))
        self.sample_button = button("Open sample", lambda: self.open_sample(self.sample.value))
        self.run_bar.besides.append(self.sample_button)
        self.facts = Words("No movie yet.")
        self.use_model = button(
            "Believe the model in the metadata", self.session.take_model_of_movie,
            "Take over the model that travelled with the movie",
        )  # fmt: skip
        self.use_scale = button("", self._use_scale)
        self.use_instrument = button(
            "Believe what the file says", self._use_instrument,
            "Take pixel size, exposure and EM gain from the metadata into the model; each can be changed there",
        )  # fmt: skip
        samples = row(self.sample.native, self.sample_button)
        self.add(
            self.run_bar,
            samples,
            self.form.native,
            self.facts,
            Doubts(self.session, self),
            self.use_model,
            self.use_scale,
        )
        self.channels = TwoChannels(self)
        self.add(self.use_instrument, section("Two channels (image splitter)", self.channels))
        self.column.addStretch(1)
        self.session.movie_changed.connect(self.refresh)
        self.session.model_changed.connect(self.refresh)
        self.refresh()

    def prepare(self) -> None:
        names = " ".join([*(f"*{suffix}" for suffix in MOVIE_SUFFIXES), *ZARR_FILES])
        path, _ = QFileDialog.getOpenFileName(
            self, "Open movie", filter=f"Movies, of a .zarr folder its zarr.json ({names});;All files (*)"
        )
        if path:
            self.open_movie(path)

    def open_movie(self, path: str) -> None:
        """Open any movie, ours or foreign, lazily; in the background, for a header may be long. Of a zarr folder it may
        be the path of the file that describes it: a dialog for files chooses no folder."""
        folder, name = os.path.split(path)
        movie = folder if name in ZARR_FILES else path
        self._open("Opening", lambda: read_layers(movie))

    def open_sample(self, key: str) -> None:
        """Open one of the plugin's samples: it is simulated in the background."""
        self._open("Simulating the sample", SAMPLES[key][1])

    def _open(self, title: str, read: Callable[[], list[LayerData]]) -> None:
        self.run_bar.start(title, lambda: [Layer.create(*data) for data in read()], self.take)

    def take(self, layers: list[Any]) -> Generator[None, None, None]:
        yield from added(self.viewer, layers)
        movie = next((layer for layer in layers if stored(layer, "role") != "dark frames"), None)
        if movie is None:
            self._take_dark(layers[0])
            return
        self.session.set_movie(movie)
        yield
        if model_in(movie) is not None:
            self.session.take_model_of_movie()
        yield
        self.viewer.dims.set_point(0, 0)

    def _take_dark(self, dark: Any) -> None:
        """Dark frames that were opened are those of the movie, where they are of its size."""
        lit = self.session.movie_layer
        if lit is not None and lit.data.shape[-2:] != dark.data.shape[-2:]:
            (h, w), (height, width) = dark.data.shape[-2:], lit.data.shape[-2:]
            self.run_bar.say(
                f"{dark.name} holds dark frames of {h} × {w} pixels, the movie has {height} × {width}: choose others.",
                error=True,
            )
            return
        self.session.set_dark(dark)
        whose = "those of the movie" if lit is not None else "those of the movie that you open next"
        self.run_bar.say(f"{dark.name} holds dark frames, and is taken as {whose}.")

    def refresh(self) -> None:
        layer, model = self.session.movie_layer, self.session.model
        for offer in (self.use_model, self.use_scale, self.use_instrument):
            offer.hide()
        if layer is None:
            self.facts.say("No movie yet.")
            return
        try:
            shape, carried = stack_of(layer).shape, model_in(layer)
        except MufasaError as error:
            self.facts.say(str(error))
            return
        size_um, in_use = pixel_size_um(layer.scale, layer.units), carried == model
        if not size_um and self.session.model_chosen:
            self.use_scale.setText(f"Give it the model's pixel size, {model.acquisition.pixel_size_nm:g} nm")
            self.use_scale.show()
        origin = "carries no model: choose one in step Model, the camera in step Camera"
        if carried is not None:
            self.use_model.setVisible(not in_use)
            origin = f"carries a model ({carried.protocol}, {carried.camera.type})" + (", in use" if in_use else "")
        written = instrument_of(layer)
        if written.known():
            origin = f"the file says: {instrument_line(written.known())}<br>{origin}"
            self.use_instrument.setVisible(carried is None and bool(values_written(model, written)))
        self.facts.say(movie_facts(layer.name, shape, layer.dtype, size_um, origin))

    def _use_scale(self) -> None:
        layer: Any = self.session.movie_layer
        space = movie_space(self.session.model.acquisition.pixel_size_nm)
        layer.scale, layer.units = space["scale"][-layer.ndim :], space["units"][-layer.ndim :]
        self.viewer.reset_view()
        self.refresh()

    def _use_instrument(self) -> None:
        layer: Any = self.session.movie_layer
        model = as_written(self.session.model, instrument_of(layer))
        self.session.set_model(model, f"{self.session.model_origin}, with the metadata of {layer.name}")
