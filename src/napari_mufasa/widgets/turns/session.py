"""What the panels of one viewer share: movie, dark frames, believed model, results.

Every panel works alone; a value set in one is the value of all others, because there is one session per viewer.
"""

from __future__ import annotations

import weakref
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary, WeakValueDictionary

from napari.layers import Image, Layer
from napari.viewer import Viewer
from qtpy.QtCore import QObject, Signal  # type: ignore[attr-defined]

from napari_mufasa.errors import MufasaError
from napari_mufasa.files.layers import Measurement, measurement_of, stored
from napari_mufasa.model.model import Model
from napari_mufasa.model.presets import preset

if TYPE_CHECKING:
    from napari_mufasa.traces import TraceSet


def believed(model: Model | None, movie: Image | None = None) -> Model:
    """The model given, or the one in the movie's metadata; raises `MufasaError` where there is neither."""
    found = model if model is not None else model_in(movie) if movie is not None else None
    if found is None:
        where = f"layer {movie.name}" if movie is not None else "no movie is chosen, so it"
        raise MufasaError(f"{where} carries no model: choose a preset or a model.json")
    return found


class Session(QObject):
    """The shared state of one viewer, or of a form by itself. Signals tell the panels what changed."""

    model_changed = Signal()
    movie_changed = Signal()
    traces_changed = Signal()
    channels_changed = Signal()

    def __init__(self, viewer: Viewer | None = None) -> None:
        super().__init__()
        self._viewer = weakref.ref(viewer) if viewer is not None else lambda: None
        self.has_viewer = viewer is not None
        self._model: Model | None = None
        self.model_origin = ""
        self.model_chosen = False  # whether anyone said which model is believed
        self._layers: WeakValueDictionary[str, Image] = WeakValueDictionary()
        self.dark_frames = 0
        self.traces: TraceSet | None = None  # the last ones read of the movie
        self.channels: Any = None  # `Channels`, where two were registered

    @property
    def viewer(self) -> Viewer:
        viewer = self._viewer()
        if viewer is None:
            raise MufasaError("the viewer was closed")
        return viewer

    # the believed model ---------------------------------------------------------------------------
    @property
    def model(self) -> Model:
        """The believed model; the FF preset until one is chosen."""
        if self._model is None:
            self._model, self.model_origin = preset("FF"), "preset FF"
        return self._model

    def set_model(self, model: Model, origin: str | None = None) -> None:
        self.model_chosen = True
        if origin is not None:
            self.model_origin = origin
        elif model == self._model:
            return
        self._model = model
        self.model_changed.emit()

    def change_model(self, model: Model, how: str) -> None:
        """Believe a model that was made of the present one; its origin says once how."""
        self.set_model(model, f"{self.model_origin.removesuffix(f' ({how})')} ({how})")

    def forget_model(self) -> None:
        """As if none had been chosen."""
        self._model, self.model_origin, self.model_chosen = None, "", False
        self.model_changed.emit()

    def take_model_of_movie(self) -> None:
        """Believe the model in the movie's metadata; raises `MufasaError` where there is none."""
        layer = self.movie_layer
        model = believed(None, layer)
        self.set_model(model, f"metadata of {layer.name if layer is not None else 'the movie'}")

    # the measurement ------------------------------------------------------------------------------
    @property
    def movie_layer(self) -> Image | None:
        return self._layer("movie")

    @property
    def dark_layer(self) -> Image | None:
        return self._layer("dark")

    def set_movie(self, layer: Image | None) -> None:
        if layer is not None and layer is self.movie_layer:
            return
        self._keep("movie", layer)
        self.dark_frames = 0  # were another movie's
        layers, dark = self.viewer.layers, self.dark_layer
        if (name := stored(layer, "dark_layer")) in layers:
            self._keep("dark", layers[name])
        elif layer is not None and dark is not None and dark.data.shape[-2:] != layer.data.shape[-2:]:
            self._keep("dark", None)  # another movie's
        self.movie_changed.emit()
        if self.traces is not None and layer is not None:  # they are another movie's, too
            self._take_traces(None)

    def set_dark(self, layer: Image | None) -> None:
        self._keep("dark", layer)
        self.movie_changed.emit()

    def set_dark_frames(self, n: int) -> None:
        self.dark_frames = n
        self.movie_changed.emit()

    def measurement(self) -> Measurement:
        """Movie and dark frames as chosen; raises `MufasaError` that says what to choose."""
        return measurement_of(self.movie_layer, self.dark_layer, self.dark_frames)

    def set_traces(self, traces: TraceSet, movie: Layer | None) -> None:
        """Those of a movie; ignored where another one has been chosen since they were asked for."""
        if movie is not None and movie is self.movie_layer:
            self._take_traces(traces)

    def _take_traces(self, traces: TraceSet | None) -> None:
        self.traces = traces
        self.traces_changed.emit()

    def set_channels(self, channels: Any) -> None:
        """The channels of an image splitter, registered; None: there is one channel."""
        self.channels = channels
        self.channels_changed.emit()

    def _keep(self, name: str, layer: Image | None) -> None:
        self._layers.pop(name, None)
        if layer is not None:
            self._layers[name] = layer

    def _layer(self, name: str) -> Image | None:
        """The layer chosen, unless it was taken out of the viewer."""
        layer = self._layers.get(name)
        return layer if layer is not None and layer in self.viewer.layers else None


_SESSIONS: WeakKeyDictionary[Any, Session] = WeakKeyDictionary()


def unwrapped(viewer: Viewer) -> Viewer:
    """The viewer itself: napari hands plugins a proxy, whose layers are new proxies at every look."""
    found: Viewer = getattr(viewer, "__wrapped__", viewer)
    return found


def session_of(viewer: Viewer) -> Session:
    """The one session of a viewer."""
    viewer = unwrapped(viewer)
    if viewer not in _SESSIONS:
        _SESSIONS[viewer] = Session(viewer)
    return _SESSIONS[viewer]


def model_in(layer: Layer) -> Model | None:
    """The model that travelled in the layer's metadata, if any."""
    model = stored(layer, "model")
    if model is None:
        return None
    return model if isinstance(model, Model) else Model.from_dict(model)
