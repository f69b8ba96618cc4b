"""napari makes a layer in one long call; here it is done in turns, while the interface lives on.

napari alone stands still for 0.2 to 0.5 s for a layer (docs/viewer.md has the numbers), and offers no public way to
take that apart. So this module, and no other, reaches into napari where `Inside` says. It does so only in versions
below `NAPARI_BELOW`, in which all that it names was found; in any other, or where a name is missing, layers are added
napari's own way: everything works, and the interface stands still for as long as napari needs.
"""

from __future__ import annotations

import contextlib
from collections.abc import Generator, Iterator
from typing import Any, NamedTuple
from weakref import WeakSet, ref

from napari.layers import Layer, Points
from napari.viewer import Viewer
from qtpy.QtCore import QTimer
from qtpy.QtWidgets import QFrame

NAPARI_BELOW = (0, 10)  # not yet looked at
NEXT_TURN_MS = 5  # less than a run's parts are apart


class Inside(NamedTuple):
    """What of napari is no public interface: the window, the controls of layers, the drawn layers, one event."""

    window: Any
    controls: Any
    drawn: Any
    current: Any  # emitted when the current layer of the selection changes


def inside(viewer: Viewer) -> Inside | None:
    """Where to take hold of a viewer; None where napari is another than the one this was written for."""
    import napari

    try:
        if tuple(int(part) for part in napari.__version__.split(".")[:2]) >= NAPARI_BELOW:
            return None
        window: Any = viewer.window._qt_window
        qt, current = window._qt_viewer, viewer.layers.selection.events._current
        controls = qt.controls
        if not all(hasattr(controls, name) for name in ("_add", "_populate", "widgets", "addWidget")):
            return None
        return Inside(window, controls, qt.canvas.layer_to_visual, current)
    except (AttributeError, ValueError):
        return None


@contextlib.contextmanager
def gently(viewer: Viewer) -> Iterator[None]:
    """Add layers here: who follows the selection is told, their controls and the window's next picture are made when
    the interface had its turn."""
    found = inside(viewer)
    if found is None:
        yield
        return
    controls, waiting = found.controls, list[tuple[Any, QFrame]]()  # events of insertion, with stand-ins for controls
    known = WeakSet(viewer.layers.selection)  # what others know of

    def stand_in(event: Any) -> None:
        frame = QFrame()
        controls.addWidget(frame)
        controls.widgets[event.value] = frame
        waiting.append((event, frame))

    events, inserted = viewer.layers.selection.events, viewer.layers.events.inserted
    found.window.setUpdatesEnabled(False)
    inserted.connect(stand_in)
    try:
        with (
            inserted.blocker(controls._add), events.changed.blocker(), events.active.blocker(),
            found.current.blocker(),
        ):  # fmt: skip
            yield
    finally:
        inserted.disconnect(stand_in)
        # A timer must not keep what is closed.
        _go_on(ref(found.window), _rest(ref(viewer.layers), known, ref(controls), waiting))


def _go_on(window: ref[Any], rest: Iterator[None]) -> None:
    """In the next turn, do the next part of the rest; when there is none, the window is painted again."""

    def turn() -> None:
        found = window()
        if found is None:
            return
        with contextlib.suppress(RuntimeError):  # closed meanwhile
            nothing_left: Any = True  # also where the next part fails
            try:
                nothing_left = next(rest, True)
            finally:
                if nothing_left:
                    found.setUpdatesEnabled(True)
                else:
                    _go_on(window, rest)

    QTimer.singleShot(NEXT_TURN_MS, turn)


def _rest(layers: ref[Any], known: WeakSet[Any], controls: ref[Any], waiting: list[Any]) -> Generator[None, None, None]:
    """What is left to do after layers were added: the selection's change, told in one; the controls of one layer each
    turn, for which empty frames stand in until then."""
    if (found := layers()) is not None:
        selection, before, found = found.selection, set(known), None
        selection.events.changed(added=selection - before, removed=before - selection)
        selection.events._current(value=selection._current)
        selection.events.active(value=selection.active)
        del selection, before
    yield
    for event, frame in waiting:
        panel = controls()
        if panel is not None and panel.widgets.get(event.value) is frame:  # else the layer was taken out meanwhile
            del panel.widgets[event.value]
            try:
                panel._add(event)
            except Exception:
                panel.widgets[event.value] = frame  # napari takes out no layer that has none
                raise
            panel._populate()
            panel.removeWidget(frame)
            frame.deleteLater()
        del panel
        yield


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
    """What vispy draws of a layer; None where it cannot be had."""
    found = inside(viewer)
    return getattr(found.drawn.get(layer), "node", None) if found is not None else None
