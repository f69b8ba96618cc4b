"""Background work: it reports, stops at once, tells errors, and survives what users do meanwhile."""

from __future__ import annotations

import gc
import os
import sys
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from napari.utils.notifications import notification_manager
from qtpy.QtWidgets import QFrame

from napari_mufasa.errors import Cancelled, MufasaError
from napari_mufasa.widgets.steps.compare import ComparePanel
from napari_mufasa.widgets.steps.denoise import DenoisePanel
from napari_mufasa.widgets.steps.discover import DiscoverPanel
from napari_mufasa.widgets.steps.traces import MoleculesPanel
from napari_mufasa.widgets.turns.jobs import RunBar
from napari_mufasa.widgets.turns.steering import steering


@pytest.fixture
def bar(viewer):
    made = RunBar("Go")
    viewer.window.add_dock_widget(made)
    return made


def test_result_arrives_in_the_interface_thread(bar, qtbot):
    seen = []

    def work():
        progress, _ = steering()
        for i in range(10):
            progress(i + 1, 10)
        return threading.current_thread()

    with qtbot.waitSignal(bar.finished, timeout=5000):
        bar.start("Working", work, lambda thread: seen.append((thread, threading.current_thread())))
    assert seen[0][0] is not threading.main_thread()
    assert seen[0][1] is threading.main_thread()
    assert bar.bar.value() == 10


def test_a_first_compilation_is_told(bar, qtbot):
    from numba import njit

    def work():
        njit(lambda x: x + 1)(2)  # anew in every process
        compiled.set()
        assert go_on.wait(10)
        steering()[0](1, 2)
        assert end.wait(10)

    compiled, go_on, end = threading.Event(), threading.Event(), threading.Event()
    with qtbot.waitSignal(bar.finished, timeout=20_000):
        bar.start("Working", work, lambda _: None)
        qtbot.waitUntil(compiled.is_set, timeout=10_000)
        qtbot.waitUntil(lambda: bar.message.text() == "Working … (compiling, once for this machine)", timeout=5000)
        go_on.set()
        qtbot.waitUntil(lambda: bar.message.text() == "Working …", timeout=5000)
        end.set()
    assert bar.message.text() == ""


@pytest.mark.parametrize("polite", [True, False], ids=["work that looks at cancel", "work that does not"])
def test_cancel_frees_the_panel_within_a_second(bar, qtbot, polite):
    done, stopped, release = [], threading.Event(), threading.Event()

    def work():
        progress, cancel = steering()
        progress(1, 100)
        while not release.wait(0.01):
            if polite and cancel():
                stopped.set()
                raise Cancelled
        stopped.set()
        return 1

    bar.start("Working", work, done.append)
    qtbot.wait(200)
    start = time.monotonic()
    with qtbot.waitSignal(bar.finished, timeout=5000):
        bar.cancel_button.click()
    assert time.monotonic() - start < 1.0
    assert not bar.running
    assert bar.run_button.isEnabled()
    assert bar.message.text() == "Cancelled."
    release.set()
    assert stopped.wait(2)
    qtbot.wait(100)
    assert done == []  # a result that comes after Cancel is thrown away


def test_interface_has_its_turn_between_the_parts_of_a_result(bar, qtbot):
    from qtpy.QtCore import QTimer

    beats, parts, ended = [], [], []
    heart = QTimer(bar)
    heart.timeout.connect(lambda: beats.append(bar.running))
    heart.start(1)
    bar.finished.connect(lambda: ended.append(len(parts)))

    def done(value):
        for _part in range(value):
            parts.append(len(beats))
            yield

    with qtbot.waitSignal(bar.finished, timeout=5000):
        bar.start("Working", lambda: 4, done)
    heart.stop()
    assert ended == [4] and not bar.running
    assert min(np.diff(parts)) >= 1  # the event loop had a turn after each
    assert all(beats[parts[0] : parts[-1]])  # the run is not over before its last part


def test_error_in_a_part_of_the_result_is_told_and_ends_the_run(bar, qtbot):
    def done(value):
        yield
        raise MufasaError("layer x was removed: open it again")

    with qtbot.waitSignal(bar.finished, timeout=5000):
        bar.start("Working", lambda: 1, done)
    assert "open it again" in bar.message.text() and bar.run_button.isEnabled() and not bar.running


