"""The Denoise step: preview, presets, residual, results larger than memory."""

import numpy as np
import pytest

from napari_mufasa.widgets.steps.denoise import DenoisePanel
from napari_mufasa.widgets.turns.session import session_of


@pytest.fixture
def open_panel(qtbot):
    def make(kind, viewer):
        panel = kind(viewer)
        viewer.window.add_dock_widget(panel)
        return panel

    return make


def test_denoise_preview_shows_the_frame_in_view_before_and_after(
    with_movie, open_panel, qtbot, bright_model, bright_movie
):
    from napari_mufasa.denoise.preview import Preview
    from napari_mufasa.widgets.parts.denoise_preview import SHOWN, TAKEN

    panel = open_panel(DenoisePanel, with_movie)
    with_movie.dims.set_current_step(0, 10)
    panel.preview.switch.setChecked(True)
    qtbot.waitUntil(lambda: SHOWN in with_movie.layers, timeout=30_000)
    expected = Preview(bright_movie.movie, bright_model.camera).look(10)
    assert np.array_equal(with_movie.layers[SHOWN].data, expected.split(0.5))
    assert np.array_equal(with_movie.layers[TAKEN].data, expected.residual)
    assert "dB" in panel.preview.words.text()
    panel.preview.split.setValue(100)
    assert np.array_equal(with_movie.layers[SHOWN].data, expected.before)
    with_movie.dims.set_current_step(0, 30)
    panel.preview.split.setValue(0)
    later = Preview(bright_movie.movie, bright_model.camera).look(30).after
    qtbot.waitUntil(lambda: np.array_equal(with_movie.layers[SHOWN].data, later), timeout=30_000)
    # The preview is never taken for the movie, and leaves nothing behind.
    assert session_of(with_movie).movie_layer is with_movie.layers["bright"]
    panel.preview.switch.setChecked(False)
    assert SHOWN not in with_movie.layers
    assert TAKEN not in with_movie.layers


def test_denoise_camera_presets_and_residual(with_movie, open_panel, run, bright_movie, bright_model):
    from napari_mufasa import camera as cam
    from napari_mufasa.model.cameras import CAMERAS

    panel = open_panel(DenoisePanel, with_movie)
    panel.form.residual.value = True
    panel.form.method.value = "pure-let"
    run(panel)
    after, taken = with_movie.layers["bright, photons"].data, with_movie.layers["bright, taken away"].data
    before = cam.photons(cam.photoelectrons(bright_movie.movie, bright_model.camera), bright_model.camera)
    np.testing.assert_allclose(np.asarray(taken[7]), (before - after)[7], atol=1e-4)
    panel.preset.native.setCurrentText("sCMOS, linear")
    panel.preset.native.activated.emit(panel.preset.native.currentIndex())
    camera = session_of(with_movie).model.camera
    assert camera.type == "CMOS"
    assert camera.read_noise_e == CAMERAS["sCMOS, linear"]["read_noise_e"]
    assert panel.form.excess_noise.native.isHidden()


def test_large_results_are_written_to_disk_and_read_when_looked_at(with_movie, open_panel, run, monkeypatch):
    import napari_mufasa.denoise.viewing as module

    panel = open_panel(DenoisePanel, with_movie)
    run(panel)
    whole = with_movie.layers["bright, photons"].data
    monkeypatch.setattr(module, "IN_MEMORY_BYTES", 0)
    run(panel)
    stored = with_movie.layers[-1].data
    assert not isinstance(stored, np.ndarray)
    np.testing.assert_allclose(np.asarray(stored[20]), whole[20], atol=1e-5)
