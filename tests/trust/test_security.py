"""The program runs nothing that it reads, talks to no one, and shows others' words as words."""

from __future__ import annotations

import ast
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from tests.report_example import report
from tests.trust import broken_files

import napari_mufasa
from napari_mufasa import files
from napari_mufasa.errors import MufasaError
from napari_mufasa.report import html as html_report

PACKAGE = Path(napari_mufasa.__file__).parent
ROOT = Path(__file__).parents[2]
SOURCES = sorted(PACKAGE.rglob("*.py"))
#: Modules that run commands, unpickle, or reach the network; and calls that run text.
MODULES = {
    "pickle", "cPickle", "dill", "cloudpickle", "joblib", "marshal", "shelve", "subprocess", "pty", "code", "codeop",
    "socket", "ssl", "http", "urllib", "urllib3", "requests", "httpx", "aiohttp", "ftplib", "smtplib", "telnetlib",
    "xmlrpc", "webbrowser", "fsspec", "ctypes",
}  # fmt: skip
#: What a module needs all the same, and why that reads nothing of a stranger.
GRANTED = {
    # Jobs go to the workers of a cluster that the user opened, as pickles like everything that Dask sends; none comes
    # from a file.
    "cluster/jobs.py": {"imports pickle"},
}
CALLS = {"eval", "exec", "compile", "__import__", "execfile", "breakpoint", "input"}
METHODS = {
    ("os", "system"), ("os", "popen"), ("os", "execv"), ("os", "spawnl"), ("yaml", "load"), ("pd", "read_pickle"),
    ("pandas", "read_pickle"), ("shutil", "unpack_archive"), ("tempfile", "mktemp"),
}  # fmt: skip


def offences(tree: ast.AST) -> list[str]:
    found = []
    for node in ast.walk(tree):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names = [node.module or ""]
        found += [f"line {node.lineno}: imports {name}" for name in names if name.split(".")[0] in MODULES]
        if not isinstance(node, ast.Call):
            continue
        called = node.func
        if isinstance(called, ast.Name) and called.id in CALLS:
            found.append(f"line {node.lineno}: calls {called.id}")
        if isinstance(called, ast.Attribute):
            owner = called.value.id if isinstance(called.value, ast.Name) else ""
            if (owner, called.attr) in METHODS or called.attr in ("extractall", "to_pickle"):
                found.append(f"line {node.lineno}: calls {owner}.{called.attr}")
        found += [f"line {node.lineno}: {word.arg}" for word in node.keywords if _allows(word)]
    return found


def _allows(word: ast.keyword) -> bool:
    """shell=True, allow_pickle=True, autoescape=False and the like."""
    value = word.value.value if isinstance(word.value, ast.Constant) else None
    return (word.arg in ("shell", "allow_pickle", "unsafe") and value is not False) or (
        word.arg == "autoescape" and value is not True
    )


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_module_runs_and_fetches_nothing(path):
    found = {offence.split(": ")[1] for offence in offences(ast.parse(path.read_text(encoding="utf-8")))}
    assert found == GRANTED.get(str(path.relative_to(PACKAGE)), set())


@pytest.mark.parametrize(
    "text",
    ["eval('1')", "import pickle", "from subprocess import run", "os.system('ls')", "np.load(p, allow_pickle=True)",
     "import urllib.request", "run(a, shell=True)", "archive.extractall()", "Environment(autoescape=False)",
     "def f():\n    import socket"],
)  # fmt: skip
def test_an_offence_is_seen(text):
    assert offences(ast.parse(text))


def test_the_templates_let_nothing_through_unescaped():
    for template in PACKAGE.rglob("*.j2"):
        text = template.read_text()
        assert not re.search(r"\|\s*safe|autoescape\s+false|<script|https?://", text), template.name


EVIL = "<script>alert('x')</script>\"&{{ 7*7 }}"


def test_names_of_files_and_layers_are_words_in_the_report(monkeypatch):
    monkeypatch.setattr(html_report, "_picture", lambda drawing: {"light": "", "dark": ""})
    page = html_report.render(report(), title=EVIL, subtitle=f"{EVIL}.tif: 3 frames", extra=[(EVIL, EVIL)])
    assert "<script>" not in page and "&lt;script&gt;" in page and "{{ 7*7 }}" in page


@pytest.mark.parametrize("case", [case for case in broken_files.MOVIES if "pickle" in case or "object" in case])
def test_nothing_is_unpickled(case, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "in").mkdir()
    with pytest.raises(MufasaError):
        files.load(broken_files.MOVIES[case][0](tmp_path / "in"))
    assert not (tmp_path / "UNPICKLED").exists()


def test_paths_are_no_addresses(tmp_path):
    for path in ("http://localhost/m.zarr", "s3://bucket/m.zarr", "file:///etc/hostname", "https://x/m.tif"):
        with pytest.raises(MufasaError, match="no file"):
            files.read_movie(path)


def test_a_model_from_a_movie_opens_no_file(tmp_path):
    from napari_mufasa.model.model import Model

    secret = broken_files.tiff(tmp_path, np.ones((8, 8), np.uint16), "secret.tif")
    data = napari_mufasa.preset("FF").with_values({"acquisition.shape_px": (8, 8)}).to_dict()
    data["camera"]["offset_map_adu"] = str(secret)
    assert Model.from_dict(data).camera.offset_map_adu is not None  # a user's own model may
    with pytest.warns(UserWarning, match="cannot be restored"):
        assert Model.stored_in({"model": data}) is None


def test_an_effect_name_loads_no_module():
    from napari_mufasa.model.model import Model

    plain = napari_mufasa.preset("FF").to_dict()
    for kind in ("os:system", "../../evil", "__import__('os')"):
        with pytest.raises(MufasaError, match="no effect"):
            Model.from_dict({**plain, "effects": [{"kind": kind}]})


def test_every_dependency_is_justified():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    optional = project["optional-dependencies"]
    asked = {
        re.split(r"[\[<>=~!; ]", each)[0].lower()
        for group in (project["dependencies"], *optional.values())
        for each in group
    }
    page = (ROOT / "docs/robustness.md").read_text().split("## Dependencies")[1].split("\n## ")[0]
    told = {name.lower() for name in re.findall(r"^\| `([\w-]+)` \|", page, re.MULTILINE)}
    assert told == asked
