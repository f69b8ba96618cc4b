"""The manifest: valid, every widget opens from it, files and samples go through it."""

from __future__ import annotations

import inspect
from pathlib import Path

import numpy as np
import pytest
from magicgui.widgets import FunctionGui
from npe2 import PluginManifest
from npe2.manifest.utils import import_python_name

from napari_mufasa import files
from napari_mufasa.files.layers import get_reader, read_layers
from napari_mufasa.model.model import Model
from napari_mufasa.traces import extract_traces

WIDGETS = (
    "MUFASA workflow", "Simulate", "Denoise", "Extract traces", "Compare", "Discover", "Calibrate camera", "Design",
)  # fmt: skip


@pytest.fixture
def manifest():
    return PluginManifest.from_distribution("napari-mufasa")


def test_manifest_is_valid_and_every_command_exists(manifest):
    manifest.validate_imports()
    assert {widget.display_name for widget in manifest.contributions.widgets} == set(WIDGETS)


def test_link_at_the_top_is_the_manifest_of_the_package():
    top = Path(__file__).parents[2] / "napari.yaml"
    assert top.is_symlink()
    assert not Path(top.readlink()).is_absolute()
    assert top.resolve() == Path(files.__file__).parents[1] / "napari.yaml"


def test_menus_are_ones_napari_shows(manifest):
    from napari._app_model.constants import MenuId

    allowed = {menu.value for menu in MenuId.contributables()}
    assert set(manifest.contributions.menus) <= allowed


@pytest.mark.parametrize("name", WIDGETS)
def test_every_widget_opens(viewer, name):
    dock, widget = viewer.window.add_plugin_dock_widget("napari-mufasa", name)
    assert widget.isVisibleTo(dock)


@pytest.mark.parametrize("name", WIDGETS[1:])
def test_every_step_of_the_manifest_is_a_magicgui_widget_where_there_is_no_viewer(manifest, qapp, name):
    (command,) = (widget.command for widget in manifest.contributions.widgets if widget.display_name == name)
    (made_by,) = (one.python_name for one in manifest.contributions.commands if one.id == command)
    widget = import_python_name(made_by)()
    assert isinstance(widget, FunctionGui)
    assert widget.asdict().keys() == inspect.signature(widget._function).parameters.keys()


def test_reader_restores_the_model_and_stays_lazy(tmp_path, viewer, bright_model, bright_movie):
    for suffix in (".ome.tif", ".zarr"):
        path = tmp_path / f"movie{suffix}"
        files.write_movie(path, [bright_movie.movie], bright_movie.movie.shape, np.uint16, model=bright_model, seed=3)
        (layer,) = viewer.open(str(path), plugin="napari-mufasa")
        stored = layer.metadata["napari_mufasa"]
        assert stored["model"] == bright_model.to_dict() and stored["seed"] == 3
        assert not isinstance(layer.data, np.ndarray)
        assert np.array_equal(np.asarray(layer.data), bright_movie.movie)
        assert layer.scale[-1] == pytest.approx(0.1)
        assert str(layer.units[-1]) == "micrometer"


def test_reader_leaves_foreign_files_alone(tmp_path):
    import tifffile
    import zarr

    plain, foreign_ome, stack = tmp_path / "plain.tif", tmp_path / "their.ome.tif", tmp_path / "theirs.zarr"
    tifffile.imwrite(plain, np.zeros((3, 8, 8), np.uint16))
    tifffile.imwrite(foreign_ome, np.zeros((3, 8, 8), np.uint16), ome=True)
    zarr.create_array(store=str(stack), shape=(3, 8, 8), dtype="uint16")
    broken = tmp_path / "broken.tif"
    broken.write_bytes(b"no picture")
    for path in (plain, foreign_ome, stack, broken, tmp_path / "missing.tif", tmp_path):
        assert get_reader(str(path)) is None
    assert get_reader([str(plain), str(plain)]) is None


