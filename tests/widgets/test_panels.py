"""The panels, driven as a user would: values and clicks."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from tests.report_example import power
from tests.widgets.helpers import Answers, add_movie

from napari_mufasa.compare.quick import quick_distance
from napari_mufasa.errors import MufasaError
from napari_mufasa.files.layers import movie_space
from napari_mufasa.traces import Options, extract_traces
from napari_mufasa.widgets.steps.calibrate import CameraPanel
from napari_mufasa.widgets.steps.compare import ComparePanel
from napari_mufasa.widgets.steps.denoise import DenoisePanel
from napari_mufasa.widgets.steps.design import DesignPanel
from napari_mufasa.widgets.steps.model import ModelPanel
from napari_mufasa.widgets.steps.simulate import SimulatePanel
from napari_mufasa.widgets.steps.traces import MoleculesPanel
from napari_mufasa.widgets.turns.session import session_of
from napari_mufasa.widgets.workflow import STEPS, WorkflowWidget


@pytest.fixture
def open_panel(qtbot):
    def make(kind, viewer):
        panel = kind(viewer)
        viewer.window.add_dock_widget(panel)
        return panel

    return make


def type_into(edit, text):
    edit.native.setText(text)
    edit.native.editingFinished.emit()


def pick(edit, choice):
    """Choose from a list, as a user does."""
    edit.native.setCurrentText(choice)
    edit.native.activated.emit(edit.native.currentIndex())


def test_simulate_gives_the_movie_of_the_values_typed(viewer, open_panel, run, bright_model):
    from napari_mufasa.simulate.movie import simulate

    panel = open_panel(SimulatePanel, viewer)
    session_of(viewer).set_model(bright_model, "test")
    type_into(panel.parts["acquisition"].form["n_frames"], "25")
    type_into(panel.parts["acquisition"].form["shape_px"], "40 x 30")
    type_into(panel.parts["sample"].form["n_molecules"], "5")
    panel.form.seed.value = 11
    panel.form.optical.value = True
    run(panel)
    movie = session_of(viewer).movie_layer
    wanted = bright_model.with_values(
        {"acquisition.n_frames": 25, "acquisition.shape_px": (40, 30), "sample.n_molecules": 5}
    )
    assert np.array_equal(movie.data, simulate(wanted, seed=11).movie)
    assert tuple(movie.scale) == pytest.approx((1, 0.1, 0.1))
    names = [layer.name for layer in viewer.layers]
    assert names == ["FF simulated, photons", "FF simulated", "FF simulated, true positions"]
    assert len(viewer.layers[2].data) == 5


def test_wrong_value_is_told_and_not_taken(viewer, open_panel):
    panel = open_panel(SimulatePanel, viewer)
    before = session_of(viewer).model
    type_into(panel.parts["acquisition"].form["frame_length_s"], "-3")
    assert session_of(viewer).model == before
    assert "frame_length_s" in panel.parts["acquisition"].form.problem.text()
    type_into(panel.parts["acquisition"].form["frame_length_s"], "soon")
    assert session_of(viewer).model == before
    type_into(panel.parts["acquisition"].form["frame_length_s"], "0.05")
    assert session_of(viewer).model.acquisition.frame_length_s == 0.05
    assert panel.parts["acquisition"].form.problem.isHidden()


def test_denoise_gives_what_the_function_gives(with_movie, open_panel, run, bright_model, bright_movie):
    from napari_mufasa.denoise import denoise

    panel = open_panel(DenoisePanel, with_movie)
    panel.form.method.value = "pure-let"
    run(panel)
    layer = with_movie.layers[-1]
    assert layer.data.dtype == np.float32
    assert np.array_equal(layer.data, denoise(bright_movie.movie, bright_model.camera, method="pure-let"))
    assert tuple(layer.scale) == tuple(with_movie.layers["bright"].scale)
    assert layer.units == with_movie.layers["bright"].units


def test_molecules_are_the_simulated_ones_and_a_click_shows_the_trace(with_movie, open_panel, run, bright_movie):
    panel = open_panel(MoleculesPanel, with_movie)
    run(panel)
    points = with_movie.layers[-1]
    assert list(points.features.columns[:3]) == ["molecule", "y", "x"]
    assert {"brightness", "snr", "bleaching_frame", "kept", "reason"} <= set(points.features.columns)
    distance = np.hypot(*(points.data[:, None] - bright_movie.positions_px[None]).transpose(2, 0, 1))
    inside = np.all((bright_movie.positions_px > 3) & (bright_movie.positions_px < (44, 60)), axis=1)
    assert np.median(distance.min(axis=0)[inside]) < 0.5
    # In select mode a click changes the selection.
    assert points.visible and points.mode == "select"  # a click selects
    points.selected_data = {2}
    assert panel.shown == 2
    assert np.allclose(panel.plot.data["photoelectrons"], panel.traces.all_traces[2])
    # A person's judgement counts, and says so.
    was_kept = bool(points.features["kept"][2])
    panel.toggle_button.click()
    assert bool(points.features["kept"][2]) is not was_kept
    assert points.features["reason"][2] == ("rejected by hand" if was_kept else "")


def test_points_deleted_or_of_an_earlier_run_still_show_their_own_trace(with_movie, open_panel, run):
    panel = open_panel(MoleculesPanel, with_movie)
    run(panel)
    first, first_traces = panel.points, panel.traces
    panel.form.profile.value = "brightest_pixel"
    run(panel)
    with_movie.layers.selection.active = first
    first.selected_data = {0}
    first.remove_selected()
    first.selected_data = {1}  # the molecule that was number 2
    assert panel.shown == 2
    assert np.array_equal(panel.plot.data["photoelectrons"], first_traces.all_traces[2])
    panel.toggle_button.click()
    assert first.features.set_index("molecule")["reason"][2] in ("rejected by hand", "")
    assert len(first.features) == len(first.data)


def test_denoised_movie_is_read_in_photons_and_never_taken_for_counts(with_movie, open_panel, run, bright_model):
    denoise, molecules = open_panel(DenoisePanel, with_movie), open_panel(MoleculesPanel, with_movie)
    run(molecules)
    counts = molecules.traces
    run(denoise)
    session_of(with_movie).set_movie(with_movie.layers["bright, photons"])
    run(molecules)
    # The same photoelectrons whatever the way: denoising keeps each molecule's sum to a few per cent.
    photons = molecules.traces
    distance = np.hypot(*(counts.positions_px[:, None] - photons.positions_px[None]).transpose(2, 0, 1))
    same = distance.min(axis=1) < 1
    ratio = photons.all_traces[distance.argmin(axis=1)].sum(axis=1)[same] / counts.all_traces.sum(axis=1)[same]
    assert same.sum() >= 8
    assert np.median(ratio) == pytest.approx(1, abs=0.12)
    compare = open_panel(ComparePanel, with_movie)
    compare.run_bar.run_button.click()
    assert not compare.run_bar.running
    assert "holds photons" in compare.run_bar.message.text()


def test_traces_are_saved_as_the_contract_says(with_movie, open_panel, run, tmp_path):
    panel = open_panel(MoleculesPanel, with_movie)
    panel.form.best.value = 4
    run(panel)
    panel.save(str(tmp_path))
    traces, molecules = pd.read_csv(tmp_path / "traces.csv"), pd.read_csv(tmp_path / "molecules.csv")
    assert list(traces.columns) == ["molecule", "frame", "photoelectrons"]
    assert len(traces) == 4 * 60
    assert set(traces["molecule"]) == set(molecules.loc[molecules["kept"], "molecule"])


def test_traces_saved_before_are_replaced_only_when_the_user_says_so(
    with_movie, open_panel, run, tmp_path, monkeypatch
):
    panel, user = open_panel(MoleculesPanel, with_movie), Answers(monkeypatch, tmp_path)
    run(panel)
    panel.save_button.click()
    assert not user.asked and sorted(file.name for file in tmp_path.iterdir()) == [
        "molecules.csv", "traces.csv", "traces.provenance.json"
    ]  # fmt: skip
    (tmp_path / "traces.csv").unlink()
    (tmp_path / "molecules.csv").write_text("of a day's work")
    panel.save_button.click()
    assert user.asked == [f"{tmp_path} already holds molecules.csv, traces.provenance.json. Replace?"]
    assert (tmp_path / "molecules.csv").read_text() == "of a day's work" and not (tmp_path / "traces.csv").exists()
    user.replace = True
    panel.save_button.click()
    written = "traces.csv, molecules.csv and traces.provenance.json"
    assert len(pd.read_csv(tmp_path / "molecules.csv")) == len(panel.traces.molecules)
    assert panel.run_bar.message.text() == f"Written: {written} in {tmp_path}"


def test_a_folder_that_cannot_be_written_to_is_told_in_one_line(with_movie, open_panel, run, tmp_path, monkeypatch):
    from napari.utils.notifications import notification_manager

    panel, _ = open_panel(MoleculesPanel, with_movie), Answers(monkeypatch, tmp_path)
    run(panel)

    def refuse(source, target):
        raise PermissionError(13, "Permission denied", str(target))

    monkeypatch.setattr("os.replace", refuse)
    panel.save_button.click()
    told = f"{tmp_path / 'traces.csv'}: permission denied; check the path, its permissions and the space on the disk"
    assert panel.run_bar.message.text() == notification_manager.records[-1].message == told

    def full(source, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    panel.save_button.click()
    told = "[Errno 28] No space left on device: check the files and the space on the disk"
    assert panel.run_bar.message.text() == told


def test_a_plot_that_cannot_be_saved_is_told(with_movie, qtbot, tmp_path, monkeypatch):
    from napari.utils.notifications import notification_manager
    from qtpy.QtWidgets import QFileDialog

    from napari_mufasa.widgets.parts.plot import PlotCanvas

    plot = PlotCanvas(with_movie)
    with_movie.window.add_dock_widget(plot)
    plot.draw(lambda figure: None, pd.DataFrame({"frame": [0]}))
    monkeypatch.setattr(QFileDialog, "getSaveFileName", lambda *_, **__: (str(tmp_path / "no" / "plot.csv"), ""))
    n = len(notification_manager.records)
    plot.save_button.click()
    qtbot.waitUntil(lambda: len(notification_manager.records) > n, timeout=5000)
    assert "make it first" in notification_manager.records[-1].message
    qtbot.waitUntil(lambda: not plot.busy, timeout=20_000)


@pytest.fixture(scope="module")
def dark_first(bright_model, bright_movie):
    """The bright movie after 21 frames without light, of an odd number of which one more is left out."""
    from napari_mufasa.simulate.movie import simulate_dark

    return np.concatenate([simulate_dark(bright_model, 21, seed=9), bright_movie.movie])


@pytest.mark.parametrize("follow", [False, True])
def test_frames_of_traces_count_from_the_movies_first_where_its_first_are_dark(
    viewer, open_panel, run, bright_model, dark_first, tmp_path, follow
):
    session = session_of(viewer)
    session.set_movie(viewer.add_image(dark_first, name="dark first"))
    session.set_model(bright_model, "test")
    session.set_dark_frames(21)
    panel = open_panel(MoleculesPanel, viewer)
    panel.form.follow_molecules.value, panel.form.window.value = follow, 5
    run(panel)
    found = extract_traces(
        dark_first[22:], bright_model.camera, dark_first[:21], threshold_value=6.0, min_snr=1.0, window=5,
        follow_molecules=follow,
    )  # fmt: skip
    wanted = found.molecules.copy()
    names = ["bleaching_frame", "window_start"] + (["first_found", "last_found"] if follow else [])
    assert (wanted[names] >= 0).any().all() and (follow or (wanted[names] < 0).any().all())
    for name in names:
        wanted.loc[wanted[name] >= 0, name] += 22
    assert panel.points.features["bleaching_frame"].tolist() == wanted["bleaching_frame"].tolist()
    shown = int(wanted["bleaching_frame"].argmax())
    panel.select(shown)
    assert panel.plot.data["frame"].tolist() == list(range(22, 81))
    assert f"bleached at frame {wanted['bleaching_frame'][shown]} " in panel.plot.title.text()
    panel.save(str(tmp_path))
    saved = pd.read_csv(tmp_path / "molecules.csv")
    assert saved[names].equals(wanted[names])
    starts = pd.read_csv(tmp_path / "traces.csv").groupby("molecule")["frame"].min()
    kept = wanted[found.kept].set_index("molecule")["window_start"]
    assert len(kept) and starts.to_dict() == kept.to_dict()
    if follow:
        paths = pd.read_csv(tmp_path / "paths.csv").groupby("molecule")["frame"].agg(["min", "max"])
        assert paths["min"].tolist() == wanted["first_found"][found.kept].tolist()
        assert paths["max"].tolist() == wanted["last_found"][found.kept].tolist()
    # What the other steps are handed is as it was read.
    assert session.traces.molecules["bleaching_frame"].equals(found.molecules["bleaching_frame"])
    assert np.array_equal(session.traces.all_traces, found.all_traces)


def test_compare_says_how_near_the_true_model_is(with_movie, open_panel, run):
    panel = open_panel(ComparePanel, with_movie)
    panel.form.fit.value = False
    run(panel)
    w1 = panel.comparison.w1
    # Of 12 molecules that bleach within some frames, two-state ones of the same rates are as near by chance (W1 5 to 90
    # in six movies, 2 to 50 of the true model, floors 20 to 70); those that never bleach (470 to 540) are not.
    assert w1["mufasa"] < w1["poisson"] / 5
    assert panel.distances.drawn
    for name in panel.which.choices:
        panel.which.value = name
        assert len(panel.curves.data) > 1


@pytest.fixture
def other(with_movie, bright_movie):
    """A second movie in the viewer, not chosen."""
    return add_movie(with_movie, bright_movie.movie[:, ::-1], "other", movie_space(100.0))


@pytest.mark.parametrize("kind", [MoleculesPanel, ComparePanel])
def test_traces_of_a_movie_that_is_no_longer_chosen_are_not_those_of_the_session(
    with_movie, other, open_panel, qtbot, kind
):
    panel, session = open_panel(kind, with_movie), session_of(with_movie)
    if kind is ComparePanel:
        panel.form.fit.value = False
    with qtbot.waitSignal(panel.run_bar.finished, timeout=60_000):
        panel.run_bar.run_button.click()
        session.set_movie(other)
    assert session.traces is None
    if kind is ComparePanel:
        assert panel.comparison is not None and "Found on bright, not on" in panel.result.text()
        return
    panel.select(2)
    panel.toggle_button.click()  # of the movie that was read
    assert session.traces is None
    session.set_movie(with_movie.layers["bright"])
    panel.toggle_button.click()
    assert session.traces is panel.traces is not None


def test_distances_of_another_movie_than_the_one_chosen_say_so_and_offer_no_model(with_movie, other, open_panel, run):
    panel, session = open_panel(ComparePanel, with_movie), session_of(with_movie)
    session.set_model(session.model.with_values({"excitation.power_density_w_per_cm2": 60}))
    run(panel)
    assert panel.comparison.nearer == "fitted"
    assert panel.use_button.isVisibleTo(panel) and panel.result.text().startswith("W1 distance")
    session.set_movie(other)
    assert not panel.use_button.isVisibleTo(panel)
    assert panel.result.text().startswith("Found on bright, not on the movie chosen:<br>W1 distance")
    session.set_movie(with_movie.layers["bright"])
    assert panel.use_button.isVisibleTo(panel) and panel.result.text().startswith("W1 distance")


def test_how_many_first_frames_are_dark_is_said_of_one_movie(with_movie, other, open_panel):
    from napari_mufasa.widgets.steps.data import DataPanel

    panel, session = open_panel(DataPanel, with_movie), session_of(with_movie)
    panel.form.dark_frames.value = 20
    assert session.measurement().first_frame == 20
    panel.form.movie.value = other
    assert session.movie_layer is other and session.dark_frames == panel.form.dark_frames.value == 0
    assert session.measurement().first_frame == 0 and session.measurement().dark is None
    panel.form.dark_frames.value = 20
    panel.channels.take_buttons["donor"].click()  # of the same frames
    assert session.movie_layer.name == "other, donor" and session.measurement().first_frame == 20


def test_missing_movie_is_a_notification_with_the_remedy(viewer, open_panel):
    from napari.utils.notifications import notification_manager

    panel = open_panel(DenoisePanel, viewer)
    n = len(notification_manager.records)
    panel.run_bar.run_button.click()
    assert not panel.run_bar.running
    assert "Open Sample" in notification_manager.records[-1].message
    assert len(notification_manager.records) == n + 1


def test_model_panel_edits_effects_and_shows_what_follows(viewer, open_panel):
    panel = open_panel(ModelPanel, viewer)
    session = session_of(viewer)
    panel.source.value = "FF"
    assert "6725" in panel.derived.text()  # docs/photophysics.md: k01 = 6 724.90 per second
    assert panel.derived.isVisibleTo(panel)
    panel.effects.kinds.value = "stage_drift"
    panel.effects.add_button.click()
    assert [effect.kind for effect in session.model.effects] == ["stage_drift"]
    type_into(panel.effects.form["distance_px"], "2.5")
    assert session.model.effects[0].distance_px == 2.5

    def rows():
        return {edit.name for edit in panel.effects.form if edit.native.isVisibleTo(panel.effects.form.native)}

    assert rows() == {"distance_px", "direction_deg", "form"}  # what only other forms use is not shown
    pick(panel.effects.form["form"], "step")
    assert rows() == {"distance_px", "direction_deg", "step_at", "form"}
    from qtpy.QtCore import Qt

    panel.effects.list.item(0).setCheckState(Qt.CheckState.Unchecked)
    assert session.model.effects == ()
    panel.effects.list.item(0).setCheckState(Qt.CheckState.Checked)
    assert session.model.effects[0].distance_px == 2.5  # switched off, not forgotten
    type_into(panel.parts["excitation"].form["power_density_w_per_cm2"], "4")
    assert "13450" in panel.derived.text()


def test_a_model_that_is_in_no_list_is_named_in_a_step_made_later(viewer, open_panel, bright_model):
    session_of(viewer).set_model(bright_model, "mine.json")
    source = open_panel(MoleculesPanel, viewer).form.model.source.native
    assert source.currentIndex() == -1 and source.placeholderText() == "mine.json"


def test_camera_type_brings_or_takes_the_em_gain(viewer, open_panel):
    panel = open_panel(ModelPanel, viewer)
    session = session_of(viewer)
    panel.source.value = "PALM"
    kind = panel.parts["camera"].form["type"]
    pick(kind, "EMCCD")
    assert session.model.camera.em_gain == 300
    pick(kind, "CMOS")
    assert session.model.camera.em_gain is None


def test_a_camera_is_measured_as_the_counts_tell_until_its_type_is_chosen(viewer, open_panel):
    panel = open_panel(CameraPanel, viewer)
    kind = panel.form.camera_type
    assert kind.value is None and kind.native.isVisibleTo(panel)
    pick(panel.editor.form["type"], "CMOS")
    assert kind.value == "CMOS"


def test_a_camera_without_a_register_has_no_excess_noise_of_one(viewer, open_panel):
    panel = open_panel(ModelPanel, viewer)
    session = session_of(viewer)
    panel.source.value = "FF"
    form = panel.parts["camera"].form
    assert form["excess_noise_factor"].native.placeholderText() == "2"  # what an empty field stands for
    type_into(form["excess_noise_factor"], "1.9")
    pick(form["type"], "CCD")
    assert session.model.camera.type == "CCD" and session.model.camera.excess_noise_factor is None
    assert not form["excess_noise_factor"].native.isVisibleTo(form.native)


def test_a_layer_taken_out_of_the_viewer_is_offered_by_no_step(viewer, open_panel):
    panels = [open_panel(kind, viewer) for kind in (DenoisePanel, ComparePanel, CameraPanel)]
    first = viewer.add_image(np.zeros((4, 16, 24), np.uint16), name="first")  # the first step to hear of it chooses it
    assert all(panel.form.movie.value is first for panel in panels)
    viewer.layers.remove(first)
    assert all(panel.form.movie.choices == () for panel in panels)


def test_entries_of_lists_fit_a_narrow_dock():
    from napari_mufasa.widgets.parts.model_edit import FROM_LAYER
    from napari_mufasa.widgets.steps.denoise import IN_USE, MEASURED, METHODS

    assert max(map(len, (FROM_LAYER, IN_USE, MEASURED, *(words for words, _ in METHODS)))) <= 23


def test_facts_of_a_single_frame_and_of_colours(viewer, open_panel):
    from napari_mufasa.widgets.steps.data import DataPanel

    panel = open_panel(DataPanel, viewer)
    session_of(viewer).set_movie(viewer.add_image(np.zeros((16, 24), np.uint16), name="one"))
    assert "1 frame of 16 × 24 px" in panel.facts.text()
    session_of(viewer).set_movie(viewer.add_image(np.zeros((16, 24, 3), np.uint8), name="photo", rgb=True))
    assert "photo has colours (RGB)" in panel.facts.text()


@pytest.mark.parametrize("bad", ["one pixel", "all"])
def test_a_movie_with_values_that_are_no_numbers_is_opened_and_can_be_taken_out(
    viewer, open_panel, tmp_path, qtbot, bad
):
    import tifffile

    from napari_mufasa.widgets.steps.data import DataPanel

    movie = np.random.default_rng(1).normal(100, 10, (6, 16, 24)).astype(np.float32)
    movie[(0, 3, 4) if bad == "one pixel" else ...] = np.nan
    tifffile.imwrite(tmp_path / "nan.tif", movie)
    panel = open_panel(DataPanel, viewer)
    with qtbot.waitSignal(panel.run_bar.finished, timeout=60_000):
        panel.open_movie(str(tmp_path / "nan.tif"))
    qtbot.waitUntil(viewer.window._qt_window.updatesEnabled, timeout=5000)
    layer = session_of(viewer).movie_layer
    low, high = layer.contrast_limits
    assert (low, high) == (0, 1) if bad == "all" else 60 < low < 100 < high < 140
    viewer.layers.remove(layer)
    assert not viewer.layers


def test_dark_frames_that_are_opened_are_those_of_the_movie(with_movie, open_panel, tmp_path, qtbot, bright_model):
    from napari_mufasa.files.movies import write_movie
    from napari_mufasa.simulate.movie import simulate_dark
    from napari_mufasa.widgets.steps.data import DataPanel

    dark, path = simulate_dark(bright_model, 5), str(tmp_path / "shutter.ome.tif")
    write_movie(path, [dark], dark.shape, dark.dtype, role="dark frames")
    panel = open_panel(DataPanel, with_movie)
    with qtbot.waitSignal(panel.run_bar.finished, timeout=60_000):
        panel.open_movie(path)
    session = session_of(with_movie)
    assert session.movie_layer is with_movie.layers["bright"]
    assert session.dark_layer is panel.form.dark.value is with_movie.layers["shutter"]
    assert np.array_equal(session.measurement().dark, dark)
    assert "shutter holds dark frames" in panel.run_bar.message.text()
    small = str(tmp_path / "small.ome.tif")
    write_movie(small, [dark[:, :20]], dark[:, :20].shape, dark.dtype, role="dark frames")
    with qtbot.waitSignal(panel.run_bar.finished, timeout=60_000):
        panel.open_movie(small)
    assert session.dark_layer is with_movie.layers["shutter"] and "choose others" in panel.run_bar.message.text()


@pytest.mark.parametrize(("zarr_format", "chosen"), [(3, "zarr.json"), (2, ".zarray"), (2, ".zattrs")])
def test_a_zarr_movie_is_chosen_by_a_file_in_it(viewer, open_panel, tmp_path, qtbot, monkeypatch, zarr_format, chosen):
    import zarr
    from qtpy.QtWidgets import QFileDialog

    from napari_mufasa.widgets.steps.data import DataPanel

    movie = np.arange(6 * 16 * 24, dtype=np.uint16).reshape(6, 16, 24)
    zarr.save_array(str(tmp_path / "folder.zarr"), movie, zarr_format=zarr_format)
    zarr.open_array(str(tmp_path / "folder.zarr")).attrs["note"] = "beam on"
    filters = []

    def choose(*_, filter):
        filters.append(filter)
        return str(tmp_path / "folder.zarr" / chosen), ""

    monkeypatch.setattr(QFileDialog, "getOpenFileName", choose)
    panel = open_panel(DataPanel, viewer)
    with qtbot.waitSignal(panel.run_bar.finished, timeout=60_000):
        panel.run_bar.run_button.click()
    assert chosen in filters[0]
    layer = session_of(viewer).movie_layer
    assert layer.name == "folder" and np.array_equal(layer.data, movie)


def test_workflow_shares_its_values_between_steps(with_movie, qtbot):
    widget = WorkflowWidget(with_movie)
    with_movie.window.add_dock_widget(widget)
    for index, name in enumerate(STEPS):
        widget.tabs.setCurrentIndex(index)
        assert widget.tabs.currentIndex() == index
        assert widget.step(name).isVisibleTo(widget)
    camera = widget.step("Camera").editor.form["read_noise_e"]
    type_into(camera, "33")
    assert widget.step("Model").parts["camera"].form["read_noise_e"].value == 33
    assert widget.step("Denoise").session.model.camera.read_noise_e == 33


def test_design_shows_a_column_for_each_value(viewer, open_panel, run, tmp_path, bright_model):
    from napari_mufasa.design import design

    panel = open_panel(DesignPanel, viewer)
    session_of(viewer).set_model(bright_model, "test")
    type_into(panel.form["values"], "1, 1000")
    run(panel)
    wanted = design(bright_model, {"excitation.power_density_w_per_cm2": [1.0, 1000.0]})
    assert [panel.table.horizontalHeaderItem(i).text() for i in (1, 2)] == ["1", "1000"]
    assert float(panel.table.item(0, 2).text()) == pytest.approx(wanted["k01_per_s"][1], rel=5e-3)
    assert panel.table.rowCount() == len(wanted.columns) - 1
    panel.save(str(tmp_path / "design.csv"))
    assert pd.read_csv(tmp_path / "design.csv")["snr_spot"].to_numpy() == pytest.approx(wanted["snr_spot"].to_numpy())


def test_design_maps_two_values_and_solves_for_a_target(viewer, open_panel, run, bright_model):
    from napari_mufasa.design import predict

    panel = open_panel(DesignPanel, viewer)
    session_of(viewer).set_model(bright_model, "test")
    panel.form.vary_also.value = "optics.psf_fwhm_nm"
    type_into(panel.form["also_values"], "250, 300")
    run(panel)
    assert panel.table.horizontalHeaderItem(6).text() == "100 / 300" and panel.plot.drawn
    panel.targets.and_also.value = ""
    panel.solve_button.click()
    assert predict(session_of(viewer).model).snr_spot == pytest.approx(5)
    assert "met" in panel.solution.text()
    panel.targets.wanted.value = "duty_cycle"
    panel.solve_button.click()  # nothing changes it: told in one line
    assert "cannot be reached" in panel.run_bar.message.text()


def test_design_draws_how_often_an_effect_is_seen(viewer, open_panel, bright_model, qtbot, monkeypatch):
    from napari_mufasa.discover import detection

    def simulated(model, effect, strengths, *, movies, dark_frames, **_):
        """What `nm.power` answers (tests/discover/test_detection.py), without its simulations."""
        detection.checks.whole(dark_frames, "dark_frames", 1, 10)
        effects = [effect.model_copy(update={"distance_px": strength}) for strength in strengths]
        return [power(one, movies, 3 * (one.distance_px > 1)) for one in effects]

    monkeypatch.setattr(detection, "power", simulated)
    panel = open_panel(DesignPanel, viewer)
    session_of(viewer).set_model(bright_model, "test")
    asked = panel.hidden_effect
    asked.effect.value, asked.movies.value, asked.recorded_dark.value = "stage_drift", 3, 5
    type_into(asked["strengths"], "0.01, 4")
    panel.power_button.click()
    qtbot.waitUntil(lambda: panel.power_plot.data is not None, timeout=30_000)
    assert panel.power_plot.data["distance_px"].tolist() == [0.01, 4.0]
    assert panel.power_plot.data["power"].tolist() == [0.0, 1.0]
    asked.recorded_dark.value = 0
    panel.power_button.click()  # what it refuses is told in one line
    qtbot.waitUntil(lambda: "dark_frames" in panel.run_bar.message.text(), timeout=30_000)


def test_a_measured_camera_is_that_of_every_step(with_movie, open_panel, run, bright_movie, bright_model):
    from napari_mufasa.calibrate import calibrate

    panel = open_panel(CameraPanel, with_movie)
    panel.form.baseline_adu.value, panel.form.read_noise_adu.value = 367.0, 82.0
    run(panel)
    wanted = calibrate(bright_movie.movie, baseline_adu=367.0, read_noise_adu=82.0).camera
    assert session_of(with_movie).model.camera == wanted
    assert panel.editor.form["electrons_per_adu"].value == wanted.electrons_per_adu
    assert "Measured on bright" in panel.result.text() and "baseline 367 ADU, read noise 82 ADU" in panel.result.text()
    assert "(measured)" in session_of(with_movie).model_origin


def test_molecules_that_are_followed_are_shown_as_tracks(with_movie, open_panel, run):
    panel = open_panel(MoleculesPanel, with_movie)
    panel.form.follow_molecules.value = True
    run(panel)
    tracks = next(layer for layer in with_movie.layers if type(layer).__name__ == "Tracks")
    assert tracks.visible and len(set(tracks.data[:, 0])) == int(panel.traces.kept.sum()) > 0
    assert with_movie.layers[-1].name.endswith("molecules")
    assert "Followed molecules" in panel.run_bar.message.text()
    panel.select(int(panel.traces.molecules["molecule"].iloc[0]))
    assert "diffusion_px2_per_frame" in with_movie.layers[-1].features
    with pytest.raises(MufasaError, match="without following"):  # what the live distance says
        quick_distance(panel.traces, session_of(with_movie).model)


@pytest.mark.parametrize("chosen", [{"window": 30}, {"best": 5}])
def test_the_live_distance_is_that_of_whole_traces_of_all(bright_model, bright_movie, chosen):
    """Windows of long-lived molecules, set against whole traces of all, are far from the right model."""
    options = Options(psf_sigma_px=bright_model.sigma_px, **chosen)
    measured = extract_traces(bright_movie.movie, bright_model.camera, options=options)
    with pytest.raises(MufasaError, match="without window and best"):
        quick_distance(measured, bright_model)


def test_what_the_file_says_of_the_instrument_is_shown_and_believed_on_a_click(viewer, open_panel, tmp_path, qtbot):
    from napari_mufasa.widgets.steps.data import DataPanel

    czi = pytest.importorskip("pylibCZIrw.czi")
    with czi.create_czi(str(tmp_path / "zeiss.czi")) as file:
        for t in range(6):
            file.write(data=np.random.default_rng(t).integers(90, 200, (16, 24, 1), np.uint16), plane={"T": t})
        written = {"ExposureTime": 0.03, "EMGain": 250}
        file.write_metadata("movie", scale_x=107.5e-9, scale_y=107.5e-9, custom_attributes=written)
    panel = open_panel(DataPanel, viewer)
    with qtbot.waitSignal(panel.run_bar.finished, timeout=60_000):
        panel.open_movie(str(tmp_path / "zeiss.czi"))
    layer = session_of(viewer).movie_layer
    assert layer.name == "zeiss" and tuple(layer.scale) == pytest.approx((1, 0.1075, 0.1075))
    assert "exposure 30 ms" in panel.facts.text() and "EM gain setting 250" in panel.facts.text()
    assert session_of(viewer).model.acquisition.pixel_size_nm != pytest.approx(107.5)
    assert not panel.use_instrument.isHidden()
    panel.use_instrument.click()
    timing = session_of(viewer).model.acquisition
    assert timing.pixel_size_nm == pytest.approx(107.5) and timing.frame_length_s == pytest.approx(0.03)
    assert panel.use_instrument.isHidden()
