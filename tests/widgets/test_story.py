"""The whole conversation with the real widgets: open the hidden-effect sample, … find the effect, add it, see the error
at its floor. Clicks and values only; about a minute."""

from __future__ import annotations

import json

import numpy as np
import pytest
from qtpy.QtCore import Qt

from napari_mufasa.model.model import Model
from napari_mufasa.widgets.parts.findings import CLICK
from napari_mufasa.widgets.turns.session import session_of
from napari_mufasa.widgets.workflow import STEPS

AT_FLOOR = 1.25  # held-out error over its floor; the base model's is more than twice the floor


@pytest.mark.slow
def test_hidden_effect_from_open_sample_to_the_floor(viewer, run, qtbot, tmp_path):
    from napari_mufasa.samples import hidden_effect

    _, workflow = viewer.window.add_plugin_dock_widget("napari-mufasa", "MUFASA workflow")
    session = session_of(viewer)

    # 1 Data: the sample brings its believed model and its dark frames
    data = workflow.step("Data")
    data.sample.value = "hidden_effect"
    with qtbot.waitSignal(data.run_bar.finished, timeout=900_000):
        data.sample_button.click()
    movie = session.movie_layer
    assert movie.name == "hidden effect" and session.dark_layer is not None
    believed = session.model
    assert believed.effects == ()

    # 2 Camera: what is set here holds in every later step
    step(workflow, "Camera")
    assert workflow.step("Camera").editor.form["em_gain"].value == 300

    # 3 Denoise
    step(workflow, "Denoise")
    denoise = workflow.step("Denoise")
    run(denoise, timeout=600_000)
    photons = viewer.layers["hidden effect, photons"]
    assert photons.data.shape == movie.data.shape
    viewer.layers.remove(photons)

    # 4 Molecules: the simulated movie has 40
    step(workflow, "Molecules")
    molecules = workflow.step("Molecules")
    run(molecules, timeout=600_000)
    assert 25 <= int(molecules.points.features["kept"].sum()) <= 42
    molecules.points.selected_data = {3}
    assert np.allclose(molecules.plot.data["photoelectrons"], molecules.traces.all_traces[3])

    # 5 Model: every parameter is there, nothing is changed
    step(workflow, "Model")
    assert workflow.step("Model").parts["excitation"].form["wavelength_nm"].value == 488
    assert session.model == believed

    # 6 Compare: the believed model is nearer than the two-state model
    step(workflow, "Compare")
    compare = workflow.step("Compare")
    compare.form.fit.value = False
    run(compare, timeout=600_000)
    assert compare.comparison.w1["mufasa"] < compare.comparison.w1["sofi"]

    # 7 Discover: among a few suspects
    step(workflow, "Discover")
    panel = workflow.step("Discover")
    truth = hidden_effect().kind
    choose_suspects(panel, {truth, "laser_drift"})
    run(panel, timeout=900_000)
    best = panel.what.ranking.item(0, 0).data(Qt.ItemDataRole.UserRole)
    assert best == truth

    # where it fails: a click shows the observable measured and simulated, and its place in the image
    places = set()
    assert panel.where.place.text() == CLICK
    for row in range(panel.where.failing.rowCount()):
        panel.where.failing.selectRow(row)
        panel.where.failing.cellClicked.emit(row, 0)
        assert panel.where.curve.drawn
        shown = [layer.name for layer in viewer.layers if layer.name.startswith("where: ") and layer.visible]
        assert len(shown) <= 1  # the place of the observable that is chosen, and no other
        told = panel.where.place.text()
        assert told not in ("", CLICK) and (not shown or shown[0] in told)
        places.update(shown)
    assert places
    panel.where.in_image.setChecked(False)
    assert not any(layer.name.startswith("where: ") and layer.visible for layer in viewer.layers)

    # add it: the error falls to its floor, the model's movie appears beside the measured one
    panel.tabs.setCurrentWidget(panel.what)
    with qtbot.waitSignal(panel.run_bar.finished, timeout=900_000):
        panel.what.add_button.click()
    error = panel.report.error
    assert error["before"] > 1.5 * error["floor"]
    assert error["after"] < AT_FLOOR * error["floor"]
    assert [effect.kind for effect in session.model.effects] == [truth]
    assert [row["error"] for row in panel.report.history] == list(panel.history.data["error"])
    simulated = panel.layers.simulated
    assert simulated in viewer.layers and simulated.data.shape == movie.data.shape

    # export, undo
    panel.export(str(tmp_path))
    told = json.loads((tmp_path / "report.json").read_text())
    assert told["chosen"] == [truth]
    assert Model.from_json(tmp_path / "model.json") == session.model
    panel.what.undo_button.click()
    assert session.model.effects == ()
    assert simulated not in viewer.layers
    assert not panel.what.undo_button.isEnabled()


def step(workflow, name):
    workflow.tabs.setCurrentIndex(STEPS.index(name))
    assert workflow.step(name).isVisibleTo(workflow)


def choose_suspects(panel, kinds):
    panel.suspects.none_button.click()
    for row in range(panel.suspects.list.count()):
        item = panel.suspects.list.item(row)
        if item.data(Qt.ItemDataRole.UserRole) in kinds:
            item.setCheckState(Qt.CheckState.Checked)
    assert set(panel.suspects.chosen()) == kinds
