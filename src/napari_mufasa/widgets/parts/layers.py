"""Layers in and out: choosing them, and adding results with scale in µm and units set."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from qtpy.QtCore import Signal  # type: ignore[attr-defined]
from qtpy.QtWidgets import QComboBox, QWidget

from napari_mufasa.files.layers import contrast
from napari_mufasa.files.movies import METADATA_KEY
from napari_mufasa.widgets.turns.gently import gently
from napari_mufasa.widgets.turns.session import stored

if TYPE_CHECKING:
    from napari.layers import Image, Layer, Points
    from napari.viewer import Viewer

    from napari_mufasa.model.model import Model

PLACE = "where the model fails"  # role of layers that show misfit: never a movie


class LayerCombo(QComboBox):
    """A list of the viewer's Image layers that follows the layer list; `None` where "none" is offered."""

    chosen = Signal(object)

    def __init__(self, viewer: Viewer, none_label: str = "", parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._viewer, self._none_label = viewer, none_label
        self._layers: list[Any] = []
        slim(self)
        self.currentIndexChanged.connect(self._on_index)
        events = viewer.layers.events
        for event in (events.inserted, events.removed, events.reordered, events.renamed):
            event.connect(self._refresh)
        self._refresh()

    def layer(self) -> Image | None:
        index = self.currentIndex()
        return self._layers[index] if 0 <= index < len(self._layers) else None

    def choose(self, layer: Image | None) -> None:
        """Select without announcing it."""
        if layer in self._layers:
            blocked = self.blockSignals(True)
            self.setCurrentIndex(self._layers.index(layer))
            self.blockSignals(blocked)

    def _refresh(self, _event: Any = None) -> None:
        try:
            self._fill()
        except RuntimeError:  # the widget is gone, the layer list is not
            self._layers = []

    def _fill(self) -> None:
        from napari.layers import Image

        before = self.layer()
        layers = [layer for layer in self._viewer.layers if isinstance(layer, Image)]
        images = [image for image in layers if stored(image, "role") != PLACE]
        # Dark frames are never the movie.
        self._layers = [image for image in images if self._none_label or stored(image, "role") != "dark frames"]
        names = [layer.name for layer in self._layers]
        if self._none_label:
            self._layers.insert(0, None)
            names.insert(0, self._none_label)
        blocked = self.blockSignals(True)
        self.clear()
        self.addItems(names)
        self.setCurrentIndex(self._layers.index(before) if before in self._layers else 0 if self._layers else -1)
        self.blockSignals(blocked)
        if self.layer() is not before:
            self.chosen.emit(self.layer())

    def _on_index(self, _index: int) -> None:
        self.chosen.emit(self.layer())


def slim(combo: QComboBox) -> None:
    """Let a combo box be narrower than its longest entry: docks are narrow."""
    combo.setMinimumContentsLength(10)
    combo.setSizeAdjustPolicy(QComboBox.SizeAdjustPolicy.AdjustToMinimumContentsLengthWithIcon)


def like(layer: Layer) -> dict[str, Any]:
    """The spatial arrangement of a layer, for results that lie on top of it."""
    return {"scale": tuple(layer.scale), "translate": tuple(layer.translate), "units": layer.units}


def add_movie(viewer: Viewer, data: Any, name: str, space: dict[str, Any], model: Model | None = None,
              seed: int | None = None, role: str = "", **kwargs: Any) -> Image:  # fmt: skip
    """A movie as an Image layer; contrast from one frame or a few, so that lazy data stay lazy."""
    ours: dict[str, Any] = {"model": model.to_dict(), "seed": seed} if model is not None else {}
    ours |= {"role": role} if role else {}
    metadata = {METADATA_KEY: ours} if ours else {}
    options = {"colormap": "gray"} | kwargs
    if "contrast_limits" not in options:
        # Of stored results one frame: each may cost a twentieth of a second, and the interface waits.
        options["contrast_limits"] = contrast(data if isinstance(data, np.ndarray) else data[:1])
    with gently(viewer):
        added: Any = viewer.add_image(data, name=name, metadata=metadata, **space, **options)
    return added


def points_on(movie: Layer, positions_px: Any, features: Any, name: str, **kwargs: Any) -> Points:
    """A layer of molecules (y, x) in pixels as rings of about a PSF, to lie on top of `movie`; not added yet."""
    from napari.layers import Points

    scale, units = tuple(movie.scale[-2:]), tuple(movie.units[-2:])
    positions = np.asarray(positions_px, dtype=float).reshape(-1, 2)
    where: dict[str, Any] = {"scale": scale, "translate": tuple(movie.translate[-2:]), "units": units}
    return Points(positions, features=features, name=name, **where, **kwargs)


def resolution_um(layer: Layer) -> float | None:
    """The pixel size in µm that the layer states, if it states one."""
    size, unit = float(layer.scale[-1]), str(layer.units[-1])
    factor = {"micrometer": 1.0, "um": 1.0, "µm": 1.0, "nanometer": 1e-3, "nm": 1e-3}.get(unit)
    return size * factor if factor is not None else None
