"""The house stands: imports run one way, from the widgets down to the physics, and never in a circle."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.house.imports import arrows, between_rooms, circles, upward

import napari_mufasa

ROOT = Path(napari_mufasa.__file__).parent


@pytest.fixture(scope="module")
def graph():
    found = arrows(ROOT)
    assert len(found) > 100 and sum(map(len, found.values())) > 300  # the house was really read
    return found


def test_no_file_is_in_a_circle(graph):
    assert circles(graph) == []


def test_no_folder_is_in_a_circle(graph):
    assert circles(between_rooms(graph)) == []


def test_every_import_goes_down(graph):
    assert upward(graph) == []


def test_the_physics_knows_the_set_up_only(graph):
    physics = ("photophysics", "optics", "camera")
    of_models = {t for name, targets in graph.items() if name.split(".")[0] in physics for t in targets}
    assert {t for t in of_models if t.startswith("model")} == {"model.setup"}


def test_qt_and_napari_stay_in_the_widgets():
    elsewhere = [
        str(path.relative_to(ROOT))
        for path in ROOT.rglob("*.py")
        if path.relative_to(ROOT).parts[0] != "widgets"
        and any(line.split()[:2][1:] and line.split()[1].split(".")[0] in ("qtpy", "napari", "magicgui", "superqt")
                for line in path.read_text().splitlines() if line.lstrip().startswith(("import ", "from ")))
    ]  # fmt: skip
    assert elsewhere in ([], ["cli/demo.py"])  # the demo opens the viewer


@pytest.fixture
def small_house(tmp_path):
    for name, text in {
        "__init__": "", "errors": "", "model/__init__": "",
        "model/setup": "from napari_mufasa.errors import MufasaError",
        "camera/__init__": "from .detector import expose", "camera/detector": "from napari_mufasa.model import setup",
    }.items():  # fmt: skip
        path = tmp_path / f"{name}.py"
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    return tmp_path


def test_the_small_house_stands(small_house):
    graph = arrows(small_house)
    assert graph["camera.detector"] == {"model.setup"} and graph["camera"] == {"camera.detector"}
    assert circles(graph) == [] and upward(graph) == []


@pytest.mark.parametrize(
    "text",
    [
        "from napari_mufasa.camera.detector import expose",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from napari_mufasa.camera import detector",
        "def late():\n    import napari_mufasa.camera.detector",
        "def late():\n    from ..camera.detector import expose",
    ],
)
def test_a_circle_is_seen_however_it_is_imported(small_house, text):
    (small_house / "model" / "setup.py").write_text(text)
    graph = arrows(small_house)
    assert circles(graph) == [["camera.detector", "model.setup"]]
    assert upward(graph) == ["model.setup -> camera.detector"]


def test_an_import_upwards_is_seen_without_a_circle(small_house):
    (small_house / "errors.py").write_text("from napari_mufasa.camera.detector import expose")
    (small_house / "model" / "setup.py").write_text("")
    graph = arrows(small_house)
    assert circles(graph) == [] and upward(graph) == ["errors -> camera.detector"]
