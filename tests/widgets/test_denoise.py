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
    for name in ("photons", "taken away"):
        assert with_movie.layers[f"bright, {name}"].axis_labels == ("frame", "y", "x")
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


def test_preview_is_of_the_frame_in_view_and_lies_on_the_movie_chosen(with_movie, open_panel, qtbot, bright_movie):
    from napari_mufasa.widgets.parts.denoise_preview import SHOWN, _contrast
    from napari_mufasa.widgets.parts.layers import plane_of

    panel, layers, session = open_panel(DenoisePanel, with_movie), with_movie.layers, session_of(with_movie)
    seconds, step = layers["bright"], 0.05
    seconds.scale = (step, *seconds.scale[1:])
    with_movie.add_image(np.zeros((2, 400, 4, 4)), name="more axes, finer", scale=(1, 0.01, 1, 1))
    with_movie.dims.set_point(1, 30 * step)
    panel.preview.switch.setChecked(True)
    qtbot.waitUntil(lambda: SHOWN in layers, timeout=30_000)
    learnt = panel.preview._ready[1]
    assert np.array_equal(panel.preview.look.after, learnt.look(30).after)

    # another movie of the same shape: preview and contrast are its own
    larger = tuple(2 * step for step in seconds.scale)
    other = with_movie.add_image(bright_movie.movie[::-1], name="other", scale=larger, units=seconds.units)
    session.set_movie(other)
    qtbot.waitUntil(lambda: SHOWN in layers and plane_of(layers[SHOWN]) == plane_of(other), timeout=30_000)
    assert layers[SHOWN].contrast_limits == pytest.approx(_contrast(SHOWN, panel.preview.look))
    panel.preview.switch.setChecked(False)


def test_preview_of_a_movie_that_begins_dark_learns_once(with_movie, open_panel, qtbot):
    panel = open_panel(DenoisePanel, with_movie)
    session_of(with_movie).set_dark_frames(5)
    with_movie.dims.set_point(0, 20)
    panel.preview.switch.setChecked(True)
    qtbot.waitUntil(lambda: panel.preview.look is not None, timeout=30_000)
    learnt, first = panel.preview._ready[1], panel.preview.look
    assert np.array_equal(first.after, learnt.look(20 - 6).after)  # of five dark frames the sixth goes, too
    with_movie.dims.set_point(0, 21)
    qtbot.waitUntil(lambda: panel.preview.look is not first, timeout=30_000)
    assert panel.preview._ready[1] is learnt
    panel.preview.switch.setChecked(False)
