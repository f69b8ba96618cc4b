"""napari makes a layer in one long call; here it is done in turns, while the interface lives on."""

from __future__ import annotations

import contextlib
from collections.abc import Generator, Iterator
from typing import TYPE_CHECKING, Any
from weakref import WeakSet, ref

from qtpy.QtCore import QTimer
from qtpy.QtWidgets import QFrame

if TYPE_CHECKING:
    from napari.components import LayerList
    from napari.layers import Layer, Points
    from napari.viewer import Viewer

NEXT_TURN_MS = 5  # less than a run's parts are apart


@contextlib.contextmanager
def gently(viewer: Viewer) -> Iterator[None]:
    """Add layers here: who follows the selection is told, their controls and the window's next picture are made when
    the interface had its turn.

    In napari's own call what draws the layer, the news of its selection, its controls and, with software rendering, its
    first picture follow each other without a break.
    """
    window: Any = getattr(getattr(viewer, "window", None), "_qt_window", None)
    if window is None:  # a viewer without a window
        yield
        return
    rest = _Rest(window, viewer.layers)
    window.setUpdatesEnabled(False)
    try:
        with rest.instead_of_controls(viewer.layers), rest.untold(viewer.layers):
            yield
    finally:
        rest.in_next_turn()


class _Rest:
    """What is left to do after layers were added: until it is done, empty frames stand in for their controls.

    Leaves the controls to napari where they are kept elsewhere than in version 0.9.
    """

    def __init__(self, window: Any, layers: LayerList) -> None:
        self._window, self._layers = ref(window), ref(layers)  # a timer must not keep what is closed
        self._told: WeakSet[Any] | None = WeakSet(layers.selection)  # the selection that others know of; None: all
        self._waiting: list[tuple[Any, QFrame]] = []  # the event of a layer's insertion, and its stand-in

    @property
    def _controls(self) -> Any:
        return getattr(getattr(self._window(), "_qt_viewer", None), "controls", None)

    @contextlib.contextmanager
    def instead_of_controls(self, layers: LayerList) -> Iterator[None]:
        controls, inserted = self._controls, layers.events.inserted
        if not all(hasattr(controls, name) for name in ("_add", "_populate", "widgets")):
            yield
            return
        inserted.connect(self._stand_in)
        try:
            with inserted.blocker(controls._add):
                yield
        finally:
            inserted.disconnect(self._stand_in)

    @contextlib.contextmanager
    def untold(self, layers: LayerList) -> Iterator[None]:
        """The selection changes, and nobody is told."""
        events = layers.selection.events
        with events.changed.blocker(), events.active.blocker(), events._current.blocker():
            yield

    def _tell(self, layers: LayerList) -> None:
        """The selection's change, in one."""
        selection, before = layers.selection, set(self._told or ())
        self._told = None
        selection.events.changed(added=selection - before, removed=before - selection)
        selection.events._current(value=selection._current)
        selection.events.active(value=selection.active)

    def _stand_in(self, event: Any) -> None:
        frame, controls = QFrame(), self._controls
        controls.addWidget(frame)
        controls.widgets[event.value] = frame
        self._waiting.append((event, frame))

    def in_next_turn(self) -> None:
        QTimer.singleShot(NEXT_TURN_MS, lambda: self._go_on())  # Qt would hold the method alone weakly

    def _go_on(self) -> None:
        """The selection, the controls of one layer each turn, then the picture."""
        window, layers = self._window(), self._layers()
        with contextlib.suppress(RuntimeError):  # closed meanwhile
            if window is not None and layers is not None and self._told is not None:
                self._tell(layers)
                self.in_next_turn()
            elif window is not None and self._waiting:
                self._replace(*self._waiting.pop(0))
                self.in_next_turn()
            elif window is not None:
                window.setUpdatesEnabled(True)

    def _replace(self, event: Any, frame: QFrame) -> None:
        layer, controls = event.value, self._controls
        if controls.widgets.get(layer) is not frame:  # the layer was taken out meanwhile
            return
        del controls.widgets[layer]
        controls._add(event)
        controls._populate()
        controls.removeWidget(frame)
        frame.deleteLater()


def room_for(viewer: Viewer, shape: tuple[int, ...], scale: Any = None) -> Generator[None, None, None]:
    """Give an empty viewer the sliders of a first layer before it comes; napari would make all in one go."""
    if len(viewer.layers) or viewer.dims.ndim >= len(shape):
        return
    with gently(viewer):
        viewer.dims.ndim = len(shape)
    yield
    steps = scale if scale is not None else (1,) * len(shape)
    with gently(viewer):
        viewer.dims.range = tuple((0, (n - 1) * float(step), float(step)) for n, step in zip(shape, steps, strict=True))
    yield


def shown_later(viewer: Viewer, layer: Layer) -> Generator[None, None, None]:
    """Draw a layer that was added hidden, once the window has drawn what came with it: napari reads the frame in view,
    and the layer's first picture follows a turn later."""
    yield
    node = _drawn(viewer, layer)
    layer.visible = True
    if node is None:
        return
    node.visible = False
    try:
        yield
    finally:  # also when the run is dropped half-way; the user may have hidden the layer meanwhile
        node.visible = layer.visible
    yield


def without_labels(viewer: Viewer, points: Points) -> None:
    """Leave out the labels of a new layer of points for as long as it has none.

    napari draws an empty one, whose first picture takes longer than that of all the points.
    """
    labels = getattr(_drawn(viewer, points), "text", None)
    if labels is None or getattr(points.text.string, "constant", None) != "":
        return
    labels.visible, known = False, ref(labels)

    def show() -> None:
        if (labels := known()) is not None:
            labels.visible = True

    points.text.events.connect(show)


def _drawn(viewer: Viewer, layer: Layer) -> Any:
    """What vispy draws of a layer; None when there is no window or napari keeps it elsewhere."""
    with contextlib.suppress(AttributeError, KeyError):
        window: Any = viewer.window._qt_viewer
        return window.canvas.layer_to_visual[layer].node
    return None
