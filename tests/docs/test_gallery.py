"""The scripts of the gallery run, in small, and draw every picture that the pages show."""

from __future__ import annotations

import re
import runpy
import sys

import pytest
from PIL import Image
from tests.docs.blocks import ROOT

import napari_mufasa as nm

GALLERY = ROOT / "docs" / "gallery"
SCRIPTS = {
    "protocols": {f"protocol-{name}.png" for name in ("ff", "storm", "palm", "blinking")},
    "runtime": {"runtime.png"},
    "distances": {"distances.png"},
    "trial": {"trial.png"},
    "real": {"real.png"},
    "fingerprints": {
        f"{k}.png" for k, e in nm.catalogue().items() if e.__module__.startswith("napari_mufasa.effects.")
    },
}


def test_every_script_is_on_the_page_and_in_the_makefile():
    scripts = {path.stem for path in GALLERY.glob("*.py")} - {"drawing"}
    assert scripts == set(SCRIPTS)
    page, makefile = (ROOT / "docs" / "gallery.md").read_text(), (ROOT / "Makefile").read_text()
    assert all(f"python docs/gallery/{name}.py" in page for name in scripts)
    assert scripts <= set(re.search(r"for script in ([\w ]+);", makefile)[1].split())


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_script_draws_its_pictures(name, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", [name, "--quick", "--out", str(tmp_path)])
    monkeypatch.syspath_prepend(str(GALLERY))
    runpy.run_path(str(GALLERY / f"{name}.py"), run_name="__main__")
    assert {path.name for path in tmp_path.iterdir()} == SCRIPTS[name]
    folder = ROOT / "docs" / "images" / ("effects" if name == "fingerprints" else "gallery")
    for path in tmp_path.iterdir():
        with Image.open(path) as drawn, Image.open(folder / path.name) as kept:
            assert len(drawn.convert("L").getcolors()) > 10  # more than a blank page
            assert abs(kept.width / kept.height - drawn.width / drawn.height) < 0.2  # of the same make


def test_every_picture_is_made_by_a_command():
    scenes = set(re.findall(r'yield "([\w-]+)"', (ROOT / "tools" / "screenshots.py").read_text()))
    drawn = {f"effects/{name}" for name in SCRIPTS["fingerprints"]}
    drawn |= {f"gallery/{name}" for script, names in SCRIPTS.items() if script != "fingerprints" for name in names}
    made = drawn | {f"{scene}-{theme}.png" for scene in scenes for theme in ("dark", "light")}
    images = ROOT / "docs" / "images"
    assert {path.relative_to(images).as_posix() for path in images.rglob("*.*")} == made


def test_no_picture_is_large_or_shown_nowhere():
    pages = "".join(page.read_text(encoding="utf-8") for page in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")])
    for path in (ROOT / "docs" / "images").rglob("*.png"):
        assert path.stat().st_size < 260_000, path.name
        shown = path.relative_to(ROOT / "docs").as_posix() in pages
        assert shown or path.name.endswith("-light.png"), f"{path.name} is on no page"
