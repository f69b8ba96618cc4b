"""The page "write your own effect" (docs/your_effect.md), followed from its first line to its last: the package, the
command line, the movie, and discovery, which finds the effect."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
import tifffile
from tests.blind import generator
from tests.docs.blocks import ROOT, blocks_of, commands_of, file_of

PAGE = ROOT / "docs" / "your_effect.md"
MODULE = "mufasa_room_light/__init__.py"


def install(target: Path) -> None:
    """What pip leaves behind: the package and its dist-info, with the entry points that pyproject.toml names.

    By hand, because building a wheel needs tools that a test cannot fetch without a network.
    """
    (target / MODULE).parent.mkdir()
    (target / MODULE).write_text(file_of(PAGE, MODULE))
    settings = tomllib.loads(file_of(PAGE, "pyproject.toml"))
    project = settings["project"]
    assert settings["tool"]["setuptools"]["packages"] == [Path(MODULE).parent.name]
    about = target / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    lines = []
    for group, points in project["entry-points"].items():
        lines += [f"[{group}]", *(f"{name} = {value}" for name, value in points.items())]
    (about / "entry_points.txt").write_text("\n".join(lines) + "\n")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Run Python in a process that sees the installed package, in a folder of its own."""
    target, folder = tmp_path_factory.mktemp("site"), tmp_path_factory.mktemp("work")
    install(target)
    own = os.environ.get("PYTHONPATH", "")

    def command(*arguments: object) -> str:
        environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(target), *own.split(os.pathsep)])}
        done = subprocess.run(
            [sys.executable, *map(str, arguments)], env=environment, cwd=folder, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    command.folder, command.target = folder, target
    return command


def test_the_page_is_followed_to_the_letter(run):
    """Its commands, then its script; what the page promises is what comes out."""
    install_by_pip, shell = (b for b in blocks_of(PAGE) if b.language == "bash")
    assert install_by_pip.code == "pip install -e .\n"
    listed, preset, simulate = commands_of(shell.code)
    lines = run("-m", *listed.replace("napari-mufasa", "napari_mufasa").split()).splitlines()
    assert len(lines) == 1 + 37 + 1 and lines[-1].split()[0] == "room_light" and "amplitude=0.3" in lines[-1]
    words, _, name = preset.partition(" > ")
    (run.folder / name).write_text(run("-m", *words.replace("napari-mufasa", "napari_mufasa").split()))
    run("-m", *simulate.replace("napari-mufasa", "napari_mufasa").split())
    flickering = tifffile.imread(run.folder / "flickering.ome.tif").mean(axis=(1, 2))
    strongest = 1 + np.abs(np.fft.rfft(flickering - flickering.mean()))[1:].argmax()
    assert len(flickering) / strongest == pytest.approx(12, rel=0.1)  # frames: the default of the page's class

    (script,) = (b.code for b in blocks_of(PAGE) if b.language == "python" and not b.title)
    answer = "print(json.dumps([report.verdict, report.chosen, report.model.to_dict(), report.error]))"
    said = run("-c", f"import json\n{script}{answer}")
    verdict, chosen, model, error = json.loads(said.splitlines()[-1])
    assert (verdict, chosen) == ("missing_effect", ["room_light"])
    (found,) = model["effects"]
    # Of three seeds the amplitude was within 3.1 % and the period within 0.6 %.
    assert found["amplitude"] == pytest.approx(0.4, rel=0.15)
    assert found["period_frames"] == pytest.approx(12, rel=0.04)
    assert error["after"] < 0.5 * error["before"] and error["after"] < 1.35 * error["floor"]


def test_the_table_of_the_scene_is_the_scene():
    """Every attribute that the page tells of is one, and every public one is told."""
    from napari_mufasa.simulate.scene import Scene

    section = PAGE.read_text(encoding="utf-8").split("## What a scene has")[1]
    told = {
        name for row in section.splitlines() if row.startswith("| `") for name in row.split("|")[1].split("`")[1::2]
    }
    properties = {name for name, value in vars(Scene).items() if isinstance(value, property)}
    assert told <= set(Scene.__dataclass_fields__) | properties
    assert set(Scene.__dataclass_fields__) - {"streams"} <= told


@pytest.mark.slow
def test_simulated_saved_and_fitted_by_the_command_line(run, tmp_path):
    model = generator.base_model("emccd") | {"sample": {"n_molecules": 8, "min_distance_px": 8}}
    model["acquisition"] |= {"n_frames": 60, "shape_px": [40, 40]}
    (tmp_path / "model.json").write_text(json.dumps(model))
    shared, mufasa = ("--model", tmp_path / "model.json", "--seed", 3), ("-m", "napari_mufasa")
    movie = tmp_path / "swinging.tif"
    run(*mufasa, "simulate", *shared, "--out", movie, "--effect", "room_light:amplitude=0.5,period_frames=10")
    run(*mufasa, "refine", movie, *shared, "--add", "room_light", "--out", tmp_path / "refined")
    report = json.loads((tmp_path / "refined" / "report.json").read_text())
    fitted = next(effect for effect in report["model"]["effects"] if effect["kind"] == "room_light")
    assert fitted["amplitude"] == pytest.approx(0.5, abs=0.1)
    assert report["error"]["after"] < 0.8 * report["error"]["before"]
