"""Two channels in the viewer: rectangles, one half as the movie, registration, both traces of a molecule."""

from __future__ import annotations

import dask.array as da
import numpy as np
import pandas as pd
import pytest
from napari.layers import Image, Shapes
from tests.channels.splitter import BRIGHT, MODEL, splitter
from tests.widgets.helpers import add_movie

from napari_mufasa import widgets
from napari_mufasa.channels import Channels, Rectangle, simulate_pair
from napari_mufasa.channels import register as find_map
from napari_mufasa.errors import MufasaError
from napari_mufasa.files.layers import movie_space
from napari_mufasa.widgets.steps.data import DataPanel
from napari_mufasa.widgets.steps.register import part_of, rectangles_on, sides_of
from napari_mufasa.widgets.steps.traces import MoleculesPanel
from napari_mufasa.widgets.turns.session import session_of

WHOLE = MODEL.with_values({"acquisition.shape_px": (96, 192), "acquisition.n_frames": 100})


@pytest.fixture(scope="module")
def movies():
    return [simulate_pair(model, 0.4, splitter(), seed=seed).movie for model, seed in ((BRIGHT, 5), (MODEL, 6))]


@pytest.fixture
def two(viewer, movies):
    """A viewer with beads and a movie of two channels, and its panels of steps Data and Molecules."""
    session = session_of(viewer)
    layer = add_movie(viewer, movies[1], "movie", movie_space(100), WHOLE, 1)
    add_movie(viewer, movies[0], "beads", movie_space(100))
    session.set_movie(layer)
    session.set_model(WHOLE, "test")
    data, molecules = DataPanel(viewer), MoleculesPanel(viewer)
    for panel in (data, molecules):
        viewer.window.add_dock_widget(panel)
    return viewer, data, molecules


def test_rectangles_that_are_moved_are_the_channels(two):
    viewer, data, _ = two
    part = data.channels
    part.form.beads.value = viewer.layers["beads"]
    part.draw_button.click()
    shapes = viewer.layers["beads, channels"]
    assert part.form.regions.value is shapes
    beads = viewer.layers["beads"]
    assert sides_of(beads, shapes, "left-right") == (Rectangle(0, 96, 0, 96), Rectangle(0, 96, 96, 192))
    shapes.data = [shapes.data[0] + np.array([10, 5]), shapes.data[1] + np.array([10, 0])]
    assert sides_of(beads, shapes, "left-right") == (Rectangle(10, 96, 5, 101), Rectangle(10, 96, 96, 192))
    # The same shapes over a movie that lies elsewhere and has other pixels.
    moved = Image(beads.data, scale=(1, 0.2, 0.2), translate=(0, 2, 4), units=beads.units)
    assert sides_of(moved, rectangles_on(moved, "left-right"), "left-right")[0] == Rectangle(0, 96, 0, 96)


def test_one_shape_is_too_few(two):
    viewer = two[0]
    shapes = Shapes([[[0, 0], [0, 90], [90, 90], [90, 0]]], name="one")
    with pytest.raises(MufasaError, match="has 1 shape: draw"):
        sides_of(viewer.layers["beads"], shapes, "left-right")


def test_taking_a_half_makes_it_the_movie_in_its_place(two, movies):
    viewer, data, _ = two
    dark = add_movie(viewer, movies[1][:5], "dark", movie_space(100), ours={"role": "dark frames"})
    session = session_of(viewer)
    session.set_dark(dark)
    data.channels.take_buttons["acceptor"].click()
    taken = session.movie_layer
    assert taken.name == "movie, acceptor" and np.shares_memory(taken.data, movies[1])
    np.testing.assert_array_equal(taken.data, movies[1][:, :, 96:])
    assert tuple(taken.translate) == pytest.approx((0, 0, 9.6)) and not viewer.layers["movie"].visible
    assert session.dark_layer.name == "dark, acceptor" and session.dark_layer.data.shape == (5, 96, 96)
    assert session.measurement().movie.shape == (100, 96, 96)
    assert taken.metadata["napari_mufasa"]["model"]["acquisition"]["shape_px"] == [96, 96]


def test_a_lazy_movie_stays_lazy(movies):
    layer = Image(da.from_array(movies[1], chunks=(10, 96, 192)), name="lazy")
    assert isinstance(part_of(layer, Rectangle(0, 96, 0, 96), "left").data, da.Array)


