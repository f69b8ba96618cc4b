"""Every step as a script uses it: a magicgui widget made without a dock or a viewer, set by attribute, called."""

from __future__ import annotations

import inspect
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from magicgui.type_map._magicgui import MagicFactory
from magicgui.widgets import CheckBox, ComboBox, FunctionGui
from napari.layers import Image, Layer, Points, Tracks

import napari_mufasa.widgets as widgets
from napari_mufasa.effects import catalogue
from napari_mufasa.errors import MufasaError
from napari_mufasa.model.model import Model
from napari_mufasa.model.presets import preset
from napari_mufasa.report.fields import bounds_of, unit_of
from napari_mufasa.widgets.parts.edits import MapEdit, TypedEdit
from napari_mufasa.widgets.parts.forms import PartForm

STEPS = ("simulate", "denoise", "traces", "compare", "discover", "calibrate", "propose", "register", "design", "power")


@pytest.fixture(autouse=True)
def _application(qapp):
    """Widgets need Qt's application, not napari's viewer."""


def factory(step):
    return getattr(widgets, f"{step}_widget")


def function(step):
    return getattr(import_module(f"napari_mufasa.widgets.steps.{step}"), step)


@pytest.fixture
def layer(bright_movie, bright_model):
    """A movie as a layer of no viewer, its model in the metadata."""
    return Image(
        bright_movie.movie, name="bright", scale=(1, 0.1, 0.1), units=("pixel", "um", "um"),
        metadata={"napari_mufasa": {"model": bright_model.to_dict()}},
    )  # fmt: skip


def ours(layer):
    return layer.metadata["napari_mufasa"]


# all steps ------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("step", STEPS)
def test_asdict_gives_the_parameters_of_the_function_and_their_defaults(step):
    assert isinstance(factory(step), MagicFactory)  # magicgui's own
    widget = factory(step)()
    assert isinstance(widget, FunctionGui) and widget.__wrapped__ is function(step)
    parameters = inspect.signature(function(step)).parameters
    shown = widget.asdict()
    assert list(shown) == list(parameters)
    for name, parameter in parameters.items():
        wanted = None if parameter.default is parameter.empty else parameter.default
        assert shown[name] == wanted, name
        assert widget[name].tooltip or isinstance(widget[name], CheckBox), f"{name} has no tooltip"


@pytest.mark.parametrize("step", ["denoise", "traces", "compare", "discover", "calibrate", "propose"])
def test_a_step_without_its_movie_says_so(step):
    with pytest.raises((MufasaError, TypeError), match="movie"):
        factory(step)()()


def test_what_is_no_layer_is_refused():
    with pytest.raises(MufasaError, match=r"napari\.layers\.Image"):
        widgets.denoise_widget().movie.value = np.zeros((3, 4, 4))


@pytest.mark.parametrize("step", STEPS)
def test_the_documented_parameters_are_those_of_the_function(step):
    page = (Path(__file__).parents[2] / "docs" / "viewer.md").read_text(encoding="utf-8")
    row = next(line for line in page.splitlines() if line.startswith(f"| `{step}_widget`"))
    told = [name.split(" (")[0].strip() for name in row.split("|")[2].split(",")]
    assert told == list(inspect.signature(function(step)).parameters)


def test_importing_the_package_stays_cheap():
    code = "import sys, napari_mufasa.widgets; assert not {'qtpy', 'napari', 'magicgui'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
    with pytest.raises(AttributeError, match="denoise_widget"):
        widgets.nothing_of_the_kind  # noqa: B018


# each step against the library ----------------------------------------------------------------------------
def test_simulate(bright_model):
    from napari_mufasa.simulate.movie import simulate

    widget = widgets.simulate_widget()
    widget.model.value = bright_model
    widget.seed.value = 7
    widget.optical.value = True
    photons, movie, places = widget()
    wanted = simulate(bright_model, seed=7)
    assert np.array_equal(movie.data, wanted.movie) and np.array_equal(photons.data, wanted.optical)
    assert np.allclose(places.data, wanted.positions_px) and isinstance(places, Points)
    assert ours(movie) == {"model": bright_model.to_dict(), "seed": 7}
    widget.molecules.value = Points([[10.0, 20.0], [30.0, 40.0]])
    assert np.array_equal(widget()[-1].data, [[10.0, 20.0], [30.0, 40.0]])