def test_layer_saved_and_read_again_is_the_same_movie(tmp_path, with_movie, bright_model, bright_movie):
    layer = with_movie.layers["bright"]
    for suffix in (".ome.tif", ".zarr"):
        path = str(tmp_path / f"saved{suffix}")
        assert layer.save(path, plugin="napari-mufasa") == [path]
        data, options, _ = read_layers(path)[0]
        assert np.array_equal(np.asarray(data), bright_movie.movie)
        assert options["metadata"]["napari_mufasa"]["model"] == bright_model.to_dict()


@pytest.mark.parametrize("key", ["palm", "storm", "ff", "blinking"])
def test_samples_open_with_their_model(viewer, key):
    (layer,) = viewer.open_sample("napari-mufasa", key)
    model = layer.metadata["napari_mufasa"]["model"]
    assert model["protocol"].lower() == key
    assert layer.data.shape == (model["acquisition"]["n_frames"], *model["acquisition"]["shape_px"])
    # A sample shows molecules: most of them are found.
    found = extract_traces(layer.data, Model.from_dict(model).camera).molecules
    assert len(found) > model["sample"]["n_molecules"] / 2


def test_the_samples_of_step_data_are_those_that_napari_lists(manifest):
    from napari_mufasa.samples import SAMPLES

    makers = {command.id: command.python_name for command in manifest.contributions.commands}
    listed = {sample.key: makers[sample.command] for sample in manifest.contributions.sample_data}
    assert listed == {key: f"napari_mufasa.samples:{make.__name__}" for key, (_, make) in SAMPLES.items()}


def test_samples_dark_frames_are_taken_and_never_the_movie(viewer):
    from napari_mufasa.widgets.turns.session import session_of

    # Through the manifest, because napari then hands out a proxy of the viewer.
    _, workflow = viewer.window.add_plugin_dock_widget("napari-mufasa", "MUFASA workflow")
    session = session_of(viewer)
    assert workflow.session is session
    form = workflow.step("Data").form
    dark, movie = viewer.open_sample("napari-mufasa", "hidden_effect")
    assert session.movie_layer is movie
    assert session.dark_layer is dark
    assert form.dark.value is dark
    viewer.layers.remove(dark)
    assert session.dark_layer is None
    assert session.measurement().dark is None


def test_hidden_effect_sample_tells_the_belief_and_not_the_truth(viewer):
    dark, movie = viewer.open_sample("napari-mufasa", "hidden_effect")
    stored = movie.metadata["napari_mufasa"]
    assert stored["model"]["effects"] == []
    assert stored["seed"] is None  # with it, the truth could be simulated
    assert dark.data.shape[1:] == movie.data.shape[1:]
    # No light in the dark frames: they sit at the baseline, the movie above it.
    assert abs(dark.data.mean() - stored["model"]["camera"]["baseline_adu"]) < 5
    assert movie.data.mean() > dark.data.mean() + 50


def test_preferences_are_those_of_the_manifest_and_are_obeyed(viewer):
    from importlib.resources import files

    import yaml
    from napari.settings import get_plugin_settings

    from napari_mufasa.widgets.parts.preferences import preference
    from napari_mufasa.widgets.steps.traces import MoleculesPanel

    manifest = yaml.safe_load((files("napari_mufasa") / "napari.yaml").read_text(encoding="utf-8"))
    declared = {
        f"{group}.{name}": setting["default"]
        for group, settings in manifest["contributions"]["configurations"].items()
        for name, setting in settings["properties"].items()
    }
    assert len(declared) >= 6
    assert all(preference(name, None) == default for name, default in declared.items())
    assert preference("steps.of_no_kind", 5) == 5
    settings = get_plugin_settings("napari-mufasa")
    settings.steps.threshold_sigma = 9.5
    try:
        panel = MoleculesPanel(viewer)
        viewer.window.add_dock_widget(panel)
        assert panel.form.threshold_sigma.value == 9.5
    finally:
        settings.steps.threshold_sigma = 6.0
    with pytest.raises(ValueError):
        settings.steps.threshold_sigma = 1.0  # below the least that makes sense