def test_registered_channels_are_read_side_by_side(two, run, qtbot, tmp_path):
    viewer, data, molecules = two
    part, session = data.channels, session_of(viewer)
    part.form.beads.value = viewer.layers["beads"]
    with qtbot.waitSignal(data.run_bar.finished, timeout=60_000):
        part.register_button.click()
    assert isinstance(session.channels, Channels) and "spots match" in part.said.text()
    assert molecules.form.channels.value is session.channels
    part.save(str(tmp_path / "channels.json"))
    run(molecules)
    points, acceptors = viewer.layers["movie, molecules"], viewer.layers["movie, acceptors"]
    pair = points.metadata["napari_mufasa"]["pair"]
    np.testing.assert_allclose(points.data, pair.donor.positions_px)
    np.testing.assert_allclose(acceptors.data, pair.acceptor.positions_px + np.array([0, 96]))
    kept = pair.molecules[pair.kept]
    assert kept["efficiency"].mean() == pytest.approx(0.4, abs=0.01)
    chosen = int(kept.index[0])
    points.selected_data = {chosen}
    assert molecules.shown == chosen and "E 0." in molecules.plot.title.text()
    np.testing.assert_allclose(molecules.plot.data["acceptor"], pair.acceptor.all_traces[chosen])
    molecules.toggle_button.click()
    assert not points.metadata["napari_mufasa"]["pair"].kept[chosen]
    molecules.save(str(tmp_path))
    table = pd.read_csv(tmp_path / "traces.csv")
    assert {"donor", "acceptor", "efficiency"} <= set(table) and chosen not in set(table["molecule"])


def test_frames_of_both_channels_count_from_the_movies_first_where_its_first_are_dark(viewer, movies, run, tmp_path):
    from napari_mufasa.simulate.movie import simulate_dark

    whole = np.concatenate([simulate_dark(WHOLE, 10, seed=3), movies[1]])
    session = session_of(viewer)
    session.set_movie(viewer.add_image(whole, name="movie"))
    session.set_model(WHOLE, "test")
    session.set_dark_frames(10)
    session.set_channels(find_map(movies[0], *sides_of(Image(movies[0]), None, "left-right")))
    molecules = MoleculesPanel(viewer)
    viewer.window.add_dock_widget(molecules)
    molecules.form.window.value = 20
    run(molecules)
    pair = molecules.points.metadata["napari_mufasa"]["pair"]
    read = pair.molecules["bleaching_frame"]
    wanted = read.where(read < 0, read + 10)
    for layer in ("movie, molecules", "movie, acceptors"):
        assert viewer.layers[layer].features["bleaching_frame"].tolist() == wanted.tolist()
    molecules.select(0)
    assert molecules.plot.data["frame"].tolist() == list(range(10, 110))
    molecules.save(str(tmp_path))
    assert pd.read_csv(tmp_path / "molecules.csv")["bleaching_frame"].tolist() == wanted.tolist()
    starts = pair.molecules["window_start"][pair.kept] + 10
    assert len(starts)
    for name in ("traces", "donor", "acceptor"):
        table = pd.read_csv(tmp_path / f"{name}.csv")
        assert table.groupby("molecule")["frame"].min().tolist() == starts.tolist()
    efficiency = pd.read_csv(tmp_path / "traces.csv").set_index(["molecule", "frame"])["efficiency"]
    molecule = starts.index[0]
    np.testing.assert_allclose(
        efficiency[molecule], pair.efficiency[molecule, starts[molecule] - 10 :][:20], atol=1e-4
    )  # fmt: skip


def test_without_beads_nothing_is_registered(viewer):
    data = DataPanel(viewer)
    viewer.window.add_dock_widget(data)
    data.channels.register_button.click()
    assert "no beads chosen" in data.run_bar.message.text()
    data.channels.take_buttons["donor"].click()
    assert "no movie chosen" in data.run_bar.message.text()


def test_from_a_script(qapp, movies, tmp_path):
    beads, movie = Image(movies[0]), Image(movies[1])
    widget = widgets.register_widget()
    widget.beads.value = beads
    found = widget()
    found.to_json(tmp_path / "channels.json")
    read = widgets.traces_widget()
    read.movie.value, read.model.value, read.channels.value = movie, WHOLE, tmp_path / "channels.json"
    donors, acceptors = read()
    assert len(donors.data) == len(acceptors.data) > 25
    assert np.median(acceptors.data[:, 1] - donors.data[:, 1]) == pytest.approx(96 - 5.7, abs=3)