def test_denoise(layer, bright_movie, bright_model):
    from napari_mufasa.denoise import denoise

    widget = widgets.denoise_widget()
    widget.movie.value = layer
    widget.method.value = "pure-let"
    widget.residual.value = True
    taken, photons = widget()
    wanted = denoise(bright_movie.movie, bright_model.camera, method="pure-let")
    assert isinstance(photons, Image) and np.array_equal(photons.data, wanted)
    assert tuple(photons.scale) == tuple(layer.scale) and photons.units == layer.units
    assert taken.data.shape == photons.data.shape
    assert widget(method="none")[-1].name == "bright, photons"  # as the function is called


def test_denoise_leaves_out_the_dark_frames_and_stays_in_place(layer, bright_movie, bright_model):
    widget = widgets.denoise_widget()
    widget.movie.value, widget.dark_frames.value, widget.method.value = layer, 10, "none"
    (photons,) = widget()
    assert photons.data.shape[0] == bright_movie.movie.shape[0] - 10
    assert photons.translate[0] == 10


def test_denoise_takes_a_single_image(bright_movie, bright_model):
    widget = widgets.denoise_widget()
    widget.movie.value = Image(bright_movie.movie[0], scale=(0.1, 0.1), units=("um", "um"))
    widget.model.value, widget.method.value = bright_model, "none"
    (photons,) = widget()
    assert photons.data.shape == (1, 48, 64) and tuple(photons.scale) == (1, 0.1, 0.1)


def test_traces(layer, bright_movie, bright_model):
    from napari_mufasa.traces import extract_traces

    widget = widgets.traces_widget()
    widget.movie.value = layer
    widget.model.value = bright_model
    widget.window.value, widget.best.value = 20, 4
    (points,) = widget()
    wanted = extract_traces(bright_movie.movie, bright_model.camera, window=20, best=4)
    assert isinstance(points, Points)
    assert np.array_equal(ours(points)["traces"].traces, wanted.traces)
    assert list(points.features["kept"]) == list(wanted.molecules["kept"])
    assert np.allclose(points.data, wanted.positions_px)


def test_compare(layer, bright_movie, bright_model):
    from napari_mufasa.compare import compare_movie

    widget = widgets.compare_widget()
    widget.movie.value, widget.fit.value, widget.seed.value = layer, False, 3
    (points,) = widget()
    wanted = compare_movie(bright_movie.movie, bright_model, seed=3, fit=False)
    assert ours(points)["comparison"].w1 == wanted.w1
    assert len(points.data) == len(wanted.measured.molecules)


def test_calibrate_and_design(layer, bright_movie, bright_model):
    from napari_mufasa.calibrate import calibrate
    from napari_mufasa.design import design

    widget = widgets.calibrate_widget()
    assert widget.camera_type.value is None and widget.camera_type.native.currentText() == "as the counts tell"
    widget.movie.value, widget.baseline_adu.value, widget.read_noise_adu.value = layer, 367.0, 82.0
    found, wanted = widget(), calibrate(bright_movie.movie, baseline_adu=367.0, read_noise_adu=82.0)
    assert found.camera == wanted.camera
    assert found.slope_adu == wanted.slope_adu and found.notes == wanted.notes
    widget = widgets.design_widget()
    widget.movie.value = layer
    widget.vary.value, widget.values.value = "camera.em_gain", (100.0, 300.0)
    pd.testing.assert_frame_equal(widget(), design(bright_model, {"camera.em_gain": [100.0, 300.0]}))
    widget.vary.value, widget.values.value = "acquisition.n_frames", (100.0,)
    assert widget()["acquisition.n_frames"].tolist() == [100]  # a whole number


@pytest.mark.slow
def test_power(layer, bright_model):
    from napari_mufasa.discover import power

    widget = widgets.power_widget()
    widget.movie.value = layer
    widget.effect.value, widget.strengths.value = "stage_drift", (0.01, 4.0)
    widget.movies.value, widget.recorded_dark.value = 4, 10
    found = widget()
    wanted = power(bright_model, catalogue()["stage_drift"](), (0.01, 4.0), movies=4, dark_frames=10)
    pd.testing.assert_frame_equal(found, pd.DataFrame([one.row() for one in wanted]))
    assert found["evidence"][1] > found["evidence"][0]