def test_window_is_painted_again_after_a_layer_came(viewer, qtbot):
    from napari_mufasa.widgets.turns.gently import gently, room_for

    window = viewer.window._qt_window
    list(room_for(viewer, (9, 32, 48), (1, 0.1, 0.1)))
    assert viewer.dims.ndim == 3 and viewer.dims.nsteps == (9, 32, 48)
    with gently(viewer):
        assert not window.updatesEnabled()
        layer = viewer.add_image(np.zeros((9, 32, 48)), scale=(1, 0.1, 0.1), contrast_limits=(0, 1))
    qtbot.waitUntil(window.updatesEnabled, timeout=2000)
    with pytest.raises(ZeroDivisionError), gently(viewer):
        1 / 0  # noqa: B018
    qtbot.waitUntil(window.updatesEnabled, timeout=2000)
    list(room_for(viewer, (2, 3, 4, 5)))  # not empty any more: nothing is changed
    assert viewer.dims.ndim == 3 and layer in viewer.layers


def test_controls_of_a_layer_come_in_a_later_turn(viewer, qtbot):
    """Until then an empty frame stands in, which napari may show, and take away with its layer."""
    from napari.layers import Points

    from napari_mufasa.widgets.turns.gently import gently

    controls = viewer.window._qt_viewer.controls
    with gently(viewer):
        image = viewer.add_image(np.zeros((32, 48)), contrast_limits=(0, 1))
        points = viewer.add_layer(Points(np.zeros((1, 2))))
        gone = viewer.add_points(np.zeros((1, 2)))
    assert viewer.layers.selection.active is gone
    assert type(controls.widgets[image]) is type(controls.currentWidget()) is QFrame
    viewer.layers.remove(gone)
    viewer.layers.selection.active = points
    qtbot.waitUntil(viewer.window._qt_window.updatesEnabled, timeout=2000)
    assert set(controls.widgets) == {image, points}
    assert type(controls.widgets[image]).__name__ == "QtImageControls"
    assert controls.currentWidget() is controls.widgets[points]
    assert type(controls.currentWidget()).__name__ == "QtPointsControls"
    frames = [widget for at in range(controls.count()) if type(widget := controls.widget(at)) is QFrame]
    assert frames == [controls.empty_widget]  # no stand-in is left
    usual = viewer.add_image(np.zeros((32, 48)), contrast_limits=(0, 1))  # napari's own way is as it was
    assert controls.currentWidget() is controls.widgets[usual]
    assert type(controls.widgets[usual]).__name__ == "QtImageControls"


def test_controls_that_napari_cannot_make_leave_a_window_that_lives_and_a_layer_that_can_go(viewer, qtbot, monkeypatch):
    from napari_mufasa.widgets.turns.gently import gently

    window, controls = viewer.window._qt_window, viewer.window._qt_viewer.controls

    def fails(self, event):
        raise ValueError("no controls")

    with qtbot.capture_exceptions() as raised, monkeypatch.context() as patch:
        with gently(viewer):
            layer = viewer.add_image(np.zeros((32, 48)), contrast_limits=(0, 1))
            patch.setattr(type(controls), "_add", fails)
        qtbot.waitUntil(window.updatesEnabled, timeout=2000)
    assert [str(error) for _, error, _ in raised] == ["no controls"]
    raised.clear()
    sys.last_value = sys.last_traceback = sys.last_exc = None  # they hold the viewer
    viewer.layers.remove(layer)
    assert not viewer.layers and not controls.widgets


