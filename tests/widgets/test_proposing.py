"""Step Camera proposes a model from the movie and shows its test of fit; steps warn where model and movie differ."""

from __future__ import annotations

import numpy as np
import pytest
from tests.widgets.helpers import add_movie

import napari_mufasa as nm
from napari_mufasa.files.layers import movie_space
from napari_mufasa.model.presets import preset
from napari_mufasa.widgets.parts.doubts import Doubts
from napari_mufasa.widgets.steps.calibrate import CameraPanel
from napari_mufasa.widgets.steps.compare import ComparePanel
from napari_mufasa.widgets.steps.data import DataPanel
from napari_mufasa.widgets.steps.discover import DiscoverPanel
from napari_mufasa.widgets.steps.propose import propose
from napari_mufasa.widgets.turns.session import session_of


@pytest.fixture
def open_panel():
    def make(kind, viewer):
        panel = kind(viewer)
        viewer.window.add_dock_widget(panel)
        return panel

    return make


def test_a_model_is_proposed_believed_and_explained(with_movie, open_panel, qtbot, bright_model):
    # Without dark frames the camera shows where the light differs between pixels that stay as they are.
    lit = bright_model.with_effects(nm.catalogue()["illumination_profile"](edge_dimming=0.6, form="linear"))
    session = session_of(with_movie)
    space = movie_space(lit.acquisition.pixel_size_nm)
    session.set_movie(add_movie(with_movie, nm.simulate(lit, seed=1).movie, "lit", space, None, None))
    panel = open_panel(CameraPanel, with_movie)
    panel.form.em_gain.value = 500.0
    with qtbot.waitSignal(panel.run_bar.finished, timeout=120_000):
        panel.propose_button.click()
        assert not panel.propose_button.isEnabled()
        session.set_movie(with_movie.layers["bright"])  # meanwhile
    assert panel.propose_button.isEnabled()
    assert session.model_origin == "proposed from lit" and "from lit" in panel.result.text()
    # Without dark frames, and with two photoelectrons a pixel, the baseline is known to about one of 676 ADU.
    assert session.model.camera.baseline_adu == pytest.approx(bright_model.camera.baseline_adu, abs=2 * 676)
    assert session.model.camera.em_gain == 500
    assert "Not known" in panel.result.text() and "95 % interval" in panel.result.text()
    assert panel.picture.drawn and panel.picture.isVisibleTo(panel)


def test_a_movie_that_carries_its_model_is_proposed_with_its_timing(with_movie, bright_model):
    own = bright_model.with_values(
        {"acquisition.frame_length_s": 0.013, "acquisition.frame_interval_s": 0.02, "excitation.wavelength_nm": 561}
    )
    layer = session_of(with_movie).movie_layer
    for model in (own, own.to_dict()):
        layer.metadata["napari_mufasa"] = {"model": model}
        found = propose(layer, em_gain=500.0).model
        assert found.acquisition.frame_length_s == 0.013 and found.acquisition.frame_interval_s == 0.02
        assert found.excitation.wavelength_nm == 561


def test_a_proposal_can_be_cancelled(with_movie, open_panel, qtbot):
    panel = open_panel(CameraPanel, with_movie)
    before = session_of(with_movie).model
    with qtbot.waitSignal(panel.run_bar.finished, timeout=60_000):
        panel.propose_button.click()
        panel.run_bar.cancel()
    assert session_of(with_movie).model == before


@pytest.mark.parametrize("step", [DataPanel, ComparePanel, DiscoverPanel, CameraPanel])
def test_a_model_that_cannot_be_the_movies_is_warned_of(with_movie, open_panel, qtbot, step, bright_model):
    panel = open_panel(step, with_movie)
    with_movie.window._qt_window.show()  # what is not to be seen is not looked at
    session, doubts = session_of(with_movie), panel.findChild(Doubts)
    session.set_model(bright_model.with_values({"camera.baseline_adu": 2000.0}), "another camera")
    qtbot.waitUntil(lambda: "darkest pixels" in doubts.text(), timeout=20_000)
    assert "another camera" in doubts.text()
    session.set_model(preset("FF").with_values({"camera": bright_model.camera.model_dump()}), "its own camera")
    qtbot.waitUntil(lambda: not doubts.text(), timeout=20_000)


def test_dark_frames_of_another_region_are_told_before_they_are_used(with_movie, open_panel, qtbot):
    panel = open_panel(DataPanel, with_movie)
    with_movie.window._qt_window.show()
    session, doubts = session_of(with_movie), panel.findChild(Doubts)
    session.set_dark(with_movie.add_image(np.full((20, 24, 24), 300, np.uint16), name="dark of elsewhere"))
    qtbot.waitUntil(lambda: "same region" in doubts.text(), timeout=20_000)
    session.set_dark(None)
    qtbot.waitUntil(lambda: not doubts.text(), timeout=20_000)
