"""The repository explains itself: pages that exist, links that lead somewhere, tables that say what the code does."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import unicodedata
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import typer.main
import yaml
from pydantic_core import PydanticUndefined
from tests.report_example import report

import napari_mufasa as nm
from napari_mufasa import _HOMES
from napari_mufasa.cli.app import app
from napari_mufasa.model import PRESETS, Setup
from napari_mufasa.photophysics.rates import excitation_rate

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.glob("*.md"))
CODE = sorted(f for folder in ("src", "tests", "benchmarks", "tools") for f in (ROOT / folder).rglob("*.py"))
#: Parts of a path ("*": any) where code must not refer to pages that are not in the repository.
EXPLAINED = ("*",)
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")


def text_of(page: str) -> str:
    return (DOCS / page).read_text(encoding="utf-8")


def without_code(text: str) -> str:
    return re.sub(r"```.*?```|`[^`\n]*`", "", text, flags=re.DOTALL)


def rows_of(text: str) -> list[list[str]]:
    """The cells of every row of every table."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    return [[cell.strip().replace("\\|", "|") for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]


@cache
def anchors(page: Path) -> set[str]:
    """Where the headings of a page are, as mkdocs names them."""
    found = set()
    for heading in re.findall(r"^#+ (.+)$", re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL), re.MULTILINE):
        plain = unicodedata.normalize("NFKD", heading.replace("`", "")).encode("ascii", "ignore").decode()
        found.add(re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", plain).strip().lower()))
    return found


# pages and links ------------------------------------------------------------------------------------------
def test_the_navigation_has_every_page_once():
    settings = (ROOT / "mkdocs.yml").read_text()
    listed = re.findall(r": (\S+\.md)$", settings, re.MULTILINE)
    assert sorted(listed) == sorted(page.name for page in PAGES)
    assert yaml.safe_load(settings)["strict"]


@pytest.mark.parametrize("page", [*PAGES, ROOT / "README.md"], ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    links = [link for link in LINK.findall(without_code(page.read_text())) if not re.match(r"https?:", link)]
    for link in links:
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), f"{page.name}: {link}"
        if anchor:
            assert anchor in anchors(target), f"{page.name}: {link}"


def test_code_refers_to_pages_that_exist():
    for file in CODE:
        for page in re.findall(r"\bdocs/[\w/]+\.md", file.read_text()):
            assert (ROOT / page).exists(), f"{file.relative_to(ROOT)} refers to {page}"


def test_code_refers_to_no_page_outside_the_repository():
    # The name is put together, so that this file does not hold what it looks for.
    outside = re.compile(
        rf"\b({'|'.join(('SP' + 'EC', 'DISC' + 'OVERY', 'EFF' + 'ECTS', 'HO' + 'USE', 'RE' + 'AL'))})\.md"
    )
    package = ROOT / "src" / "napari_mufasa"
    explained = [f for f in CODE if "*" in EXPLAINED or any(package / part in f.parents for part in EXPLAINED)]
    assert explained
    for file in explained:
        assert not outside.search(file.read_text()), file.relative_to(ROOT)


# what is printed from the code ----------------------------------------------------------------------------
def test_the_effects_page_is_what_its_script_prints():
    printed = subprocess.run(
        [sys.executable, ROOT / "tools" / "effects_page.py"], capture_output=True, encoding="utf-8", check=True
    )
    assert printed.stdout == text_of("effects.md"), "run: python tools/effects_page.py > docs/effects.md"


def test_the_effects_page_has_every_effect_and_parameter():
    page = text_of("effects.md")
    ours = {k: e for k, e in nm.catalogue().items() if e.__module__.startswith("napari_mufasa.effects.")}
    assert re.findall(r"^### (\w+)$", page, re.MULTILINE) == list(ours)
    for kind, effect in ours.items():
        section = page.split(f"\n### {kind}\n")[1].split("\n### ")[0]
        assert all(f"`{name}`" in section for name in effect.model_fields if name not in ("form", "start"))
        assert all(f"`{form}`" in section for form in effect.forms() if form)


# the reference of Python ----------------------------------------------------------------------------------
@pytest.mark.parametrize(("home", "name"), [(home, name) for home, names in _HOMES.items() for name in names])
def test_every_public_name_is_in_the_reference_and_explained(home, name):
    found = re.findall(rf"^::: (napari_mufasa\.{home}(?:\.\w+)*)\.{name}$", text_of("api.md"), re.MULTILINE)
    assert len(found) == 1, f"docs/api.md has {name} {len(found)} times"
    documented = getattr(import_module(found[0]), name)
    assert documented is getattr(import_module(f"napari_mufasa.{home}"), name)
    assert documented.__doc__ and len(documented.__doc__) > 20


def test_the_reference_has_no_other_name():
    documented = re.findall(r"^::: \S+\.(\w+)$", text_of("api.md"), re.MULTILINE)
    assert sorted(documented) == sorted(nm.__all__)


# the model ------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("part", ["acquisition", "fluorophore", "excitation", "optics", "camera", "sample"])
def test_every_key_of_the_model_is_told_with_its_default(part):
    section = text_of("model.md").split(f"\n### {part}\n")[1].split("\n### ")[0]
    told = {row[0].strip("`"): row[1] for row in rows_of(section)[2:]}
    fields = Setup.model_fields[part].annotation.model_fields
    assert list(told) == list(fields)
    for name, field in fields.items():
        default = "required" if field.default is PydanticUndefined else json.dumps(field.default)
        assert told[name] == default, name


def test_the_table_of_presets_is_the_presets():
    head, _, *rows = rows_of(text_of("model.md").split("\n## Presets\n")[1])
    assert head[1:] == list(PRESETS)
    for path, *cells in rows:
        for name, cell in zip(PRESETS, cells, strict=True):
            assert value_at(nm.preset(name).to_dict(), path.strip("`")) == plain(cell), f"{name} {path}"


def test_what_the_presets_share():
    for name in PRESETS:
        camera, optics = nm.preset(name).camera, nm.preset(name).optics
        assert (camera.quantum_efficiency, camera.clock_induced_charge_e, camera.baseline_adu) == (0.9, 0.002, 367)
        assert (camera.adc_max, optics.background_photons_per_px, optics.collection_efficiency) == (65535, 20, 1)
        assert nm.preset(name).acquisition.pixel_size_nm == 100


def test_the_example_of_a_model_is_one():
    example = re.search(r"```json\n(.*?)```", text_of("model.md"), re.DOTALL)
    assert example is not None
    assert nm.Model.from_dict(json.loads(example[1])).effects[0].kind == "stage_drift"


def value_at(data: dict[str, Any], path: str) -> Any:
    value: Any = data
    for key in path.split("."):
        value = value[key]
    return value


def plain(cell: str) -> Any:
    try:
        return json.loads(cell)
    except ValueError:
        return cell


# numbers --------------------------------------------------------------------------------------------------
def test_the_check_values_of_photophysics():
    told = {
        row[0].split("`")[1]: row[1].replace(" ", "") for row in rows_of(text_of("photophysics.md")) if "ε" in row[0]
    }
    assert list(told) == ["EGFP", "FF", "Alexa647-STORM"]
    for name, value in told.items():
        dye, light = nm.preset(name).fluorophore, nm.preset(name).excitation
        rate = excitation_rate(dye.extinction_coefficient_per_M_cm, light.power_density_w_per_cm2, light.wavelength_nm)
        digits = len(value.partition(".")[2])
        assert f"{rate:.{digits}f}" == value


# command line and files -----------------------------------------------------------------------------------
def test_every_verb_and_option_is_told():
    told = {row[0].strip("`"): row[1] for row in rows_of(text_of("files.md").split("Options, beside")[1])[2:]}
    verbs: Any = typer.main.get_command(app)
    for name, verb in verbs.commands.items():
        options = {o for p in verb.params for o in (*p.opts, *p.secondary_opts) if o.startswith("--")} - {"--help"}
        assert set(re.findall(r"--[a-z0-9-]+", told[name])) == options, f"docs/files.md: {name}"


def test_every_key_of_a_report_is_told():
    made = report().to_dict()
    rows = rows_of(text_of("files.md").split("## report.json of a diagnosis")[1].split("\n## ")[0])
    told = {key for row in rows for key in re.findall(r"`(\w+)`", row[0])}
    assert set(made) | set(made["ranking"][0]) <= told | {"effect"}
    assert told <= set(made) | set(made["ranking"][0])
    assert all(f"`{key}`" in text_of("files.md") or f'"{key}"' in text_of("files.md") for key in made["failing"][0])


def test_every_column_of_a_table_of_molecules_is_told():
    model = nm.preset("FF").with_values({"acquisition.n_frames": 20, "acquisition.shape_px": [32, 32]})
    found = nm.extract_traces(nm.simulate(model, seed=1).movie, model.camera, psf_sigma_px=model.sigma_px)
    rows = rows_of(text_of("files.md").split("## Traces")[1].split("\n## ")[0])[2:]
    assert {name for row in rows for name in re.findall(r"`(\w+)`", row[0])} == set(found.molecules.columns)
