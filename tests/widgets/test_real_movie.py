"""A real EMCCD movie in the viewer: opened lazily, molecules found, one clicked with the mouse."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from qtpy.QtCore import QPoint, Qt
from tests.real_data import real_data

from napari_mufasa.widgets.turns.session import session_of
from napari_mufasa.widgets.workflow import WorkflowWidget

ROOT = Path(__file__).parents[2]
MODEL = ROOT / "docs" / "models" / "smfret_ixon.json"


def click(viewer, qtbot, points, index):
    """Click a point in the canvas with the mouse."""
    viewer.layers.selection.active = points
    qtbot.wait(300)
    canvas = viewer.window._qt_viewer.canvas
    camera = viewer.scene.camera if hasattr(viewer, "scene") else viewer.camera
    world = points.data_to_world(points.data[index])
    offset = (np.asarray(world[-2:]) - np.asarray(camera.center[-2:])) * camera.zoom
    y, x = np.asarray(canvas.size) / 2 + offset
    qtbot.mouseClick(canvas.native, Qt.MouseButton.LeftButton, pos=QPoint(round(x), round(y)))
    qtbot.wait(100)


@pytest.mark.parametrize("mode", ["select", "pan_zoom"])
def test_mouse_click_shows_the_trace(make_napari_viewer, qtbot, run, bright_model, bright_movie, mode):
    from tests.widgets.helpers import add_movie

    from napari_mufasa.files.layers import movie_space
    from napari_mufasa.widgets.steps.traces import MoleculesPanel

    viewer = make_napari_viewer(strict_qt="raise", show=True)
    layer = add_movie(
        viewer, bright_movie.movie, "bright", movie_space(bright_model.acquisition.pixel_size_nm), bright_model
    )
    session_of(viewer).set_movie(layer)
    session_of(viewer).set_model(bright_model, "test")
    panel = MoleculesPanel(viewer)
    viewer.window.add_dock_widget(panel)
    run(panel)
    panel.points.mode = mode
    for index in (0, 3):
        click(viewer, qtbot, panel.points, index)
        assert panel.shown == index
        assert np.allclose(panel.plot.data["photoelectrons"], panel.traces.all_traces[index])


@pytest.mark.realdata
def test_real_movie_gives_its_molecules(viewer, run, qtbot):
    movie = real_data("smfret_ixon_emccd.tif")
    workflow = WorkflowWidget(viewer)
    viewer.window.add_dock_widget(workflow)
    with qtbot.waitSignal(workflow.step("Data").run_bar.finished, timeout=60_000):
        workflow.step("Data").open_movie(str(movie))
    layer = session_of(viewer).movie_layer
    assert not isinstance(layer.data, np.ndarray)  # stays on disk
    workflow.step("Model").source.value = MODEL
    assert session_of(viewer).model.camera.em_gain == 300
    workflow.step("Data").use_scale.click()
    assert layer.scale[-1] == pytest.approx(0.16)
    panel = workflow.step("Molecules")
    run(panel, timeout=240_000)
    assert int(panel.points.features["kept"].sum()) >= 60
    assert set(panel.points.features.loc[~panel.points.features["kept"], "reason"]) - {""}
