"""What leaves the repository: one version, a wheel with all that is needed and nothing else, metadata that holds."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
import zipfile

import yaml
from tests.docs.blocks import ROOT

import napari_mufasa as nm

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
RECIPE = ROOT / "packaging" / "conda" / "recipe.yaml"


def test_the_version_stands_in_one_place():
    assert "version" in PROJECT["project"]["dynamic"] and "version" not in PROJECT["project"]
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == nm.__version__
    assert yaml.safe_load(RECIPE.read_text())["context"]["version"] == nm.__version__


def test_the_citation_has_what_the_format_requires():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert {"cff-version", "message", "title", "authors"} <= set(cited)
    for work in (cited, *cited["references"]):
        assert work["title"] and all("name" in a or "family-names" in a for a in work["authors"])
    told = (ROOT / "docs" / "words.md").read_text()
    assert all(work["doi"] in told for work in cited["references"])


def test_the_recipe_asks_for_what_the_package_needs():
    names = {"dask[array]": "dask-core", "matplotlib": "matplotlib-base"}
    needed = {}
    for line in PROJECT["project"]["dependencies"]:
        name, bound = re.fullmatch(r"([\w.\[\]-]+?)(>=.+)?", line).groups()
        needed[names.get(name, name).lower()] = bound or ""
    run = [
        re.fullmatch(r"(\S+)( .+)?", line).groups()
        for line in yaml.safe_load(RECIPE.read_text())["requirements"]["run"]
    ]
    assert {name: (bound or "").strip() for name, bound in run if name != "python"} == needed


def test_what_napari_and_its_hub_read():
    assert "Framework :: napari" in PROJECT["project"]["classifiers"]
    manifest = yaml.safe_load((ROOT / "src" / "napari_mufasa" / "napari.yaml").read_text())
    assert manifest["name"] == PROJECT["project"]["name"] and manifest["categories"]
    from npe2 import PluginManifest

    assert PluginManifest(**manifest).contributions.widgets


def test_workflows_run_what_is_there():
    made = "".join(path.read_text() for path in (ROOT / ".github" / "workflows").glob("*.yml"))
    for path in (ROOT / ".github").rglob("*.yml"):
        assert yaml.safe_load(path.read_text())
    for extra in re.findall(r"\.\[([\w,]+)\]", made):
        assert set(extra.split(",")) <= set(PROJECT["project"]["optional-dependencies"])
    for system in ("ubuntu", "macos", "windows"):
        assert system in made
    assert all(f'"3.{minor}"' in made for minor in (11, 12, 13))
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert set(re.findall(r"run: make (\w+)", made)) <= set(targets)


def test_the_wheel_has_the_package_and_nothing_else(tmp_path):
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)],
        cwd=ROOT, check=True, capture_output=True,
    )  # fmt: skip
    (wheel,) = tmp_path.glob(f"napari_mufasa-{nm.__version__}-py3-none-any.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {n.split("/")[0] for n in names} == {"napari_mufasa", f"napari_mufasa-{nm.__version__}.dist-info"}
    wanted = [p for p in (ROOT / "src" / "napari_mufasa").rglob("*") if p.is_file() and "__pycache__" not in p.parts]
    missing = {p.relative_to(ROOT / "src").as_posix() for p in wanted} - names
    assert not missing