def test_the_selection_of_layers_added_is_told_once_and_in_a_later_turn(viewer, qtbot):
    """Who follows it then knows what it would know without us: napari's list of layers, and its viewer."""
    from napari_mufasa.widgets.turns.gently import gently

    first = viewer.add_image(np.zeros((32, 48)), contrast_limits=(0, 1))
    told = []
    viewer.layers.selection.events.changed.connect(lambda event: told.append((set(event.added), set(event.removed))))
    viewer.layers.selection.events.active.connect(lambda event: told.append(event.value))
    with gently(viewer):
        gone = viewer.add_points(np.zeros((1, 2)))
        last = viewer.add_points(np.zeros((1, 2)))
    assert viewer.layers.selection.active is last and not told
    qtbot.waitUntil(viewer.window._qt_window.updatesEnabled, timeout=2000)
    assert told == [({last}, {first}), last] and gone not in viewer.layers.selection
    rows = viewer.window._qt_viewer.layers
    assert [index.row() for index in rows.selectionModel().selectedIndexes()] == [0]  # the list shows the last on top
    assert viewer.help == last.help
    told.clear()
    viewer.layers.selection.active = first  # napari's own way is as it was
    assert first in told


def test_viewer_may_close_before_the_controls_came(viewer):
    """What is still to be done holds nothing of it: make_napari_viewer fails a test that leaves a viewer behind."""
    from napari_mufasa.widgets.turns.gently import gently

    with gently(viewer):
        layer = viewer.add_image(np.zeros((32, 48)), contrast_limits=(0, 1))
    assert type(viewer.window._qt_viewer.controls.widgets[layer]) is QFrame
    gc.freeze()  # reference counts alone


def drawn(viewer, layer):
    return viewer.window._qt_viewer.canvas.layer_to_visual[layer].node


@pytest.mark.parametrize("kind", ["image", "points"])
def test_a_layer_hidden_while_it_is_shown_in_turns_stays_hidden(viewer, kind):
    from napari.layers import Image, Points

    from napari_mufasa.widgets.turns.gently import shown_later

    layer = Image(np.eye(9), visible=False) if kind == "image" else Points(np.eye(2), visible=False)
    viewer.add_layer(layer)
    turns = shown_later(viewer, layer)
    next(turns)
    next(turns)  # visible for the viewer, but nothing of it is drawn yet
    assert layer.visible and not drawn(viewer, layer).visible
    layer.visible = False
    list(turns)
    assert not drawn(viewer, layer).visible
    layer.visible = True
    assert drawn(viewer, layer).visible


def test_points_draw_labels_once_they_have_any(viewer):
    from napari_mufasa.widgets.turns.gently import without_labels

    plain = viewer.add_points(np.eye(2), features={"name": ["one", "two"]})
    labelled = viewer.add_points(np.eye(2), text=["one", "two"])
    for layer in (plain, labelled):
        without_labels(viewer, layer)
    assert not drawn(viewer, plain).text.visible and drawn(viewer, labelled).text.visible
    plain.text = "name"
    assert drawn(viewer, plain).text.visible and list(drawn(viewer, plain).text.text) == ["one", "two"]


def test_error_is_a_notification_with_its_remedy(bar, qtbot):
    def work():
        raise MufasaError("em_gain = -1: give 1 … 100000")

    with qtbot.waitSignal(bar.finished, timeout=5000):
        bar.start("Working", work, lambda _: None)
    assert notification_manager.records[-1].message == "em_gain = -1: give 1 … 100000"
    assert "give 1" in bar.message.text()


def test_a_run_changes_nothing_of_python_or_of_the_system(bar, qtbot):
    """A plugin is a guest: what napari and other plugins rely on is as it was, during a run and after it."""

    def state():
        return (
            sys.getswitchinterval(),
            gc.get_freeze_count(),
            gc.get_threshold(),
            gc.isenabled(),
            os.getpriority(os.PRIO_PROCESS, 0),
        )

    def work():
        return state(), os.getpriority(os.PRIO_PROCESS, threading.get_native_id())

    before, found = state(), []
    with qtbot.waitSignal(bar.finished, timeout=5000):
        bar.start("Working", work, found.append)
    assert found[0] == (before, before[-1]) and state() == before


