"""What the panels of one viewer share: movie, dark frames, believed model, results.

Every panel works alone; a value set in one is the value of all others, because there is one session per viewer.
"""

from __future__ import annotations

import gc
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
    from napari_mufasa.widgets.turns.live import LiveDistance


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


class Session(QObject):
    """The shared state of one viewer. Signals tell the panels what changed."""

    model_changed = Signal()
    movie_changed = Signal()
    result_changed = Signal(str)

    def __init__(self, viewer: Viewer) -> None:
        super().__init__()
        self._viewer = weakref.ref(viewer)
        viewer.layers.events.removed.connect(lambda _event: gc.unfreeze())  # set aside by a run, see `RunBar`
        self._model: Model | None = None
        self.model_origin = ""
        self._movie: weakref.ref[Image] | None = None
        self._dark: weakref.ref[Image] | None = None
        self.first_dark_frames = 0
        self.results: dict[str, Any] = {}
        self._live: LiveDistance | None = None

    @property
    def live(self) -> LiveDistance:
        """The distance of the model as it is being edited, for whoever shows it."""
        from napari_mufasa.widgets.turns.live import LiveDistance

        if self._live is None:
            self._live = LiveDistance(self)
        return self._live

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

    @property
    def model_chosen(self) -> bool:
        """Whether anyone said which model is believed."""
        return self._model is not None and bool(self.results.get("model chosen"))

    def set_model(self, model: Model, origin: str | None = None) -> None:
        self.results["model chosen"] = True
        if origin is not None:
            self.model_origin = origin
        if self._model is not None and model == self._model and origin is None:
            return
        self._model = model
        self.model_changed.emit()

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

    def set_first_dark_frames(self, n: int) -> None:
        self.first_dark_frames = n
        self.movie_changed.emit()

    def measurement(self) -> Measurement:
        """Movie and dark frames as chosen; raises `MufasaError` that says what to choose."""
        layer = self.movie_layer
        if layer is None:
            raise MufasaError("no movie chosen: open one, or File > Open Sample > MUFASA, then choose it in step Data")
        movie, dark, first = stack_of(layer), None, 0
        if self.dark_layer is not None:
            dark = stack_of(self.dark_layer)
        elif self.first_dark_frames:
            n = self.first_dark_frames
            if n >= len(movie):
                raise MufasaError(
                    f"the first {n} frames are called dark, but {layer.name} has {len(movie)}: give fewer dark frames"
                )
            movie, dark, first = movie[n:], movie[:n], n
        unit: Literal["adu", "photons"] = "photons" if stored(layer, "role") == "photons" else "adu"
        return Measurement(movie, dark, layer.name, unit, first)

    def matching_model(self, movie: Any) -> Model:
        """The believed model with the movie's own number of frames and detector shape."""
        frames, *shape = movie.shape
        model = self.model
        values: dict[str, Any] = {}
        if frames != model.acquisition.n_frames:
            values["acquisition.n_frames"] = int(frames)
        if tuple(shape) != tuple(model.acquisition.shape_px):
            values["acquisition.shape_px"] = tuple(int(n) for n in shape)
        return model.with_values(values) if values else model

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
