"""A viewer that finds no settings of the user, and small movies."""

from __future__ import annotations

import os

import pytest

pytest.importorskip("napari")


@pytest.fixture(scope="session", autouse=True)
def _empty_user(tmp_path_factory):
    """napari, matplotlib and Qt read and write in empty folders."""
    home = tmp_path_factory.mktemp("user")
    before = {name: os.environ.get(name) for name in ("XDG_CONFIG_HOME", "XDG_CACHE_HOME", "XDG_DATA_HOME")}
    for name in before:
        (home / name).mkdir()
        os.environ[name] = str(home / name)
    yield
    for name, value in before.items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value


@pytest.fixture
def viewer(make_napari_viewer):
    return make_napari_viewer(strict_qt="raise")


@pytest.fixture(scope="session")
def bright_model():
    """Bright, well separated molecules: detection is no question."""
    from napari_mufasa.model.presets import preset

    return preset("FF").with_values(
        {
            "acquisition.n_frames": 60,
            "acquisition.shape_px": (48, 64),
            "excitation.power_density_w_per_cm2": 20,
            "optics.background_photons_per_px": 2,
            "sample.n_molecules": 12,
            "sample.min_distance_px": 9.0,
        }
    )


@pytest.fixture(scope="session")
def bright_movie(bright_model):
    from napari_mufasa.simulate.movie import simulate

    return simulate(bright_model, seed=3)


@pytest.fixture
def run(qtbot):
    """Press a panel's Run button and wait until the run has ended."""

    def press(panel, timeout=60_000):
        with qtbot.waitSignal(panel.run_bar.finished, timeout=timeout):
            panel.run_bar.run_button.click()

    return press


@pytest.fixture
def with_movie(viewer, bright_model, bright_movie):
    """A viewer with the bright movie, chosen, and its model believed."""
    from tests.widgets.helpers import add_movie

    from napari_mufasa.files.layers import movie_space
    from napari_mufasa.widgets.turns.session import session_of

    layer = add_movie(
        viewer, bright_movie.movie, "bright", movie_space(bright_model.acquisition.pixel_size_nm), bright_model, 3
    )
    session = session_of(viewer)
    session.set_movie(layer)
    session.set_model(bright_model, "bright")
    return viewer