@pytest.mark.parametrize("version", ["the bound", "unknown"])
def test_another_napari_adds_layers_its_own_way(with_movie, qtbot, run, monkeypatch, version):
    """`NAPARI_BELOW` is the first version that nobody has looked into: its private names may mean something else."""
    import napari

    from napari_mufasa.widgets.turns import gently as module

    window = with_movie.window._qt_window
    qtbot.waitUntil(window.updatesEnabled, timeout=2000)
    assert module.inside(with_movie) is not None  # the one installed is known
    bound = ".".join(str(n) for n in module.NAPARI_BELOW) + ".0"
    monkeypatch.setattr(napari, "__version__", bound if version == "the bound" else version)
    assert module.inside(with_movie) is None
    with module.gently(with_movie):
        layer = with_movie.add_image(np.zeros((9, 32, 48)), contrast_limits=(0, 1))
        assert window.updatesEnabled()
        assert type(with_movie.window._qt_viewer.controls.widgets[layer]).__name__ == "QtImageControls"
    with_movie.layers.remove(layer)
    panel = MoleculesPanel(with_movie)
    with_movie.window.add_dock_widget(panel)
    run(panel)
    assert panel.points in with_movie.layers and panel.points.visible
    panel.points.selected_data = {1}
    assert panel.shown == 1


@pytest.mark.parametrize("missing", ["_qt_window", "_qt_viewer", "controls", "_add", "layer_to_visual"])
def test_a_private_name_that_is_gone_is_done_without(viewer, missing):
    from napari_mufasa.widgets.turns import gently as module

    names = {"_add": 1, "_populate": 1, "widgets": 1, "addWidget": 1}
    names.pop(missing, None)
    canvas = SimpleNamespace() if missing == "layer_to_visual" else SimpleNamespace(layer_to_visual={})
    parts = {"controls": SimpleNamespace(**names), "canvas": canvas}
    parts.pop(missing, None)
    window = SimpleNamespace(**({} if missing == "_qt_viewer" else {"_qt_viewer": SimpleNamespace(**parts)}))
    outer = SimpleNamespace(**({} if missing == "_qt_window" else {"_qt_window": window}))
    other = SimpleNamespace(window=outer, layers=viewer.layers)
    assert module.inside(other) is None
    with module.gently(other):
        viewer.add_image(np.zeros((4, 4)), contrast_limits=(0, 1))
    assert len(viewer.layers) == 1 and module._drawn(other, viewer.layers[0]) is None


def test_layer_deleted_mid_run_does_not_matter(with_movie, qtbot, bright_movie):
    panel = DenoisePanel(with_movie)
    with_movie.window.add_dock_widget(panel)
    with qtbot.waitSignal(panel.run_bar.finished, timeout=240_000):
        panel.run_bar.run_button.click()
        with_movie.layers.clear()
    assert [layer.name for layer in with_movie.layers] == ["bright, photons"]
    assert panel.session.movie_layer is None or panel.session.movie_layer in with_movie.layers


@pytest.mark.parametrize("kind", [MoleculesPanel, ComparePanel, DiscoverPanel])
def test_layers_deleted_mid_run_never_crash_a_step(with_movie, qtbot, kind):
    panel = kind(with_movie)
    with_movie.window.add_dock_widget(panel)
    panel.run_bar.run_button.click()
    assert panel.run_bar.running
    with_movie.layers.clear()
    qtbot.wait(300)
    start = time.monotonic()
    if kind is DiscoverPanel:  # its run is long: cancelled, with its movie gone
        with qtbot.waitSignal(panel.run_bar.finished, timeout=5000):
            panel.run_bar.cancel_button.click()
        assert time.monotonic() - start < 1.0
        return
    qtbot.waitUntil(lambda: not panel.run_bar.running, timeout=60_000)
    assert len(with_movie.layers) == 0
    if kind is MoleculesPanel:
        assert "was removed" in panel.run_bar.message.text()
    else:
        assert panel.comparison is not None


def test_dock_closed_mid_run_does_not_matter(with_movie, qtbot):
    panel = DenoisePanel(with_movie)
    dock = with_movie.window.add_dock_widget(panel)
    panel.run_bar.run_button.click()
    worker = panel.run_bar._worker
    with qtbot.waitSignal(worker.finished, timeout=60_000):
        with_movie.window.remove_dock_widget(dock)
        panel.deleteLater()
    qtbot.wait(100)
    with_movie.add_image(np.zeros((4, 4)))  # the layer list still works