@pytest.mark.slow
def test_discover_gives_the_report_and_its_layers(bright_model):
    from napari_mufasa import samples
    from napari_mufasa.discover import diagnose
    from napari_mufasa.effects import effect_from_data
    from napari_mufasa.simulate.movie import simulate

    believed = samples.puzzle_model().with_values(
        {"acquisition.n_frames": 100, "acquisition.shape_px": (48, 48), "sample.n_molecules": 20}
    )
    truth = believed.with_effects(effect_from_data({"kind": "stage_drift", "distance_px": 4.0}))
    recorded = simulate(truth, seed=4).movie
    widget = widgets.discover_widget()
    widget.movie.value = Image(recorded, name="drifting")
    widget.model.value = believed
    widget.effects.value = ("stage_drift",)
    widget.max_effects.value = 1
    simulated, place, molecules = widget()
    wanted = diagnose(recorded, believed, seed=1, effects=["stage_drift"], max_effects=1)
    report = ours(simulated)["report"]
    assert list(report.chosen) == list(wanted.chosen) == ["stage_drift"]
    assert report.error == wanted.error
    assert Model.from_dict(ours(simulated)["model"]) == report.model
    assert simulated.data.shape == recorded.shape and place.data.shape[-2:] == (48, 48)
    assert len(molecules.data) == len(ours(simulated)["places"].molecules)
    widget.max_effects.value = 0  # only look
    found = ours(widget()[0])
    assert not found["report"].chosen and found["report"].ranking[0].effect == "stage_drift"
    assert found["investigation"].chosen == found["report"].chosen


# with a viewer --------------------------------------------------------------------------------------------
def test_with_a_viewer_the_choices_are_those_of_all_steps(with_movie, bright_model):
    from napari_mufasa.widgets.turns.session import session_of

    session = session_of(with_movie)
    widget, other = widgets.traces_widget(), widgets.compare_widget()
    for made in (widget, other):
        with_movie.window.add_dock_widget(made)
    assert widget.movie.value is session.movie_layer and widget.model.value == bright_model
    dark = with_movie.add_image(np.zeros((5, 48, 64)), name="dark", contrast_limits=(0, 1))
    dark.metadata["napari_mufasa"] = {"role": "dark frames"}
    with_movie.layers[0].name = "renamed"  # the list follows, the choice stays
    assert [layer.name for layer in widget.movie.choices] == ["renamed"]
    assert widget.movie.value is with_movie.layers["renamed"]
    widget.dark.value = dark
    assert other.dark.value is session.dark_layer is dark
    other.model.value = preset("PALM")
    assert widget.model.value == session.model == preset("PALM")
    (points,) = widget(model=bright_model)
    assert points in with_movie.layers  # napari's own way with what magicgui returns
    with_movie.layers.remove(dark)
    assert other.dark.value is None


@pytest.mark.parametrize("given", ["FF", preset("FF"), preset("FF").to_dict()], ids=["name", "model", "data"])
def test_a_model_is_given_in_any_form(given):
    widget = widgets.simulate_widget()
    widget.model.value = given
    assert widget.model.value == preset("FF")
    widget.model.value = None
    assert widget.model.value is None


def test_a_model_is_read_from_its_file(tmp_path, bright_model):
    bright_model.to_json(tmp_path / "model.json")
    widget = widgets.simulate_widget()
    widget.model.value = tmp_path / "model.json"
    assert widget.model.value == bright_model
    with pytest.raises(MufasaError, match=r"nowhere\.json"):
        widget.model.value = tmp_path / "nowhere.json"


# forms of models ------------------------------------------------------------------------------------------
PARTS = {
    name: getattr(preset("FF"), name)
    for name in ("acquisition", "fluorophore", "excitation", "optics", "camera", "sample")
}


def kind_for(field) -> type:
    """The widget that a field must have, from its type as it is written."""
    text = str(field.annotation)
    if "Literal" in text:
        return ComboBox
    return MapEdit if field.annotation is Any else TypedEdit


