"""Layers out: results with scale in µm and units set, added to a viewer in turns."""

from __future__ import annotations

from collections.abc import Generator, Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
from napari.layers import Image, Layer, Points
from napari.viewer import Viewer

from napari_mufasa.files.layers import contrast
from napari_mufasa.files.movies import METADATA_KEY
from napari_mufasa.widgets.turns.gently import gently, room_for, shown_later, without_labels

if TYPE_CHECKING:
    from napari_mufasa.model.model import Model


def plane_of(layer: Layer) -> dict[str, Any]:
    """The place of a result (y, x) that lies on top of a layer."""
    return {key: tuple(getattr(layer, key))[-2:] for key in ("scale", "translate", "units", "axis_labels")}


def space_of(movie: Image, first_frame: int = 0) -> dict[str, Any]:
    """The place of a result (frame, y, x) that begins with a later frame of the movie; a single image gets an axis."""
    scale, translate, units, labels = movie.scale, movie.translate, tuple(movie.units), tuple(movie.axis_labels)
    if movie.ndim == 2:
        scale, translate, units, labels = (1.0, *scale), (0.0, *translate), ("pixel", *units), ("frame", *labels)
    start = float(translate[0] + first_frame * scale[0])
    return {"scale": tuple(scale), "translate": (start, *translate[1:]), "units": units, "axis_labels": labels}


def movie_layer(
    data: Any, name: str, space: dict[str, Any], model: Model | None = None, seed: int | None = None, **options: Any
) -> Image:
    """A movie as an Image layer; contrast from one frame or a few, so that lazy data stay lazy.

    `ours` among the options is kept in ``metadata["napari_mufasa"]``, beside model and seed.
    """
    ours = ({"model": model.to_dict(), "seed": seed} if model is not None else {}) | options.pop("ours", {})
    if "contrast_limits" not in options:
        # Of stored results one frame: each may cost a twentieth of a second, and the interface waits.
        options["contrast_limits"] = contrast(data if isinstance(data, np.ndarray) else data[:1])
    metadata = {METADATA_KEY: ours} if ours else {}
    return Image(data, name=name, metadata=metadata, **({"colormap": "gray"} | space | options))


def points_on(movie: Layer, positions_px: Any, features: Any, name: str, **options: Any) -> Points:
    """A layer of molecules (y, x) in pixels as rings of about a PSF, to lie on top of `movie`."""
    positions = np.asarray(positions_px, dtype=float).reshape(-1, 2)
    metadata = {METADATA_KEY: options.pop("ours", {})}
    return Points(positions, features=features, name=name, metadata=metadata, **(plane_of(movie) | options))


def ours(layer: Layer) -> dict[str, Any]:
    """What the layer carries of a step's results: "traces", "comparison", "report" …"""
    found: dict[str, Any] = layer.metadata[METADATA_KEY]
    return found


def added(viewer: Viewer, layers: Iterable[Layer]) -> Generator[None, None, None]:
    """Add layers to a viewer one after the other; what is drawn of each comes a turn later."""
    for layer in layers:
        shown, layer.visible = layer.visible, False
        if layer.ndim == 3:
            yield from room_for(viewer, layer.data.shape, layer.scale)
        with gently(viewer):
            viewer.add_layer(layer)
        if isinstance(layer, Points):
            without_labels(viewer, layer)
        if shown:
            yield from shown_later(viewer, layer)
        yield


class OwnLayers:
    """Layers of a panel by name, on top of a movie. They are kept and given new data where they can be: napari needs a
    quarter of a second to make one."""

    def __init__(self, viewer: Viewer) -> None:
        self.viewer = viewer
        self._layers: dict[str, Any] = {}

    def get(self, name: str) -> Any:
        """The layer, unless the user has taken it out."""
        layer = self._layers.get(name)
        return layer if layer is not None and layer in self.viewer.layers else None

    def show(self, name: str, new: Any, movie: Image, at: int | None = None) -> bool:
        """Show a layer, at the top or as number `at`, or its values in the one that is there; whether it is new."""
        layer, layers = self.get(name), self.viewer.layers
        if layer is None:
            self._layers[name] = new
            with gently(self.viewer):
                layers.insert(len(layers) if at is None else at, new)
                layers.selection.active = movie
            if isinstance(new, Points):
                without_labels(self.viewer, new)
            return True
        if not np.array_equal(layer.data, new.data):
            layer.data = new.data
        for key in ("name", "scale", "translate", "units", "metadata"):
            setattr(layer, key, getattr(new, key))
        if isinstance(layer, Points):
            layer.features = new.features
            layer.refresh_colors()
        return False

    def remove(self, name: str) -> bool:
        """Take a layer out; whether there was one."""
        layer = self.get(name)
        self._layers.pop(name, None)
        if layer is not None:
            self.viewer.layers.remove(layer)
        return layer is not None
