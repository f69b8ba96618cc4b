"""Many movies at once: which they are, what is kept, and what tells them apart (docs/batches.md)."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import napari_mufasa as nm
from napari_mufasa import files
from napari_mufasa.batch import Entry, Result, Settings, read_entries, run
from napari_mufasa.batch.table import (
    able_to_tell,
    condition_table,
    difference_table,
    holm,
    pooled,
    rank_p,
    write_tables,
)
from napari_mufasa.cli import main
from napari_mufasa.effects import effect_class
from napari_mufasa.errors import MufasaError
from napari_mufasa.report.batch import nothing_told


def small():
    return nm.preset("FF").with_values(
        {"acquisition.n_frames": 60, "acquisition.shape_px": (48, 48), "sample.n_molecules": 14}
    )


def write_movie(path, model, seed):
    path.parent.mkdir(parents=True, exist_ok=True)
    movie = nm.simulate(model, seed=seed).movie
    files.write_movie(path, [movie], movie.shape, np.uint16)


@pytest.fixture
def folder(tmp_path):
    """Four movies of two conditions, and their model."""
    model = small()
    model.to_json(tmp_path / "model.json")
    for condition in ("a", "b"):
        for i in range(2):
            write_movie(tmp_path / "movies" / condition / f"m{i}.tif", model, 2 * i + (condition == "b"))
    return tmp_path


def cli(capsys, *arguments):
    with pytest.raises(SystemExit) as leaving:
        main([str(a) for a in arguments])
    out, err = capsys.readouterr()
    return leaving.value.code, out, err


# which movies -----------------------------------------------------------------------------------------------
def test_folders_in_a_folder_are_conditions(folder):
    entries = read_entries(folder / "movies", model=folder / "model.json")
    assert [(e.name, e.condition) for e in entries] == [("a-m0", "a"), ("a-m1", "a"), ("b-m0", "b"), ("b-m1", "b")]
    flat = read_entries(folder / "movies" / "a", model=folder / "model.json")
    assert [(e.name, e.condition) for e in flat] == [("m0", ""), ("m1", "")]


def test_a_list_names_conditions_and_models(folder):
    (folder / "list.csv").write_text("movie,condition,model\nmovies/a/m0.tif,x,model.json\nmovies/b/m0.tif,y,\n")
    entries = read_entries(folder / "list.csv", model=folder / "model.json")
    assert [(e.name, e.condition, e.model) for e in entries] == [
        ("x-m0", "x", folder / "model.json"), ("y-m0", "y", folder / "model.json"),
    ]  # fmt: skip
    (folder / "list.txt").write_text('movies/a/m0.tif\n"movies/b/m0.tif"\n')
    assert [e.name for e in read_entries(folder / "list.txt", model=folder / "model.json")] == ["m0", "m0-2"]


@pytest.mark.parametrize("rows_named", [True, False])
@pytest.mark.parametrize("mark", [",", ";", "\t"])
def test_a_list_may_be_quoted_as_r_writes_it(folder, rows_named, mark):
    rows = [("", "movie", "condition"), ("1", "movies/a/m0.tif", "x, y"), ("2", "movies/b/m0.tif", "z")]
    text = [mark.join(f'"{cell}"' for cell in row[0 if rows_named else 1 :]) for row in rows]
    (folder / "list.csv").write_text("\n".join(text) + "\n")
    entries = read_entries(folder / "list.csv", model=folder / "model.json")
    assert [(e.movie, e.condition) for e in entries] == [
        (folder / "movies/a/m0.tif", "x, y"), (folder / "movies/b/m0.tif", "z"),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("movie,colour\nmovies/a/m0.tif,red\n", "colour"), ("movies/a/none.tif\n", "none.tif"), ("\n", "empty"),
        ("movie,condition\n", "no movie"), ("movies/a/m0.tif\n", "no model"),
    ],
)  # fmt: skip
def test_a_list_that_is_none_is_told(folder, text, word):
    (folder / "list.csv").write_text(text)
    with pytest.raises(MufasaError, match=word):
        read_entries(folder / "list.csv", model=None if word == "no model" else folder / "model.json")


def test_no_movies_are_told(tmp_path):
    for source in (tmp_path, tmp_path / "nothing"):
        with pytest.raises(MufasaError, match="movie"):
            read_entries(source)


# what is kept -----------------------------------------------------------------------------------------------
def test_what_is_finished_is_not_done_again(folder, capsys, monkeypatch):
    from napari_mufasa.batch import steps

    out = folder / "out"
    shared = ("batch", folder / "movies", "--model", folder / "model.json", "--do", "traces", "--out", out)
    code, first, _ = cli(capsys, *shared)
    assert code == 0 and first.count("molecules") == 4 and "done before" not in first
    (out / "a-m1/traces/done.json").unlink()  # as if the run had been killed in this movie
    counted = []
    traces = steps.STEPS["traces"]
    monkeypatch.setitem(steps.STEPS, "traces", lambda *a, **k: counted.append(a[1].path.name) or traces(*a, **k))
    table = pd.read_csv(out / "summary.csv")
    code, again, _ = cli(capsys, *shared)
    assert code == 0 and counted == ["m1.tif"] and again.count("done before") == 3
    pd.testing.assert_frame_equal(pd.read_csv(out / "summary.csv"), table)
    assert {"traces.csv", "molecules.csv", "traces.png"} <= {p.name for p in (out / "a-m1/traces").iterdir()}
    # A further step is added to what is there; what was made with something else is not replaced unasked.
    code, _, err = cli(capsys, *shared, "--follow-drift")
    assert code == 2 and "follow_drift" in err and "--overwrite" in err and len(counted) == 1
    assert cli(capsys, *shared, "--follow-drift", "--overwrite")[0] == 0 and len(counted) == 5


def test_a_step_that_is_done_anew_leaves_nothing_of_the_old(folder):
    (entry, *_) = read_entries(folder / "movies", model=folder / "model.json")
    (first,) = run([entry], folder / "out", Settings(steps=("traces",), follow_molecules=True))
    place = folder / "out/a-m0/traces"
    assert not first.error and (place / "paths.csv").exists()
    (place / "notes.txt").write_text("mine")
    (second,) = run([entry], folder / "out", Settings(steps=("traces",)), overwrite=True)
    assert not second.error and second.kept == ()
    made = ["done.json", "molecules.csv", "molecules.png", "notes.txt", "traces.csv", "traces.png"]
    made.append("traces.provenance.json")
    assert sorted(path.name for path in place.iterdir()) == made


def test_a_movie_that_cannot_be_done_is_told_and_the_others_are_done(folder, capsys):
    (folder / "movies/a/m0.tif").write_bytes(b"II*\0 no movie")
    shared = ("batch", folder / "movies", "--model", folder / "model.json", "--do", "traces", "--out", folder / "out")
    code, out, err = cli(capsys, *shared)
    assert code == 2 and "1 of 4 movies" in err and out.count("failed") == 1 and len(err.strip().splitlines()) == 1
    table = pd.read_csv(folder / "out/summary.csv")
    assert list(table["problem"].isna()) == [False, True, True, True]
    assert "<th>Problem</th>" in (folder / "out/summary.html").read_text()


def test_where_no_movie_can_be_done_the_tables_say_why(tmp_path, capsys):
    small().to_json(tmp_path / "model.json")
    (tmp_path / "bad.tif").write_bytes(b"II*\0 no movie")
    shared = ("batch", tmp_path, "--model", tmp_path / "model.json", "--do", "denoise", "--out", tmp_path / "out")
    code, _, err = cli(capsys, *shared)
    assert code == 2 and "1 of 1 movies" in err and len(err.strip().splitlines()) == 1
    assert pd.read_csv(tmp_path / "out/summary.csv")["problem"].notna().all()


def test_a_movie_of_one_molecule_has_no_floor_and_the_others_are_done(tmp_path, capsys):
    lone = {"sample.n_molecules": 1, "acquisition.n_frames": 30, "acquisition.shape_px": (32, 32),
            "excitation.power_density_w_per_cm2": 20.0, "fluorophore.cycles_before_bleaching": None}  # fmt: skip
    model = nm.preset("FF").with_values(lone)
    model.to_json(tmp_path / "model.json")
    movie = nm.simulate(model, positions_px=[[15.2, 16.1]], seed=1).movie
    (tmp_path / "movies").mkdir()
    for name in "ab":
        files.write_movie(tmp_path / "movies" / f"{name}.tif", [movie], movie.shape, np.uint16)
    shared = ("batch", tmp_path / "movies", "--model", tmp_path / "model.json", "--do", "compare")
    code, out, _ = cli(capsys, *shared, "--out", tmp_path / "out")
    assert code == 0 and out.count("(no floor)") == 2
    assert pd.read_csv(tmp_path / "out/summary.csv")["w1"].notna().all()


def test_a_model_that_cannot_be_a_movies_is_told_with_the_movie(folder, capsys):
    other = small().with_values({"camera.baseline_adu": 15000.0, "acquisition.n_frames": 50})
    other.to_json(folder / "other.json")
    a, b = (folder / "movies" / name / "m0.tif" for name in "ab")
    (folder / "list.csv").write_text(f"movie,model\n{a},model.json\n{b},other.json\n")
    code, _, err = cli(capsys, "batch", folder / "list.csv", "--do", "denoise", "--out", folder / "out")
    assert code == 0 and "m0-2: the model's baseline is 1.5e+04 ADU" in err and "m0-2: the movie has 60 frames" in err
    assert "note: m0: " not in err and err.count("note: m0-2: ") == 2
    doubts = pd.read_csv(folder / "out/summary.csv")["doubts"]
    assert list(doubts.isna()) == [True, False] and "baseline" in doubts[1] and "50 frames" in doubts[1]
    assert "this is another camera" in (folder / "out/summary.html").read_text()
    # What was done before still says so.
    assert (
        "m0-2: the model's" in cli(capsys, "batch", folder / "list.csv", "--do", "denoise", "--out", folder / "out")[2]
    )


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (("--do", "sleep"), "sleep"), (("--do", ","), "--do"), (("--effects", "magic"), "magic"),
        (("--model", "no.json"), "no.json"), (("--do", "traces", "--effects", "stage_drift"), "uses effects"),
        (("--do", "traces", "--method", "pure-let"), "uses method"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line(folder, capsys, options, word):
    shared = ("batch", folder / "movies", "--model", folder / "model.json", "--out", folder / "out")
    code, _, err = cli(capsys, *shared, *options)
    assert code == 2 and word in err and len(err.strip().splitlines()) == 1


def test_denoised_movies_are_those_of_the_function(folder):
    from napari_mufasa.denoise import denoise

    entry = read_entries(folder / "movies", model=folder / "model.json")[0]
    (result,) = run([entry], folder / "out", Settings(steps=("denoise",), method="pure-let"))
    assert not result.error
    made = files.load(folder / "out/a-m0/denoise/denoised.ome.tif")
    np.testing.assert_allclose(made, denoise(files.load(entry.movie), small().camera, method="pure-let"), rtol=1e-5)


# what tells them apart --------------------------------------------------------------------------------------
@pytest.mark.parametrize("n", [2, 3, 10])
@pytest.mark.parametrize("between", [0.0, 0.5, 1.5])
def test_pooled_strengths_have_the_uncertainty_they_say(n, between):
    """Movies that differ by `between` about 3, each known to 0.2 … 0.6: mean and interval, over 2000 batches."""
    rng = np.random.default_rng(1)
    sds = np.linspace(0.2, 0.6, n)
    told = np.array([pooled(3 + rng.normal(0, between, n) + rng.normal(0, sds), sds) for _ in range(2000)])
    assert told[:, 0].mean() == pytest.approx(3.0, abs=4 * told[:, 0].std() / np.sqrt(2000))
    # Intervals that hold 95 % do in 95 ± 0.5 % of 2000; unequal uncertainties cost 2 % (two movies alike: 99 % hold).
    assert 0.91 < np.mean(np.abs(told[:, 0] - 3) < told[:, 1]) <= 1.0
    if n == 10 and between:
        assert np.median(told[:, 2]) == pytest.approx(between, rel=0.2)


def test_one_movie_is_as_sure_as_it_says():
    assert np.isnan(pooled([], [])[0]) and pooled([2.0], [0.1])[:2] == pytest.approx((2.0, 0.196))


def test_movies_without_an_uncertainty_count_alike():
    assert pooled([2.0], [0.0]) == (2.0, 0.0, 0.0)
    mean, reach, between = pooled([1.0, 2.0, 3.0], [0.0, 0.1, 0.3])
    assert (mean, between) == pytest.approx((2.0, 1.0)) and reach == pytest.approx(4.303 / np.sqrt(3), rel=1e-3)


def results_of(rng, effect_in=(), brighter=1.0, n=6):
    found = {"effect": "stage_drift", "p_value": 1e-6, "evidence": 50.0}
    found |= {"parameters": {"distance_px": 3.0}, "sd": {"distance_px": 0.4}}
    results = []
    for condition in ("a", "b"):
        for i in range(n):
            told = {
                "verdict": "adequate", "effects": [found] if condition in effect_in else [],
                "error_before": rng.normal(1, 0.1), "molecules": int(rng.poisson(30)),
                "brightness_e": rng.normal(100, 5) * (brighter if condition == "b" else 1),
            }  # fmt: skip
            name = f"{condition}{i}"
            results.append(Result(Entry(movie=Path(f"{name}.tif"), name=name, condition=condition), told))
    return results


@pytest.mark.parametrize("n", [3, 4, 6])
def test_conditions_that_are_the_same_are_rarely_told_apart(n):
    rng = np.random.default_rng(3)
    alarms = [difference_table(results_of(rng, n=n))["differs"].any() for _ in range(400)]
    assert sum(alarms) <= 33  # 5 % of 400 are 20 ± 4.4; three sd above


def test_three_movies_a_condition_are_said_to_be_too_few():
    rng = np.random.default_rng(3)
    few, more = (difference_table(results_of(rng, n=n)) for n in (3, 8))
    assert not few["differs"].any() and nothing_told(few) == "Too few movies to tell the conditions apart"
    assert nothing_told(more) == "Nothing tells the conditions apart beyond chance"


@pytest.mark.parametrize("sizes", [(3, 3), (4, 4), (5, 5), (3, 8), (3, 3, 3), (10, 10)])
@pytest.mark.parametrize("whole", [False, True])
def test_p_values_of_few_movies_are_those_of_chance(sizes, whole):
    """Where nothing differs, a p value of 5 % or less comes in 5 % at most: with ties, too."""
    rng = np.random.default_rng(6)
    p = []
    for _ in range(800):
        samples = [rng.poisson(3, n) if whole else rng.normal(size=n) for n in sizes]
        p.append(rank_p(samples)[0])
    assert np.mean(np.array(p) <= 0.05) <= 0.073  # 5 % of 800 are known to 0.77 %; three of them


def test_p_values_of_few_movies_are_exact():
    from scipy import stats

    rng = np.random.default_rng(7)
    for n, m in [(3, 3), (4, 6), (8, 8)]:
        a, b = rng.normal(size=n), rng.normal(0.8, 1, size=m)
        exact = stats.mannwhitneyu(a, b, method="exact").pvalue
        assert rank_p([a, b])[0] == rank_p([a, b])[0] == pytest.approx(exact)
    for table in ([[0, 6], [6, 0]], [[1, 4], [5, 2]], [[0, 9], [3, 6]]):
        found = [[1.0] * there + [0.0] * absent for there, absent in table]
        assert rank_p(found)[0] == pytest.approx(stats.fisher_exact(table).pvalue, abs=0.006)  # the last is drawn
    # Of more ways than are looked at, as many at random: 3 in 20 000 of √N are 0.5 %.
    a, b = rng.normal(size=10), rng.normal(0.8, 1, size=12)
    assert rank_p([a, b])[0] == pytest.approx(stats.mannwhitneyu(a, b, method="exact").pvalue, abs=0.01)
    p, least = rank_p([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    assert p == least == pytest.approx(6 / 90)  # the three conditions in any order, of 6!/(2!)³ ways


def test_movies_that_are_too_few_to_tell_have_no_adjusted_p():
    rng = np.random.default_rng(8)
    few = difference_table(results_of(rng, effect_in=("b",), brighter=3.0, n=3))
    # Three against three: of 20 ways to deal six movies two are the most that they can differ.
    assert few["p_value"].min() == pytest.approx(0.1) and few["p_adjusted"].isna().all() and not few["differs"].any()
    # Six against six: three numbers and an effect.
    four = difference_table(results_of(rng, effect_in=("b",), brighter=3.0, n=6)).set_index("what")
    assert four.loc["brightness_e", "p_adjusted"] == pytest.approx(4 * 2 / 924)
    # A row that no dealing of its movies could make differ costs the others nothing.
    np.testing.assert_array_equal(able_to_tell(np.array([0.002, 0.02, 0.02, 0.4])), [True, False, False, False])
    np.testing.assert_array_equal(able_to_tell(np.array([0.002, 0.02, 0.4])), [True, True, False])
    assert not able_to_tell(np.full(9, 2 / 252)).any() and able_to_tell(np.full(9, 2 / 924)).all()


def test_a_condition_may_be_called_like_a_column(tmp_path):
    names = ("p_value", "what", "differs", "p_adjusted", "b")
    results = [
        Result(Entry(movie=Path(f"{name}{i}.tif"), name=f"{name}{i}", condition=name), {"w1": 1.0 + i + k})
        for k, name in enumerate(names)
        for i in range(3)
    ]
    write_tables(tmp_path, results, "title")
    told = pd.read_csv(tmp_path / "differences.csv")
    assert list(told["what"]) == ["w1"] and told["condition p_value"][0] == 2.0 and told["b"][0] == 6.0
    assert set(pd.read_csv(tmp_path / "summary.csv")["condition"]) == set(names)


def test_what_differs_is_told_first():
    rng = np.random.default_rng(4)
    table = difference_table(results_of(rng, effect_in=("b",), brighter=1.5))
    assert set(table["what"][table["differs"]]) == {"stage_drift", "brightness_e"}
    row = table.set_index("what").loc["stage_drift"]
    assert row["a"] == "in 0 of 6" and row["b"] == "in 6 of 6"
    pooled_row = condition_table(results_of(rng, effect_in=("b",))).set_index("condition").loc["b"]
    assert pooled_row["found_in"] == 6 and pooled_row["value"] == pytest.approx(3.0)
    assert pooled_row["high_95"] - pooled_row["value"] == pytest.approx(1.96 * 0.4 / np.sqrt(6), rel=1e-3)


def test_p_values_are_for_all_rows_together():
    np.testing.assert_allclose(holm(np.array([0.01, 0.02, 0.5])), [0.03, 0.04, 0.5])
    assert len(holm(np.zeros(0))) == 0


@pytest.mark.slow
def test_twelve_movies_killed_half_way_are_told_apart(tmp_path):
    """Six movies of a stage at rest, six of one that drifts by 3 to 4 px, diagnosed by separate processes; the first of
    them is killed in its sixth movie. (No molecule bleaches: of 14 that do too few may be left to tell a drift by.)"""
    model = small().with_values({"fluorophore.cycles_before_bleaching": None})
    model.to_json(tmp_path / "model.json")
    for i in range(6):
        write_movie(tmp_path / f"movies/still/m{i}.tif", model, i + 1)
        drifts = effect_class("stage_drift")(distance_px=3.0 + 0.2 * i)
        write_movie(tmp_path / f"movies/drift/m{i}.tif", model.model_copy(update={"effects": (drifts,)}), 11 + i)
    out = tmp_path / "out"
    command = [
        sys.executable, "-m", "napari_mufasa", "batch", str(tmp_path / "movies"),
        "--model", str(tmp_path / "model.json"), "--out", str(out),
        "--do", "traces,diagnose", "--effects", "stage_drift,photobleaching",
    ]  # fmt: skip
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    first = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    assert first.stdout is not None
    lines = [first.stdout.readline() for _ in range(5)]
    time.sleep(2.0)  # into the sixth
    first.send_signal(signal.SIGKILL)
    first.wait()
    assert [line.split("]")[0] for line in lines] == [f"[{i}/12" for i in range(1, 6)]
    finished = {path: path.stat().st_mtime_ns for path in out.rglob("done.json")}
    assert 10 <= len(finished) <= 11  # five movies of two steps; of the sixth the traces at most
    second = subprocess.run(command, capture_output=True, text=True, env=environment, check=True)
    told = second.stdout.splitlines()
    assert sum("done before" in line for line in told) == 5 and len(told) >= 13
    assert all(path.stat().st_mtime_ns == when for path, when in finished.items())  # nothing was done twice
    assert not list(out.rglob(".*")), "a killed run leaves nothing half-written behind the next one"
    table = pd.read_csv(out / "summary.csv")
    drifting = table["condition"] == "drift"
    named = table.loc[drifting, "effects"]
    assert named.str.contains("stage_drift").all()
    # A further name is taken up by chance in 1 % of movies, by `rules.FURTHER`: in two of six in 0.15 %.
    assert (named == "stage_drift").sum() >= 5
    # Where nothing is missing 2.5 % of movies raise an alarm: one of six in 13 %, more in 0.9 %. With one, conditions
    # differ by Fisher's test of drift alone (0.015), but no longer where all that is compared is accounted for.
    assert (table.loc[~drifting, "verdict"] == "adequate").sum() >= 5
    told_apart = pd.read_csv(out / "differences.csv").set_index("what").loc["stage_drift"]
    assert told_apart["drift"] == "in 6 of 6" and told_apart["p_value"] < 0.02
    assert ("conditions differ in stage drift" in second.stdout) == bool(told_apart["differs"])
    pages = (out / "summary.html").read_text()
    assert "stage drift" in pages and "drift-m0/diagnose/report.html" in pages
    strength = pd.read_csv(out / "conditions.csv").set_index(["condition", "effect"]).loc[("drift", "stage_drift")]
    assert strength["low_95"] < 3.5 < strength["high_95"]
    assert json.loads((out / "drift-m0/diagnose/done.json").read_text())["told"]["verdict"] == "missing_effect"
