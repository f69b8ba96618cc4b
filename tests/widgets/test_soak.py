"""Widgets come and go, viewers are closed while work runs: no thread is left, nothing fails afterwards."""

from __future__ import annotations

import gc
import threading
import time

import pytest
from tests.widgets.helpers import add_movie

from napari_mufasa.widgets.turns.session import session_of

WIDGETS = (
    "Simulate", "Denoise", "Extract traces", "Compare", "Discover", "Calibrate", "Design",
)  # fmt: skip
OPENED = 20


def titles() -> list[str]:
    """The widgets of the manifest, by name."""
    from npe2 import PluginManager

    manifest = PluginManager.instance().get_manifest("napari-mufasa")
    return [widget.display_name for widget in manifest.contributions.widgets]


def threads() -> int:
    """Threads of Python that run; waits until those that end have ended."""
    deadline = time.monotonic() + 20
    before = threading.active_count()
    while time.monotonic() < deadline:
        time.sleep(0.2)
        now = threading.active_count()
        if now == before:
            return now
        before = now
    return before


def test_twenty_widgets_are_opened_and_closed(with_movie, qtbot):
    names = titles()
    assert len(names) >= 5
    counts = []
    for number in range(OPENED):
        dock, _ = with_movie.window.add_plugin_dock_widget("napari-mufasa", names[number % len(names)])
        qtbot.wait(20)
        with_movie.window.remove_dock_widget(dock)
        qtbot.wait(20)
        if number + 1 in (len(names), OPENED):  # each once: what is made once is there
            gc.collect()
            counts.append(threads())
    assert counts[1] <= counts[0]


@pytest.mark.parametrize("moment_s", [0.0, 0.1, 0.5])
def test_a_viewer_is_closed_while_work_runs(make_napari_viewer, bright_model, bright_movie, qtbot, moment_s):
    from napari_mufasa.files.layers import movie_space

    before = threads()
    viewer = make_napari_viewer()
    long = bright_model.with_values({"acquisition.n_frames": 3000})
    layer = add_movie(viewer, bright_movie.movie, "bright", movie_space(100.0), bright_model, 3)
    session = session_of(viewer)
    session.set_movie(layer)
    session.set_model(long, "long")
    _, widget = viewer.window.add_plugin_dock_widget("napari-mufasa", "Simulate")
    panel = getattr(widget, "panel", widget)
    panel.run_bar.run_button.click()
    qtbot.waitUntil(lambda: panel.run_bar.running, timeout=10_000)
    qtbot.wait(int(1000 * moment_s))
    viewer.close()
    qtbot.wait(200)
    gc.collect()
    deadline = time.monotonic() + 60
    while threads() > before and time.monotonic() < deadline:
        qtbot.wait(100)
    assert threads() <= before
