"""The pages build as a site without a warning: every link and anchor leads somewhere, every page is in the tree."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys

import pytest
from tests.docs.blocks import ROOT


@pytest.mark.skipif(importlib.util.find_spec("mkdocs") is None, reason="mkdocs is not installed: pip install '.[docs]'")
def test_the_site_builds_without_a_warning(tmp_path):
    settings = {"NO_MKDOCS_2_WARNING": "1", "PYTHONPATH": str(ROOT / "src")}
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")],
        cwd=ROOT, env=os.environ | settings, capture_output=True, text=True,
    )  # fmt: skip
    assert built.returncode == 0, built.stderr
    assert not re.search(r"WARNING|ERROR", built.stderr), built.stderr
    assert (tmp_path / "site" / "api" / "index.html").stat().st_size > 50_000  # the reference is there


def test_the_tree_has_the_four_kinds_of_pages():
    text = (ROOT / "mkdocs.yml").read_text()
    tree = text.split("\nnav:\n")[1]
    assert re.findall(r"^  - ([\w ]+):$", tree, re.MULTILINE)[:4] == ["Tutorials", "How to", "Reference", "Explanation"]
    assert "font: false" in text  # nothing is fetched from the net when a page is read


def test_dois_are_of_one_form():
    for page in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]:
        for label, link in re.findall(r"\[doi:([^\]]+)\]\(([^)]+)\)", page.read_text(encoding="utf-8")):
            assert link.replace("%28", "(").replace("%29", ")") == f"https://doi.org/{label}", page.name
