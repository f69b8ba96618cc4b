"""The demonstration: what is hidden, what the user's part may read, and (slow) that it works."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from tests.report_example import report

from napari_mufasa import files, samples
from napari_mufasa.cli import demo
from napari_mufasa.effects import effect_class
from napari_mufasa.model.model import Model

#: What seeds 1 to 6 of the demonstration hide.
SEEDS = [
    ("laser_drift", "step"), ("stage_drift", "linear"), ("stage_drift", "saturating"),
    ("delayed_activation", "exponential"), ("stage_drift", "step"), ("periodic_modulation", "sine"),
]  # fmt: skip
USERS_FILES = {"movie.ome.tif", "dark.ome.tif", "model.json"}


@pytest.fixture(scope="module")
def prepared(tmp_path_factory) -> Path:
    directory = tmp_path_factory.mktemp("demo")
    demo.prepare(directory, seed=4)
    return directory


def test_every_hidden_effect_is_within_its_plausible_range_and_forms_vary():
    model = Model.from_dict(samples.BELIEVED)
    for kind, bounds in samples.VISIBLE.items():
        plausible = effect_class(kind).plausible()
        for name, (low, high) in bounds.items():
            assert plausible[name][0] <= low < high <= plausible[name][1], (kind, name)
    for kinds in (demo.KINDS, samples.PUZZLES):
        drawn = [samples.draw_effect(model, kinds, np.random.default_rng(seed)) for seed in range(400)]
        # Each of ten kinds is missed by 400 draws with probability 10·0.9⁴⁰⁰ < 1e-17.
        assert {effect.kind for effect in drawn} == set(kinds)
        for kind in kinds:
            forms = {getattr(effect, "form", "") for effect in drawn if effect.kind == kind}
            # About 40 draws per kind, at most 4 forms: one is missed with probability 4·0.75⁴⁰ = 4e-5; fixed seeds.
            assert forms == set(effect_class(kind).forms()) - {"as_seen", "steady", "orientations"}


def test_the_seeds_hide_what_they_always_hid():
    """Seeds are quoted in the documentation and in reports: the same seed hides the same effect."""
    believed = Model.from_dict(samples.BELIEVED)
    drawn = [samples.draw_effect(believed, demo.KINDS, np.random.default_rng([seed, 0xDE30])) for seed in range(1, 7)]
    assert [(effect.kind, getattr(effect, "form", "")) for effect in drawn] == SEEDS
    assert samples.hidden_effect().kind == "image_lag"


def test_the_samples_movie_is_of_the_effect_its_envelope_names():
    puzzle = samples.hide(samples.puzzle_model(), samples.PUZZLES, np.random.default_rng(3), n_dark=2)
    assert puzzle.truth.effects == (samples.hidden_effect(3),) and puzzle.believed.effects == ()


def test_the_files_do_not_give_the_effect_away(prepared):
    truth = json.loads((prepared / "envelope.json").read_text())
    kind = truth["effect"]["kind"]
    for name in USERS_FILES:
        assert kind.encode() not in (prepared / name).read_bytes(), name
    for name in ("movie.ome.tif", "dark.ome.tif"):
        movie = files.read_movie(prepared / name)
        assert Model.stored_in(movie.metadata) == Model.from_json(prepared / "model.json") and movie.seed is None
    assert Model.from_dict(truth["model"]).effects[0].kind == kind


def test_the_believed_values_are_a_few_percent_off(prepared):
    truth = Model.from_dict(json.loads((prepared / "envelope.json").read_text())["model"])
    believed = Model.from_json(prepared / "model.json")
    off = truth.excitation.power_density_w_per_cm2 / believed.excitation.power_density_w_per_cm2
    assert off != 1 and abs(off - 1) < 0.08


def test_a_seed_gives_the_same_acquisition(prepared, tmp_path):
    demo.prepare(tmp_path, seed=4)
    np.testing.assert_array_equal(files.load(tmp_path / "movie.ome.tif"), files.load(prepared / "movie.ome.tif"))


def test_the_users_part_reads_only_the_users_files(prepared, tmp_path, monkeypatch):
    """It runs in a folder without the envelope, and is given nothing but the folder."""
    from napari_mufasa import discover
    from napari_mufasa.report import figures
    from napari_mufasa.report import html as html_report

    for name in USERS_FILES:
        (tmp_path / name).write_bytes((prepared / name).read_bytes())
    asked = {}

    def answer(movie, model, dark, **options):
        asked.update(movie=movie, model=model, dark=dark, **options)
        return report()

    monkeypatch.setattr(discover, "diagnose", answer)
    monkeypatch.setattr(html_report, "_picture", lambda drawing: {"light": "", "dark": ""})
    monkeypatch.setattr(figures.Drawing, "render", lambda self, theme, kind="png": b"")
    said: list[str] = []
    demo.investigate(tmp_path, said.append)
    np.testing.assert_array_equal(asked["movie"], files.load(prepared / "movie.ome.tif"))
    assert asked["model"] == Model.from_dict(samples.BELIEVED) and len(asked["dark"]) == 100
    assert "seed" not in asked  # the seed that hid the effect is not handed on
    assert any("before 2.93, after 1.04, floor 0.98" in line for line in said)
    assert {"report.json", "report.html"} <= {path.name for path in (tmp_path / "diagnosis").iterdir()}
    assert {"denoised.ome.tif", "traces.csv", "molecules.csv"} <= {path.name for path in tmp_path.iterdir()}


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("triplet_blinking", "The verdict named it."),
        ("long_dark_state", "cannot be told apart"),
        ("stage_drift", "did not name it"),
    ],
)
def test_the_envelope_is_told_honestly(kind, words, tmp_path):
    effect = effect_class(kind)()
    files.write_json(tmp_path / "envelope.json", {"effect": effect.model_dump()})
    lines = demo.open_envelope(tmp_path, report())  # names triplet_blinking, not told from long_dark_state
    assert effect.title in lines[0] and words in lines[1]


def test_the_demo_finds_what_it_hid(tmp_path, monkeypatch):
    """The whole story on a smaller movie; `make demo` plays it at full size."""
    acquisition = samples.BELIEVED["acquisition"] | {"n_frames": 150, "shape_px": [64, 64]}
    sample = samples.BELIEVED["sample"] | {"n_molecules": 22}
    monkeypatch.setattr(samples, "BELIEVED", samples.BELIEVED | {"acquisition": acquisition, "sample": sample})
    found = demo.run(tmp_path, seed=1, say=lambda line: None)
    told = json.loads((tmp_path / "diagnosis/report.json").read_text())
    assert told["error"]["after"] < 0.6 * told["error"]["before"]
    assert json.loads((tmp_path / "envelope.json").read_text())["effect"]["kind"] in found.chosen
