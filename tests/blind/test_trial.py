"""The trial's page says what wrote it and is written by a whole trial only."""

import json

import pytest

from . import trial


def row(case):
    kinds = [kind for kind, _ in case["effects"]]
    error = {"before": 4.0, "after": 1.0 if kinds else 4.0, "floor": 1.0}
    told = {"verdict": "missing_effect" if kinds else "adequate", "chosen": kinds, "ranking": kinds}
    return case | told | {"error": error, "pulls": {}, "state": "abc123"}


@pytest.fixture
def page(tmp_path, monkeypatch):
    monkeypatch.setattr(trial, "PAGE", tmp_path / "page.md")
    monkeypatch.setattr(trial, "run", lambda case, base: row(case))
    return trial.PAGE


def test_a_whole_trial_writes_its_page_with_its_command_and_the_state_of_the_code(page, tmp_path):
    trial.main(["--seeds", "1", "--nulls", "2", "--results", str(tmp_path / "rows.jsonl")])
    text = page.read_text()
    n = len((tmp_path / "rows.jsonl").read_text().splitlines())
    assert n == 26 + 2 + len(trial.PAIRS) + 8
    assert f"`python -m tests.blind.trial --seeds 1 --nulls 2 --results {tmp_path}/rows.jsonl`" in text
    assert f"from {n} cases" in text and "abc123" in text
    assert "| exactly the right set chosen | 26 / 26 (100%) |" in text
    assert "| nothing | 2 | adequate 2 | adequate 2 | 4.00 → 4.00 (1.00) |" in text


@pytest.mark.parametrize("part", [["--quick"], ["--groups", "single"], ["--base", "emccd_short"], ["--share", "0/2"]])
def test_a_part_of_a_trial_writes_no_page(page, tmp_path, part):
    trial.main(["--seeds", "1", "--nulls", "2", "--results", str(tmp_path / "rows.jsonl"), *part])
    assert (tmp_path / "rows.jsonl").exists() and not page.exists()


def test_the_last_of_two_processes_writes_the_page_and_a_stopped_trial_goes_on(page, tmp_path, monkeypatch):
    shared = ["--seeds", "1", "--nulls", "2", "--results", str(tmp_path / "rows.jsonl")]
    trial.main([*shared, "--share", "0/2"])
    assert not page.exists()
    trial.main([*shared, "--share", "1/2"])
    assert "from 46 cases" in page.read_text()
    monkeypatch.setattr(trial, "run", lambda case, base: pytest.fail("it was run already"))
    trial.main(shared)


def test_a_page_is_made_of_rows_alone(page, tmp_path, monkeypatch):
    monkeypatch.setattr(trial, "run", lambda case, base: pytest.fail("nothing is to be run"))
    rows = tmp_path / "rows.jsonl"
    rows.write_text(json.dumps(row({"group": "null", "effects": [], "seed": 1})) + "\n")
    trial.main(["--table", str(rows)])
    assert "--table" in page.read_text() and "| nothing hidden: adequate | 1 / 1 (100%) |" in page.read_text()
    with pytest.raises(SystemExit):
        trial.main(["--table", str(tmp_path / "none.jsonl")])


def test_several_effects_at_once_are_counted_one_by_one(page, tmp_path, monkeypatch, capsys):
    """Of three to five hidden, the last is missed in each movie, and a wrong one named in the first."""

    def partly(case, base):
        told = row(case)
        told["chosen"] = told["chosen"][:-1] + (["cosmic_rays_not"] if case["seed"] == 7000 else [])
        return told

    monkeypatch.setattr(trial, "run", partly)
    trial.main(["--groups", "several", "--seeds", "3", "--results", str(tmp_path / "rows.jsonl")])
    said = capsys.readouterr().out
    assert "| three to five: effects found | 9 / 12 |" in said
    assert "| three to five: wrong names of those given | 1 / 10 |" in said and not page.exists()
    assert trial.several(5) == trial.several(5) and len({k for k, _ in trial.several(5)}) == 5
