"""What the panels of one viewer share: movie, dark frames, believed model, results.

Every panel works alone; a value set in one is the value of all others, because there is one session per viewer.
"""

from __future__ import annotations

import weakref
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal
from weakref import WeakKeyDictionary

import numpy as np
from qtpy.QtCore import QObject, Signal  # type: ignore[attr-defined]

from napari_mufasa.errors import MufasaError
from napari_mufasa.files.movies import METADATA_KEY

if TYPE_CHECKING:
    from napari.layers import Image, Layer
    from napari.viewer import Viewer

    from napari_mufasa.model.model import Model


@dataclass(frozen=True)
class Measurement:
    """What was recorded: `movie` and `dark` (frame, y, x) as stored in the layers, possibly lazy; `name` for titles.

    `unit` is "adu" for what a camera recorded, "photons" for a movie that was denoised. `first_frame` is the layer's
    frame that `movie` begins with: dark frames before it are cut off.
    """

    movie: Any
    dark: Any
    name: str
    unit: Literal["adu", "photons"] = "adu"
    first_frame: int = 0

    def recorded(self) -> Measurement:
        """Itself; raises `MufasaError` when it is not what a camera recorded."""
        if self.unit != "adu":
            raise MufasaError(f"{self.name} holds photons, not camera counts: choose the recorded movie in step Data")
        return self


def measurement_of(movie: Image | None, dark: Image | None = None, dark_frames: int = 0) -> Measurement:
    """What layers hold as a measurement; raises `MufasaError` that says what to choose.

    dark : a layer of dark frames; dark_frames : or how many frames of the movie are dark, at its beginning
    """
    if movie is None:
        raise MufasaError("no movie chosen: open one, or File > Open Sample > MUFASA, then choose it in step Data")
    stack, frames, first = stack_of(movie), None, 0
    if dark is not None:
        frames = stack_of(dark)
    elif dark_frames:
        first = dark_frames
        if first >= len(stack):
            raise MufasaError(
                f"the first {first} frames are called dark, but {movie.name} has {len(stack)}: give fewer dark frames"
            )
        stack, frames = stack[first:], stack[:first]
    unit: Literal["adu", "photons"] = "photons" if stored(movie, "role") == "photons" else "adu"
    return Measurement(stack, frames, movie.name, unit, first)


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
    result_changed = Signal(str)

    def __init__(self, viewer: Viewer | None = None) -> None:
        super().__init__()
        self._viewer = weakref.ref(viewer) if viewer is not None else lambda: None
        self.has_viewer = viewer is not None
        self._model: Model | None = None
        self.model_origin = ""
        self.model_chosen = False  # whether anyone said which model is believed
        self._movie: weakref.ref[Image] | None = None
        self._dark: weakref.ref[Image] | None = None
        self.dark_frames = 0
        self.results: dict[str, Any] = {}

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
            from napari_mufasa.model.presets import preset

            self._model, self.model_origin = preset("FF"), "preset FF"
        return self._model

    def set_model(self, model: Model, origin: str | None = None) -> None:
        self.model_chosen = True
        if origin is not None:
            self.model_origin = origin
        if self._model is not None and model == self._model and origin is None:
            return
        self._model = model
        self.model_changed.emit()

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
        return self._alive(self._movie)

    @property
    def dark_layer(self) -> Image | None:
        return self._alive(self._dark)

    def set_movie(self, layer: Image | None) -> None:
        if layer is self.movie_layer and layer is not None:
            return
        self._movie = weakref.ref(layer) if layer is not None else None
        dark = self.viewer.layers[name] if (name := stored(layer, "dark_layer")) in self.viewer.layers else None
        if dark is not None:
            self._dark = weakref.ref(dark)
        elif (
            layer is not None
            and self.dark_layer is not None
            and self.dark_layer.data.shape[-2:] != layer.data.shape[-2:]
        ):
            self._dark = None  # another movie's dark frames
        self.movie_changed.emit()

    def set_dark(self, layer: Image | None) -> None:
        self._dark = weakref.ref(layer) if layer is not None else None
        self.movie_changed.emit()

    def set_dark_frames(self, n: int) -> None:
        self.dark_frames = n
        self.movie_changed.emit()

    def measurement(self) -> Measurement:
        """Movie and dark frames as chosen; raises `MufasaError` that says what to choose."""
        return measurement_of(self.movie_layer, self.dark_layer, self.dark_frames)

    def set_result(self, name: str, value: Any) -> None:
        self.results[name] = value
        self.result_changed.emit(name)

    def _alive(self, reference: weakref.ref[Image] | None) -> Image | None:
        layer = reference() if reference is not None else None
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


def stack_of(layer: Image) -> Any:
    """The layer's data as (frame, y, x), never copied; raises `MufasaError` when it is no movie."""
    data = layer.data
    if getattr(layer, "multiscale", False):
        data = data[0]
    if getattr(layer, "rgb", False) or data.ndim not in (2, 3):
        raise MufasaError(
            f"layer {layer.name} has shape {tuple(data.shape)}: a movie is (frame, y, x); choose another layer"
        )
    return data if data.ndim == 3 else data[np.newaxis]


def stored(layer: Layer | None, key: str) -> Any:
    """What the layer's metadata say of us: `model`, `seed`, `role` ("dark frames", "photons" …), `dark_layer`."""
    ours = layer.metadata.get(METADATA_KEY) if layer is not None else None
    return ours.get(key) if isinstance(ours, dict) else None


def model_in(layer: Layer) -> Model | None:
    """The model that travelled in the layer's metadata, if any."""
    from napari_mufasa.model.model import Model

    model = stored(layer, "model")
    if model is None:
        return None
    return model if isinstance(model, Model) else Model.from_dict(model)