@pytest.mark.parametrize(
    "values", [*PARTS.values(), *(e() for e in catalogue().values())], ids=lambda v: type(v).__name__
)
def test_every_part_and_effect_has_its_form(values):
    owner = type(values)
    form = PartForm(owner, lambda name, value: None)
    assert list(form.asdict()) == list(owner.model_fields)
    form.show_values(values)
    for name, field in owner.model_fields.items():
        assert type(form[name]) is kind_for(field), name
        assert form[name].value == getattr(values, name) or form[name].value is getattr(values, name)
        unit = unit_of(name, owner)
        assert not unit or f"({unit})" in form[name].label, name
        tip = form[name].tooltip
        assert not field.description or field.description in tip
        assert not bounds_of(field) or f"allowed: {bounds_of(field)}" in tip
        assert form[name].native.accessibleName()
    assert owner.model_validate(form.asdict()) == values or owner.__name__ == "Camera"


def test_numbers_are_typed_in_any_notation_and_told_once():
    told = []
    form = PartForm(type(PARTS["fluorophore"]), lambda name, value: told.append(name))
    form.show_values(PARTS["fluorophore"])

    def typed(name, text):
        form[name].native.setText(text)
        form[name].native.editingFinished.emit()
        return form[name].value

    assert typed("lifetime_s", "2.6e-9") == 2.6e-9
    assert typed("lifetime_s", "0,003") == 0.003
    assert typed("isc_ratio", "") is None  # null: off
    assert told == ["lifetime_s", "lifetime_s", "isc_ratio"]
    with pytest.raises(MufasaError, match="lifetime_s"):
        typed("lifetime_s", "")
    with pytest.raises(MufasaError, match="number"):
        typed("lifetime_s", "soon")
    form["lifetime_s"].value = 1.23456789e-9
    assert form["lifetime_s"].value == 1.23456789e-9  # also the digits that are not shown
    widget = widgets.traces_widget()
    widget.window.native.setText("0")
    with pytest.raises(MufasaError, match="greater than 0"):
        widget.asdict()


def test_a_map_is_a_file_or_an_array(tmp_path):
    form = PartForm(type(PARTS["camera"]), lambda name, value: None, ("gain_map",))
    assert form["gain_map"].value is None
    values = np.ones((4, 6))
    form["gain_map"].value = values
    assert form["gain_map"].value is values and form["gain_map"].line_edit.value == "4 × 6 map"
    form["gain_map"].line_edit.native.setText(str(tmp_path / "map.tif"))
    assert form["gain_map"].value == str(tmp_path / "map.tif")


def test_every_layer_that_a_step_gives_can_be_shown(viewer, layer):
    widget = widgets.denoise_widget()
    widget.movie.value = layer
    widget.method.value = "none"
    layers = widget()
    assert all(isinstance(made, Layer) for made in layers)
    assert layers[0] in viewer.layers


def test_molecules_that_are_followed_come_with_their_paths(layer, bright_movie, bright_model):
    from napari_mufasa.traces import extract_traces

    widget = widgets.traces_widget()
    widget.movie.value, widget.model.value = layer, bright_model
    widget.dark_frames.value, widget.follow_molecules.value = 3, True  # three dark frames: the movie begins with 4
    points, tracks = widget()
    wanted = extract_traces(
        bright_movie.movie[4:],
        bright_model.camera,
        bright_movie.movie[:3],
        follow_molecules=True,
        threshold_value=6.0,
        min_snr=1.0,
    )
    table = wanted.molecules[wanted.kept]
    assert isinstance(points, Points) and isinstance(tracks, Tracks)
    assert np.allclose(points.data, wanted.positions_px)
    assert sorted(set(tracks.data[:, 0].astype(int))) == sorted(table["molecule"])
    one = table.iloc[0]
    rows = tracks.data[tracks.data[:, 0] == one["molecule"]]
    assert len(rows) == one["last_found"] - one["first_found"] + 1
    assert np.allclose(rows[:, 2:], wanted.path_px[one["molecule"], one["first_found"] : one["last_found"] + 1])
    assert tuple(tracks.scale) == (1, 0.1, 0.1) and tracks.translate[0] == 4
