"""An effect of another installed package, end to end: the entry point, the command line, the fit (docs/effects.md)."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import tifffile
from tests.blind import generator

PACKAGE = Path(__file__).resolve().parents[1] / "plugin_package"


def install(target: Path) -> None:
    """What pip leaves behind: the package and its dist-info, with the entry points that pyproject.toml names.

    By hand, because building a wheel needs tools that a test cannot fetch without a network.
    """
    project = tomllib.loads((PACKAGE / "pyproject.toml").read_text())["project"]
    shutil.copytree(PACKAGE / "mufasa_shutter", target / "mufasa_shutter", ignore=shutil.ignore_patterns("__pycache__"))
    about = target / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    lines = []
    for group, points in project["entry-points"].items():
        lines += [f"[{group}]", *(f"{name} = {value}" for name, value in points.items())]
    (about / "entry_points.txt").write_text("\n".join(lines) + "\n")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Run the command line in a process that sees the installed package."""
    target = tmp_path_factory.mktemp("site")
    install(target)

    def command(*arguments: object) -> str:
        environment = os.environ | {"PYTHONPATH": str(target)}
        done = subprocess.run(
            [sys.executable, "-m", "napari_mufasa", *map(str, arguments)],
            env=environment, capture_output=True, text=True,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return done.stdout

    return command


def test_the_effect_is_listed_after_the_built_in_ones(run):
    lines = run("presets", "--effects").splitlines()
    assert len(lines) == 1 + 35 + 1
    assert lines[-1].split()[0] == "slow_shutter"
    assert "missing=0.5" in lines[-1]


@pytest.mark.slow
def test_simulated_saved_and_fitted_by_the_command_line(run, tmp_path):
    model = generator.base_model("emccd") | {"sample": {"n_molecules": 12, "min_distance_px": 9}}
    model["acquisition"] |= {"n_frames": 80, "shape_px": [48, 48]}
    (tmp_path / "model.json").write_text(json.dumps(model))
    shared = ("--model", tmp_path / "model.json", "--seed", 3)
    run("simulate", *shared, "--out", tmp_path / "plain.tif")
    run("simulate", *shared, "--out", tmp_path / "dim.tif", "--effect", "slow_shutter:missing=0.6,opening_s=0.4")
    plain, dim = (tifffile.imread(tmp_path / f"{name}.tif").astype(float) - 200 for name in ("plain", "dim"))
    course = dim.mean(axis=(1, 2)) / plain.mean(axis=(1, 2))
    assert course[0] == pytest.approx(0.4, abs=0.05)
    assert course[-20:].mean() == pytest.approx(1.0, abs=0.02)

    run("refine", tmp_path / "dim.tif", *shared, "--add", "slow_shutter", "--out", tmp_path / "refined")
    report = json.loads((tmp_path / "refined" / "report.json").read_text())
    fitted = next(effect for effect in report["model"]["effects"] if effect["kind"] == "slow_shutter")
    assert fitted["missing"] == pytest.approx(0.6, abs=0.15)
    assert report["error"]["after"] < 0.8 * report["error"]["before"]
