"""The command line: options as in docs/files.md, outputs that agree with the library, and how it fails."""

from __future__ import annotations

import importlib
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import get_args

import numpy as np
import pandas as pd
import pytest
import tifffile
import typer
from tests.report_example import power, report
from tests.spec_example import MODEL

import napari_mufasa as nm
from napari_mufasa import files
from napari_mufasa.cli import main
from napari_mufasa.cli.app import app, spread_lists
from napari_mufasa.files.outputs import DIAGNOSIS, is_one_of
from napari_mufasa.model.model import Model

VERBS = {
    "demo": {"--out", "--viewer", "--seed"},
    "simulate": {
        "--preset", "--model", "--out", "--n-molecules", "--frames", "--shape", "--positions", "--effect", "--engine",
        "--seed",
    },
    "denoise": {"--model", "--out", "--method"},
    "traces": {"--model", "--dark", "--window", "--best", "--out"},
    "compare": {"--traces", "--model", "--dark", "--out"},
    "diagnose": {"--model", "--dark", "--out", "--seed", "--budget", "--check", "--halves"},
    "refine": {"--model", "--add", "--out"},
    "power": {"--model", "--effect", "--strength", "--movies", "--out"},
    "calibrate": {"--dark", "--out"},
    "propose": {"--dark", "--out"},
    "infer": {"--model", "--out"},
    "design": {"--model"},
    "presets": set(),
}  # fmt: skip


@pytest.fixture
def cli(capfd):
    """Run a command; returns (exit code, stdout, stderr)."""

    def run(*arguments: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as left:
            main([str(argument) for argument in arguments])
        out, err = capfd.readouterr()
        return int(left.value.code or 0), out, err

    return run


@pytest.fixture(scope="module")
def model_file(tmp_path_factory) -> Path:
    """The model of docs/model.md, smaller and with molecules apart."""
    data = json.loads(json.dumps(MODEL))
    data["acquisition"] |= {"n_frames": 120, "shape_px": [48, 48]}
    data["sample"] = {"n_molecules": 12, "min_distance_px": 9}
    path = tmp_path_factory.mktemp("model") / "model.json"
    Model.from_dict(data).to_json(path)
    return path


@pytest.fixture(scope="module")
def movie_file(model_file) -> Path:
    path = model_file.with_name("movie.ome.tif")
    with pytest.raises(SystemExit) as left:
        main(["simulate", "--model", str(model_file), "--out", str(path), "--seed", "3"])
    assert not left.value.code
    return path


def leftovers(directory: Path) -> list[str]:
    return sorted(path.name for path in directory.iterdir())


# --- what there is -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_has_the_options_of_the_contract(verb):
    command = typer.main.get_command(app).commands[verb]  # type: ignore[attr-defined]
    options = {name for parameter in command.params for name in parameter.opts}
    assert VERBS[verb] <= options


def test_help_is_fast_because_it_imports_nothing_heavy():
    code = (
        "import sys\nfrom napari_mufasa.cli import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit as e:\n    assert not e.code, e.code\n"
        "heavy = {'numpy', 'pandas', 'pydantic', 'matplotlib', 'numba', 'scipy', 'napari', 'dask', 'tifffile', 'ot'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    assert all(verb in ran.stdout for verb in VERBS)


def test_python_m_is_the_same_command():
    ran = subprocess.run([sys.executable, "-m", "napari_mufasa", "--version"], capture_output=True, text=True)
    assert ran.stdout.strip() == f"napari-mufasa {nm.__version__}"


def test_presets_print_models_that_read_back(cli, tmp_path):
    code, out, _ = cli("presets")
    assert code == 0 and all(name in out for name in ("PALM", "STORM", "FF", "Blinking", "EGFP", "Alexa647-STORM"))
    code, out, _ = cli("presets", "FF")
    (tmp_path / "ff.json").write_text(out)
    assert Model.from_json(tmp_path / "ff.json") == nm.preset("FF")


# --- simulate ----------------------------------------------------------------------------------------------


def test_the_movie_is_the_librarys_and_carries_model_and_seed(movie_file, model_file):
    movie = files.read_movie(movie_file)
    model = Model.from_json(model_file)
    assert (Model.stored_in(movie.metadata), movie.seed) == (model, 3)
    np.testing.assert_array_equal(np.asarray(movie.data), nm.simulate(model, seed=3).movie)


def test_zarr_holds_the_same_movie(cli, movie_file, model_file, tmp_path):
    assert cli("simulate", "--model", model_file, "--out", tmp_path / "m.zarr", "--seed", 3)[0] == 0
    np.testing.assert_array_equal(files.load(tmp_path / "m.zarr"), files.load(movie_file))
    assert Model.stored_in(files.read_movie(tmp_path / "m.zarr").metadata) == Model.from_json(model_file)


def test_options_change_the_model_in_the_metadata(cli, tmp_path):
    code, _, err = cli(
        "simulate", "--preset", "FF", "--out", tmp_path / "m.tif", "--frames", 7, "--shape", 20, 30, "--n-molecules", 4,
        "--effect", "stage_drift:distance_px=2.5,form=saturating", "--effect", "row_noise", "--engine", "exact",
    )  # fmt: skip
    assert (code, err) == (0, "")  # nothing on stderr when piped: no progress bar
    model = Model.stored_in(files.read_movie(tmp_path / "m.tif").metadata)
    assert model.acquisition.n_frames == 7 and model.acquisition.shape_px == (20, 30)
    assert model.sample.n_molecules == 4
    drift, rows = model.effects
    assert (drift.kind, drift.distance_px, drift.form, rows.kind) == ("stage_drift", 2.5, "saturating", "row_noise")
    assert files.load(tmp_path / "m.tif").shape == (7, 20, 30)


def test_truth_is_what_was_simulated(cli, model_file, tmp_path):
    from napari_mufasa.simulate.movie import SimulatedAcquisition

    cli("simulate", "--model", model_file, "--out", tmp_path / "m.tif", "--truth", tmp_path / "truth", "--seed", 5)
    acquisition = SimulatedAcquisition(Model.from_json(model_file), seed=5)
    rows = pd.read_csv(tmp_path / "truth" / "emission.csv")
    emission = np.zeros_like(acquisition.emission)
    emission[rows["molecule"], rows["frame"]] = rows["photons"]
    np.testing.assert_array_equal(emission, acquisition.emission)
    positions = pd.read_csv(tmp_path / "truth" / "positions.csv")
    np.testing.assert_allclose(positions[["y_px", "x_px"]], acquisition.scene.positions_px)


def test_positions_come_from_a_table_in_nm(cli, model_file, tmp_path):
    (tmp_path / "p.csv").write_text("x_nm,y_nm\n1050,2050\n3050,1050\n")
    cli("simulate", "--model", model_file, "--positions", tmp_path / "p.csv", "--out", tmp_path / "m.tif",
        "--truth", tmp_path / "t")  # fmt: skip
    positions = pd.read_csv(tmp_path / "t" / "positions.csv")
    np.testing.assert_allclose(positions[["y_px", "x_px"]], [[20, 10], [10, 30]])  # centres of those pixels
    assert Model.stored_in(files.read_movie(tmp_path / "m.tif").metadata).sample.n_molecules == 2


# --- denoise, traces, compare, calibrate, design -------------------------------------------------------------


def test_denoised_photons_are_unbiased_and_nearer_to_the_light(cli, movie_file, model_file, tmp_path):
    assert cli("denoise", movie_file, "--model", model_file, "--out", tmp_path / "d.tif")[0] == 0
    photons = files.load(tmp_path / "d.tif")
    model = Model.from_json(model_file)
    truth = nm.simulate(model, seed=3).optical
    raw = nm.denoise(files.load(movie_file), model.camera, method="none")
    assert photons.dtype == np.float32 and photons.shape == truth.shape
    assert np.mean((photons - truth) ** 2) < 0.2 * np.mean((raw - truth) ** 2)
    # 276 480 pixels with a sd of about 5 photons: the mean is known to 0.01; five of them.
    assert photons.mean() == pytest.approx(truth.mean(), abs=0.05)

    assert cli("denoise", movie_file, "--model", model_file, "--out", tmp_path / "d.zarr")[0] == 0
    np.testing.assert_array_equal(files.load(tmp_path / "d.zarr"), photons)
    assert leftovers(tmp_path) == ["d.tif", "d.zarr"]


@pytest.fixture(scope="module")
def photons_file(movie_file, model_file) -> Path:
    path = movie_file.with_name("photons.ome.tif")
    with pytest.raises(SystemExit) as left:
        main(["denoise", str(movie_file), "--model", str(model_file), "--out", str(path)])
    assert not left.value.code
    return path


def test_a_denoised_file_says_what_it_holds(cli, photons_file, model_file):
    found = files.read_movie(photons_file)
    assert (found.metadata["role"], found.metadata["unit"]) == ("photons", "photons per pixel and frame")
    assert Model.stored_in(found.metadata) == Model.from_json(model_file) and found.seed is None
    code, out, _ = cli("info", photons_file)
    assert code == 0 and "photons per pixel and frame" in out


@pytest.mark.parametrize("verb", ["denoise", "compare", "calibrate", "propose", "diagnose", "refine"])
def test_verbs_that_need_counts_refuse_photons(cli, told, photons_file, model_file, tmp_path, verb):
    out = tmp_path / {"denoise": "d.tif", "calibrate": "c.json", "propose": "m.json"}.get(verb, "folder")
    others = [] if verb in ("calibrate", "propose") else ["--model", model_file]
    others += ["--add", "stage_drift"] if verb == "refine" else []
    code, _, err = cli(verb, photons_file, *others, "--out", out)
    assert code == 2 and "holds photons, not camera counts" in err and err.count("\n") == 1
    assert leftovers(tmp_path) == []


def test_traces_of_photons_have_the_level_of_traces_of_counts(cli, photons_file, movie_file, model_file, tmp_path):
    levels = []
    for name, movie in (("counts", movie_file), ("photons", photons_file)):
        assert cli("traces", movie, "--model", model_file, "--out", tmp_path / name)[0] == 0
        molecules = pd.read_csv(tmp_path / name / "molecules.csv")
        levels.append(molecules["brightness"][molecules["kept"]].median())
    # Of the same molecules; denoising moves a little of their light to neighbouring pixels.
    assert levels[1] == pytest.approx(levels[0], rel=0.1)
    code, _, err = cli("traces", photons_file, "--model", model_file, "--dark", movie_file, "--out", tmp_path / "dark")
    assert code == 2 and "--dark belongs to camera counts" in err


def test_traces_are_tables_whose_level_is_the_designs(cli, movie_file, model_file, tmp_path):
    from napari_mufasa.design.predict import predict

    code, out, _ = cli("traces", movie_file, "--model", model_file, "--out", tmp_path / "t")
    assert code == 0 and "molecules kept" in out
    traces, molecules = pd.read_csv(tmp_path / "t/traces.csv"), pd.read_csv(tmp_path / "t/molecules.csv")
    assert list(traces.columns) == ["molecule", "frame", "photoelectrons"]
    assert {"molecule", "y_px", "x_px", "kept", "reason"} <= set(molecules.columns)
    assert set(traces["molecule"]) == set(molecules["molecule"][molecules["kept"]]) and molecules["kept"].sum() >= 5
    assert traces.groupby("molecule")["frame"].apply(list).map(lambda f: f == list(range(120))).all()
    # Five or more traces of 120 frames with SNR 4: the mean level is known to 1 %; the rest is the PSF fit.
    level = traces["photoelectrons"].mean()
    assert level == pytest.approx(predict(Model.from_json(model_file)).detected_e_per_frame, rel=0.06)
    assert {"traces.png", "molecules.png"} <= set(leftovers(tmp_path / "t"))


def test_traces_follow_molecules(cli, movie_file, model_file, tmp_path):
    shared = ("traces", movie_file, "--model", model_file)
    code, out, _ = cli(*shared, "--follow-molecules", "--max-step", 2, "--max-gap", 3, "--out", tmp_path / "t")
    assert code == 0 and "followed molecules: found in" in out and "px² per frame" in out
    assert not (tmp_path / "t/traces.openfret.json").exists()
    molecules, paths = pd.read_csv(tmp_path / "t/molecules.csv"), pd.read_csv(tmp_path / "t/paths.csv")
    kept = molecules[molecules["kept"]]
    assert {"diffusion_px2_per_frame", "drift_y_px_per_frame", "found_frames"} <= set(kept.columns) and len(kept) >= 5
    assert list(paths.columns) == ["molecule", "frame", "y_px", "x_px"] and set(paths["molecule"]) == set(
        kept["molecule"]
    )
    code, _, err = cli(*shared, "--max-step", 2, "--out", tmp_path / "u")
    assert code == 2 and "--follow-molecules" in err


@pytest.mark.parametrize(
    ("value", "word"),
    [(300, "nothing was recorded"), (65535, "saturated"), (None, "all frames of the movie are equal")],
)
def test_a_movie_that_shows_nothing_is_one_line(cli, model_file, tmp_path, value, word):
    still = np.random.default_rng(0).integers(200, 300, (48, 48)).astype(np.uint16)
    frame = still if value is None else np.full((48, 48), value, np.uint16)
    tifffile.imwrite(tmp_path / "m.tif", np.repeat(frame[None], 30, axis=0), photometric="minisblack")
    code, out, err = cli("traces", tmp_path / "m.tif", "--model", model_file, "--out", tmp_path / "t")
    assert code == 2 and out == "" and word in err
    assert len(err.strip().splitlines()) == 1 and "Traceback" not in err
    assert not (tmp_path / "t").exists()


def test_window_and_best_cut_the_traces(cli, model_file, tmp_path):
    from napari_mufasa.files import traces as trace_files

    bleaching = Model.from_json(model_file).with_values({"fluorophore.cycles_before_bleaching": 8e4})
    bleaching.to_json(tmp_path / "b.json")
    cli("simulate", "--model", tmp_path / "b.json", "--frames", 300, "--out", tmp_path / "m.tif", "--seed", 1)
    code, _, _ = cli("traces", tmp_path / "m.tif", "--model", tmp_path / "b.json", "--window", 20, "--best", 3,
                     "--out", tmp_path / "t")  # fmt: skip
    assert code == 0
    values, unit = trace_files.read_traces(tmp_path / "t/traces.csv")
    assert values.shape == (3, 20) and unit == "photoelectrons"
    table = pd.read_csv(tmp_path / "t/traces.csv")
    molecules = pd.read_csv(tmp_path / "t/molecules.csv").set_index("molecule")
    first = table.groupby("molecule")["frame"].min()
    assert (first == molecules.loc[first.index, "window_start"]).all()


def test_what_a_trace_holds_and_which_are_kept_are_options(cli, movie_file, model_file, tmp_path):
    shared = ("traces", movie_file, "--model", model_file)
    assert cli(*shared, "--profile", "brightest_pixel", "--follow-drift", "--hdf5", "--out", tmp_path / "one")[0] == 0
    assert cli(*shared, "--with-background", "--max-steps", 0, "--min-snr", 2, "--out", tmp_path / "two")[0] == 0
    assert cli(*shared, "--threshold", "percentile", "--threshold-value", 99.95, "--out", tmp_path / "three")[0] == 0
    one, two = (pd.read_csv(tmp_path / name / "traces.csv") for name in ("one", "two"))
    assert "traces.h5" in leftovers(tmp_path / "one") and "traces.h5" not in leftovers(tmp_path / "two")
    whole = pd.read_csv(tmp_path / "two/molecules.csv")
    kept = whole[whole["kept"]]
    assert len(kept) and (kept["n_steps"] == 0).all() and (kept["snr"] >= 2).all()
    # One pixel of a spot 1.27 px wide holds 9 % of it; nine photoelectrons of background fill a whole spot's weights.
    assert one["photoelectrons"].mean() < 0.2 * kept["brightness"].mean() < two["photoelectrons"].mean()
    assert len(pd.read_csv(tmp_path / "three/molecules.csv")) < len(whole)


def test_diagnose_takes_a_table_of_traces(cli, model_file, tmp_path, monkeypatch):
    from napari_mufasa.compare.simulated import FarApart
    from napari_mufasa.discover import investigation
    from napari_mufasa.files.traces import write_trace_file
    from napari_mufasa.traces import Options

    monkeypatch.setattr(investigation, "candidate_kinds", lambda: ["photobleaching"])
    model = Model.from_json(model_file)
    hidden = model.with_values({"effects": [{"kind": "photobleaching", "rate_per_s": 0.5}]})
    field = FarApart(model.sigma_px, 80, Options(psf_sigma_px=model.sigma_px), 1, quick=True)
    write_trace_file(tmp_path / "t.csv", field.traces(field.acquisition(hidden, 1)))
    code, out, _ = cli("diagnose", tmp_path / "t.csv", "--traces", "--model", model_file, "--out", tmp_path / "d")
    assert code == 0 and "Missing from the model: photobleaching." in out and "W1 (photoelectrons per frame)" in out
    assert {"report.html", "model.json", "report.json", "traces.png", "curves.png"} <= set(leftovers(tmp_path / "d"))
    assert all(is_one_of(name, DIAGNOSIS) for name in leftovers(tmp_path / "d"))
    report = json.loads((tmp_path / "d/report.json").read_text())
    assert Model.from_json(tmp_path / "d/model.json") == Model.from_dict(report["model"])
    # Of 40 traces over 1.2 mean lives, fitted and told apart by two laws: six other movies scatter by e^0.41.
    assert 0.5 / 4 < report["ranking"][0]["parameters"]["rate_per_s"] < 0.5 * 4


def test_power_tells_how_often_an_effect_is_seen(cli, model_file, tmp_path, monkeypatch):
    from napari_mufasa import discover

    asked = {}

    def answer(model, effect, strengths, **given):
        asked.update(given, effect=effect, strengths=strengths)
        return [power(effect.model_copy(update={"rms_adu": s}), 10, n) for s, n in ((1, 2), (4, 10))]

    monkeypatch.setattr(discover, "power", answer)
    table = tmp_path / "power.csv"
    code, out, _ = cli("power", "--model", model_file, "--effect", "row_noise:form=rows", "--strength", "1,4",
                       "--movies", 10, "--dark-frames", 7, "--out", table)  # fmt: skip
    assert code == 0 and asked["strengths"] == [1.0, 4.0] and asked["effect"].kind == "row_noise"
    assert asked["movies"] == 10 and asked["dark_frames"] == 7
    rows = pd.read_csv(table)
    assert rows["rms_adu"].tolist() == [1, 4] and rows["power"].tolist() == [0.2, 1.0]
    assert (rows["power_low"] < rows["power"]).all() and rows["power_high"].between(rows["power"], 1).all()
    assert "from rms_adu = 3.36 on" in out and "must promise 12 (median of 1 diagnoses)" in out


def test_compare_finds_the_true_model_nearer_than_a_wrong_one(cli, movie_file, model_file, tmp_path):
    Model.from_json(model_file).with_values({"excitation.power_density_w_per_cm2": 60}).to_json(tmp_path / "w.json")
    found = {}
    for name, model in (("true", model_file), ("wrong", tmp_path / "w.json")):
        assert cli("compare", movie_file, "--model", model, "--out", tmp_path / name)[0] == 0
        found[name] = json.loads((tmp_path / name / "report.json").read_text())["w1"]
        assert set(found[name]) >= {"mufasa", "poisson", "sofi", "floor", "unit"}
        assert {"w1.png", "counts.png"} <= set(leftovers(tmp_path / name))
    # The level doubles, so W1 grows by about 100 photoelectrons; the floor is a few.
    assert found["wrong"]["mufasa"] > 70 > 15 > found["true"]["mufasa"]
    assert found["true"]["unit"] == "photoelectrons per frame"


def test_compare_tells_intervals_and_why_there_is_no_floor(cli, model_file, tmp_path):
    rng = np.random.default_rng(1)
    for n in (6, 1):
        signal = 102 + 24 * rng.standard_normal((n, 20))
        table = pd.DataFrame({"molecule": np.repeat(np.arange(n), 20), "frame": np.tile(np.arange(20), n)})
        table.assign(photoelectrons=signal.ravel()).to_csv(tmp_path / f"{n}.csv", index=False)
        out_dir = tmp_path / f"c{n}"
        code, out, _ = cli("compare", "--traces", tmp_path / f"{n}.csv", "--model", model_file, "--out", out_dir)
        low, high = json.loads((out_dir / "report.json").read_text())["w1_interval_95"]["mufasa"]
        assert code == 0 and f"[{low:.4g}, {high:.4g}]" in out and "nan" not in out
        assert ("too few molecules for a floor" in out) == (n == 1)


@pytest.mark.parametrize(
    ("reasons", "told"),
    [
        (
            ["no 20 active frames", "no 20 active frames", "SNR 0.3", "SNR 0.4", ""],
            ["2 × no 20 active frames", "2 × SNR …"],
        ),
        (["border", "", ""], ["1 × border"]),
        (["", ""], []),
    ],
)
def test_a_reason_that_all_share_keeps_its_number(capsys, reasons, told):
    from types import SimpleNamespace

    from napari_mufasa.cli import console

    kept = np.array([not reason for reason in reasons])
    found = SimpleNamespace(kept=kept, molecules=pd.DataFrame({"reason": reasons}), path_px=None, notes=())
    console.tell_molecules(Path("out"), found)
    first, *rest = capsys.readouterr().out.splitlines()
    assert f"{kept.sum()} molecules kept of {len(reasons)}" in first and [line.strip() for line in rest] == told


def test_a_stopped_demo_says_that_files_stay(cli, monkeypatch, tmp_path):
    def stops(*_: object, **__: object) -> None:
        raise nm.Cancelled

    monkeypatch.setattr("napari_mufasa.cli.demo.investigate", stops)
    code, _, err = cli("demo", "--out", tmp_path / "d")
    assert code == 130 and leftovers(tmp_path / "d") and "stay: add --overwrite" in err


def test_propose_takes_what_the_movies_own_model_states(cli, movie_file, model_file, tmp_path):
    code, out, _ = cli("propose", movie_file, "--out", tmp_path / "p.json")
    own, found = Model.from_json(model_file), Model.from_json(tmp_path / "p.json")
    assert code == 0 and "not in the metadata" not in out
    assert found.acquisition.frame_length_s == own.acquisition.frame_length_s
    assert found.acquisition.pixel_size_nm == own.acquisition.pixel_size_nm
    assert found.excitation.wavelength_nm == own.excitation.wavelength_nm


def test_compare_takes_traces(cli, model_file, tmp_path):
    rng = np.random.default_rng(1)
    signal = 102 + 24 * rng.standard_normal((6, 20))  # level and noise of this model, by `design`
    table = pd.DataFrame({"molecule": np.repeat(np.arange(6), 20), "frame": np.tile(np.arange(20), 6)})
    table.assign(photoelectrons=signal.ravel()).to_csv(tmp_path / "t.csv", index=False)
    code, out, _ = cli("compare", "--traces", tmp_path / "t.csv", "--model", model_file, "--out", tmp_path / "c")
    assert code == 0 and "floor" in out
    w1 = json.loads((tmp_path / "c/report.json").read_text())["w1"]
    assert w1["mufasa"] < 15 and w1["unit"] == "photoelectrons per frame"


def test_calibrate_recovers_the_camera(cli, model_file, tmp_path):
    bright = Model.from_json(model_file).with_values({"optics.background_photons_per_px": 30})
    still = bright.with_effects(nm.Model.from_dict(MODEL | {"effects": [{"kind": "background_gradient"}]}).effects[0])
    movie, dark = nm.simulate(still, seed=1).movie, nm.simulate_dark(still, 60, seed=2)
    files.write_movie(tmp_path / "m.tif", [movie], movie.shape, movie.dtype)
    files.write_movie(tmp_path / "d.tif", [dark], dark.shape, dark.dtype)
    code, out, _ = cli("calibrate", tmp_path / "m.tif", "--dark", tmp_path / "d.tif", "--em-gain", 300,
                       "--out", tmp_path / "camera.json")  # fmt: skip
    assert code == 0 and "baseline" in out
    camera = nm.Camera(**json.loads((tmp_path / "camera.json").read_text()))
    assert camera.type == "EMCCD" and camera.em_gain == 300
    assert camera.electrons_per_adu == pytest.approx(12, rel=0.05)
    assert camera.baseline_adu == pytest.approx(200, abs=0.5)
    assert camera.read_noise_e == pytest.approx(50, rel=0.1)


def test_design_prints_and_writes_a_sweep(cli, model_file, tmp_path):
    code, out, _ = cli("design", "--model", model_file, "--vary", "excitation.power_density_w_per_cm2=1,10,100",
                       "--out", tmp_path / "d.csv")  # fmt: skip
    assert code == 0 and "snr_spot" in out
    table = pd.read_csv(tmp_path / "d.csv")
    np.testing.assert_allclose(table["k01_per_s"] / table["k01_per_s"][0], [1, 10, 100])


def test_design_solves_for_targets_and_draws_maps(cli, model_file, tmp_path):
    code, out, _ = cli("design", "--model", model_file, "--target", "snr_spot=5", "--out-model", tmp_path / "m.json")
    assert code == 0 and "met at" in out
    assert nm.predict(Model.from_json(tmp_path / "m.json")).snr_spot == pytest.approx(5)
    for name, begins in (("map.png", b"\x89PNG"), ("map.SVG", b"<?xml")):
        code, _, _ = cli("design", "--model", model_file, "--vary", "excitation.power_density_w_per_cm2=1,10,100",
                         "--vary", "optics.psf_fwhm_nm=250,300", "--figure", tmp_path / name)  # fmt: skip
        assert code == 0 and (tmp_path / name).read_bytes().startswith(begins)


@pytest.mark.parametrize("by", ["power", "exposure"])
def test_simulate_solves_for_a_signal_to_noise(cli, model_file, tmp_path, by):
    movie = tmp_path / "m.ome.tif"
    code, out, _ = cli("simulate", "--model", model_file, "--snr", 4, "--snr-by", by, "--frames", 3, "--out", movie)
    assert code == 0 and "wanted 4: met" in out
    assert nm.predict(Model.stored_in(files.read_movie(movie).metadata)).snr_spot == pytest.approx(4)


def test_diagnose_notes_a_model_that_cannot_be_the_movies(cli, movie_file, model_file, tmp_path, told):
    other = Model.from_json(model_file).with_values({"camera.baseline_adu": 900.0})
    other.to_json(tmp_path / "other.json")
    code, _, err = cli("diagnose", movie_file, "--model", tmp_path / "other.json", "--out", tmp_path / "d")
    assert code == 0 and "darkest pixels" in err and "propose" in err
    code, _, err = cli("diagnose", movie_file, "--model", model_file, "--out", tmp_path / "e")
    assert code == 0 and "may not belong" not in err


@pytest.mark.parametrize("verb", ["traces", "denoise", "compare"])
def test_a_wrong_model_is_told_while_the_work_begins_with_a_command_that_works(
    cli, movie_file, model_file, tmp_path, monkeypatch, verb
):
    def stops(*_: object, progress, **__: object) -> None:
        progress(1, 100)
        raise nm.Cancelled

    movie = tmp_path / "my movie.ome.tif"
    movie.write_bytes(movie_file.read_bytes())
    Model.from_json(model_file).with_values({"camera.baseline_adu": 900.0}).to_json(tmp_path / "other.json")
    out = tmp_path / ("d.tif" if verb == "denoise" else "folder")
    with monkeypatch.context() as patched:
        for name in (("traces", "extract_traces"), ("denoise.pipeline", "denoised"), ("compare", "compare_movie")):
            patched.setattr(importlib.import_module(f"napari_mufasa.{name[0]}"), name[1], stops)
        code, _, err = cli(verb, movie, "--model", tmp_path / "other.json", "--out", out)
    assert code == 130 and "darkest pixels" in err and err.index("darkest pixels") < err.index("stopped")
    monkeypatch.chdir(tmp_path)
    _, *command = shlex.split(err.split("made by: ")[1].splitlines()[0])
    assert cli(*command)[0] == 0 and (tmp_path / "proposed.json").exists()


def test_a_failure_after_the_work_began_is_one_line_where_stderr_is_piped(
    cli, movie_file, model_file, tmp_path, monkeypatch
):
    def fails(*_: object, progress, **__: object) -> None:
        progress(1, 100)
        raise nm.MufasaError("frame 7 is not a number: leave it out")

    Model.from_json(model_file).with_values({"camera.baseline_adu": 900.0}).to_json(tmp_path / "other.json")
    monkeypatch.setattr(importlib.import_module("napari_mufasa.traces"), "extract_traces", fails)
    code, _, err = cli("traces", movie_file, "--model", tmp_path / "other.json", "--out", tmp_path / "out")
    assert code == 2 and err == "napari-mufasa: frame 7 is not a number: leave it out\n"


@pytest.mark.parametrize("verb", ["traces", "compare", "simulate"])
def test_the_folder_one_stands_in_can_be_written_into(cli, movie_file, model_file, tmp_path, monkeypatch, verb):
    monkeypatch.chdir(tmp_path)
    given = ["--frames", 2, "--out", "m.tif", "--truth", "."] if verb == "simulate" else [movie_file, "--out", "."]
    assert cli(verb, *given, "--model", model_file)[0] == 0
    written = {"traces": "traces.csv", "compare": "report.json", "simulate": "emission.csv"}[verb]
    assert written in leftovers(tmp_path) and not [name for name in leftovers(tmp_path) if name.startswith(".")]


def test_infer_writes_the_model_of_traces(cli, model_file, tmp_path):
    from benchmarks.inference import recorded

    model = Model.from_json(model_file).with_values({"acquisition.n_frames": 60})
    files.traces.write_trace_file(tmp_path / "t.csv", recorded(model, 30, seed=2))
    code, out, _ = cli("infer", tmp_path / "t.csv", "--model", model_file, "--out", tmp_path / "inferred.json",
                       "--report", tmp_path / "r.json")  # fmt: skip
    assert code == 0 and "only as their product" in out
    level = json.loads((tmp_path / "r.json").read_text())["values"]["level_e"]["value"]
    assert level == pytest.approx(nm.predict(model).detected_e_per_frame, rel=0.05)
    assert nm.predict(Model.from_json(tmp_path / "inferred.json")).detected_e_per_frame == pytest.approx(
        level, rel=0.01
    )


# --- diagnose, refine ----------------------------------------------------------------------------------------


@pytest.fixture
def told(monkeypatch):
    """The discovery answered by a made-up report; keeps what it was asked."""
    from napari_mufasa import discover
    from napari_mufasa.report import figures
    from napari_mufasa.report import html as html_report

    asked = {}

    def answer(movie, model, *others, **options):
        asked.update(shape=movie.shape, model=model, others=others, options=options)
        return report()

    monkeypatch.setattr(discover, "diagnose", answer)
    monkeypatch.setattr(discover, "refine", answer)
    monkeypatch.setattr(html_report, "_picture", lambda drawing: {"light": "", "dark": ""})
    monkeypatch.setattr(figures.Drawing, "render", lambda self, theme, kind="png": b"")
    return asked


def test_diagnose_writes_report_and_says_the_verdict(cli, told, movie_file, model_file, tmp_path):
    code, out, _ = cli("diagnose", movie_file, "--model", model_file, "--dark", movie_file, "--out", tmp_path / "d",
                       "--seed", 7)  # fmt: skip
    assert code == 0 and "Missing from the model: fast dark-state blinking." in out
    assert told["shape"] == (120, 48, 48) and told["model"] == Model.from_json(model_file)
    assert told["others"][0].shape == (120, 48, 48) and told["options"]["seed"] == 7
    data = json.loads((tmp_path / "d/report.json").read_text())
    assert data["verdict"] == "missing_effect" and data["chosen"] == ["triplet_blinking"]
    assert {"error", "failing", "ranking", "history", "model", "seconds", "seed"} <= set(data)
    assert Model.from_dict(data["model"]) == Model.from_json(tmp_path / "d/model.json")
    assert "triplet" in (tmp_path / "d/report.html").read_text()


@pytest.mark.parametrize("how", ["other movie", "halves"])
def test_diagnose_says_whether_it_holds_elsewhere(cli, told, movie_file, model_file, tmp_path, monkeypatch, how):
    from napari_mufasa import discover

    seen = {}

    def held(*given, **options):
        seen.update(given=given, options=options)
        error = {"before": 2.9, "carried": 1.2, "after": 1.1, "floor": 1.0}
        return discover.Confirmation(report(), report(), error)

    monkeypatch.setattr(discover, "confirm" if how == "other movie" else "confirm_halves", held)
    asked = ["--check", movie_file] if how == "other movie" else ["--halves"]
    out_dir = tmp_path / "d"
    code, out, _ = cli("diagnose", movie_file, "--model", model_file, "--out", out_dir, "--seed", 7, *asked)
    against = movie_file.name if how == "other movie" else "the two halves of the field, apart"
    assert code == 0 and f"Checked on {against}: 1 of 1 effects are named in both." in out
    assert seen["options"]["seed"] == 7
    *_, movie, model, dark = seen["given"]
    assert movie.shape == (120, 48, 48) and model == Model.from_json(model_file) and dark is None
    data = json.loads((out_dir / "report.json").read_text())
    assert data["check"]["both"] == ["triplet_blinking"] and data["check"]["error"]["carried"] == 1.2
    assert "Does it hold elsewhere?" in (out_dir / "report.html").read_text()


def test_a_movie_to_check_on_is_opened_before_the_diagnosis(cli, told, movie_file, model_file, tmp_path):
    code, _, err = cli("diagnose", movie_file, "--model", model_file, "--out", tmp_path / "d", "--check", "none.tif")
    assert code == 2 and "none.tif" in err and not told


def test_refine_adds_what_the_user_names(cli, told, movie_file, model_file, tmp_path):
    code, _, _ = cli("refine", movie_file, "--model", model_file, "--add", "stage_drift", "laser_drift:change=-0.3",
                     "--out", tmp_path / "d")  # fmt: skip
    assert code == 0
    kind, effect = told["others"][0]
    assert kind == "stage_drift" and (effect.kind, effect.change) == ("laser_drift", -0.3)


def test_lists_after_add_are_spread(tmp_path):
    asked = ["refine", "--add", "a", "b:x=1", "--out", "dir", "m.tif"]
    assert spread_lists(asked) == ["refine", "--add", "a", "--add", "b:x=1", "--out", "dir", "m.tif"]
    assert spread_lists(["refine", "--add", "a", "m.tif"]) == ["refine", "--add", "a", "m.tif"]
    assert spread_lists(["refine", "m.tif", "--add", "a", "--add", "b"]) == [
        "refine",
        "m.tif",
        "--add",
        "a",
        "--add",
        "b",
    ]


def test_the_words_of_an_option_are_those_of_the_function_it_is_for():
    from napari_mufasa.calibrate.measure import CameraType
    from napari_mufasa.channels.pair import FindIn
    from napari_mufasa.channels.transform import Kind
    from napari_mufasa.cli import options
    from napari_mufasa.compare.simulated import SofiTimes
    from napari_mufasa.denoise.pipeline import Method
    from napari_mufasa.files.traces import Unit
    from napari_mufasa.photophysics.engines import Engine
    from napari_mufasa.spots.aperture import Profile
    from napari_mufasa.spots.find import Threshold

    assert options.EngineName == Engine and options.CameraName == CameraType
    assert options.UnitName == Unit and options.ProfileName == Profile and options.ThresholdName == Threshold
    assert get_args(options.SnrBy) == ("power", "exposure")
    assert options.TimesName == SofiTimes and options.MethodName == Method
    assert options.KindName == Kind and options.FindInName == FindIn


# --- what it prints ------------------------------------------------------------------------------------------


def test_a_table_that_is_piped_is_plain_whole_and_one_line_a_row(tmp_path):
    """Whatever the width and the colours the environment asks for: other programs read it."""
    asked = os.environ | {"COLUMNS": "20", "FORCE_COLOR": "1", "TERM": "xterm-256color"}
    command = [sys.executable, "-m", "napari_mufasa", "presets", "--effects"]
    ran = subprocess.run(command, capture_output=True, text=True, env=asked)
    assert ran.returncode == 0 and "\x1b" not in ran.stdout and "…" not in ran.stdout
    head, *rows = ran.stdout.splitlines()
    assert head.split()[:2] == ["effect", "stage"]
    kinds = nm.effects.catalogue()
    assert [row.split()[0] for row in rows] == list(kinds)
    for row, effect in zip(rows, kinds.values(), strict=True):
        assert all(f"{name}=" in row for name in effect.model_fields) and row == row.rstrip()


@pytest.mark.skipif(os.name == "nt", reason="POSIX terminals")
def test_a_table_on_a_terminal_is_folded_and_loses_nothing():
    import pty

    ours, theirs = pty.openpty()
    running = subprocess.Popen(
        [sys.executable, "-m", "napari_mufasa", "presets", "--effects"], stdout=theirs,
        env=os.environ | {"COLUMNS": "60", "NO_COLOR": "1", "TERM": "xterm"},
    )  # fmt: skip
    os.close(theirs)
    shown = b""
    while True:
        try:
            part = os.read(ours, 65536)
        except OSError:  # the other end is closed
            break
        if not part:
            break
        shown += part
    os.close(ours)
    assert running.wait() == 0
    lines = re.sub(r"\x1b\[[0-9;]*m", "", shown.decode()).splitlines()
    assert max(map(len, lines)) <= 60
    piped = subprocess.run(
        [sys.executable, "-m", "napari_mufasa", "presets", "--effects"], capture_output=True, text=True
    )
    assert Counter("".join("".join(lines).split())) == Counter("".join(piped.stdout.split()))


def test_a_reader_that_leaves_early_is_no_error():
    line = f"{sys.executable} -m napari_mufasa presets --effects | true; exit ${{PIPESTATUS[0]}}"
    ran = subprocess.run(["bash", "-c", line], capture_output=True, text=True)
    assert (ran.returncode, ran.stderr) == (0, "")


def test_brackets_in_a_table_are_no_markup(capsys):
    from napari_mufasa.cli import console

    console.print_table(("[bold]name[/bold]", "value"), [("[red]a", 1.23456), (":smile:", None)])
    assert capsys.readouterr().out == "[bold]name[/bold]  value\n[red]a             1.235\n:smile:            –\n"


# --- how it fails --------------------------------------------------------------------------------------------

BAD = {
    "unknown verb": (["simulat"], "no such command"),
    "unknown option": (["simulate", "--colour", "red"], "no such option"),
    "missing option": (["denoise", "MOVIE", "--out", "OUT/d.tif"], "--model"),
    "no model": (["simulate", "--out", "OUT/m.tif"], "--preset"),
    "unknown preset": (["simulate", "--preset", "FFF", "--out", "OUT/m.tif"], "choose one of PALM"),
    "not a number": (["simulate", "--preset", "FF", "--frames", "ten", "--out", "OUT/m.tif"], "--frames"),
    "bad shape": (["simulate", "--preset", "FF", "--shape", "0", "5", "--out", "OUT/m.tif"], "shape_px"),
    "no folder": (["simulate", "--preset", "FF", "--out", "OUT/none/m.tif"], "no folder"),
    "bad suffix": (["simulate", "--preset", "FF", "--out", "OUT/m.avi"], "use .ome.tif"),
    "unknown effect": (["simulate", "--preset", "FF", "--effect", "stage_drft", "--out", "OUT/m.tif"], "stage_drift"),
    "bad effect value": (
        ["simulate", "--preset", "FF", "--effect", "stage_drift:distance_px=-1", "--out", "OUT/m.tif"], "distance_px",
    ),
    "a parameter of another form": (
        ["simulate", "--preset", "FF", "--effect", "photobleaching:fast_fraction=0.9", "--out", "OUT/m.tif"],
        "fast_fraction matters to form=two_populations only: add that, or leave fast_fraction out",
    ),
    "bad effect form": (["simulate", "--preset", "FF", "--effect", "row_noise:2", "--out", "OUT/m.tif"], "NAME=VALUE"),
    "missing movie": (["denoise", "nowhere.tif", "--model", "MODEL", "--out", "OUT/d.tif"], "no file nowhere.tif"),
    "truncated movie": (["denoise", "CUT", "--model", "MODEL", "--out", "OUT/d.tif"], "cut.tif"),
    "not a movie": (["diagnose", "MODEL", "--model", "MODEL", "--out", "OUT/d"], "not a readable"),
    "not a model": (["diagnose", "MOVIE", "--model", "MOVIE", "--out", "OUT/d"], "not readable JSON"),
    "unknown method": (["denoise", "MOVIE", "--model", "MODEL", "--out", "OUT/d.tif", "--method", "magic"], "magic"),
    "movie and traces": (["compare", "MOVIE", "--traces", "MODEL", "--model", "MODEL", "--out", "OUT/c"], "either"),
    "unit of a movie": (["compare", "MOVIE", "--unit", "adu", "--model", "MODEL", "--out", "OUT/c"], "--traces"),
    "steps of traces": (
        ["compare", "--traces", "MODEL", "--max-steps", "1", "--model", "MODEL", "--out", "OUT/c"], "--max-steps",
    ),
    "profile of a movie": (["diagnose", "MOVIE", "--profile", "psf", "--model", "MODEL", "--out", "OUT/c"], "--traces"),
    "check of traces": (
        ["diagnose", "MODEL", "--traces", "--halves", "--model", "MODEL", "--out", "OUT/c"], "--halves",
    ),
    "two checks": (
        ["diagnose", "MOVIE", "--check", "MOVIE", "--halves", "--model", "MODEL", "--out", "OUT/c"], "one of them",
    ),
    "check of nothing": (
        ["diagnose", "MOVIE", "--check", "none.tif", "--model", "MODEL", "--out", "OUT/c"], "none.tif",
    ),
    "no trace table": (["diagnose", "MODEL", "--traces", "--model", "MODEL", "--out", "OUT/c"], "cannot read traces"),
    "not traces": (["compare", "--traces", "MODEL", "--model", "MODEL", "--out", "OUT/c"], "cannot read traces"),
    "out is a file": (["traces", "MOVIE", "--model", "MODEL", "--out", "MODEL"], "is a file"),
    "unknown effect to add": (["refine", "MOVIE", "--model", "MODEL", "--add", "magic", "--out", "OUT/d"], "magic"),
    "bad target": (["design", "--model", "MODEL", "--target", "snr_spot"], "NAME=VALUE"),
    "a value varied twice": (
        ["design", "--model", "MODEL", "--vary", "optics.psf_fwhm_nm=200", "--vary", "optics.psf_fwhm_nm=300"], "once",
    ),
    "two of one target": (["design", "--model", "MODEL", "--target", "snr_spot=5", "--target", "snr_spot=6"], "once"),
    "solved for nothing": (["design", "--model", "MODEL", "--solve", "optics.psf_fwhm_nm"], "--target"),
    "signal by nothing": (["simulate", "--model", "MODEL", "--snr-by", "exposure", "--out", "OUT/m.tif"], "--snr"),
    "no such target": (["design", "--model", "MODEL", "--target", "loudness=5"], "loudness"),
    "figure of nothing": (["design", "--model", "MODEL", "--figure", "OUT/f.png"], "--vary"),
    "no such signal": (
        ["simulate", "--model", "MODEL", "--snr", "1e9", "--out", "OUT/m.tif"], "cannot be reached; at most",
    ),
    "a table as a movie": (["diagnose", "TABLE", "--model", "MODEL", "--out", "OUT/d"], "add --traces"),
    "scheduler without a port": (
        ["denoise", "MOVIE", "--model", "MODEL", "--scheduler", "foo", "--out", "OUT/d.tif"], "answers at foo",
    ),
    "gain without a register": (
        ["calibrate", "MOVIE", "--type", "CCD", "--em-gain", "300", "--out", "OUT/c.json"], "em_gain = 300: a CCD",
    ),
    "gain of a proposed CCD": (
        ["propose", "MOVIE", "--type", "CCD", "--em-gain", "300", "--out", "OUT/m.json"], "em_gain = 300: a CCD",
    ),
    "dark as bright as the movie": (
        ["calibrate", "MOVIE", "--dark", "MOVIE", "--out", "OUT/c.json"], "no brighter than the dark",
    ),
    "an effect twice": (
        [
            "simulate", "--preset", "FF", "--effect", "stage_drift:distance_px=2", "--effect",
            "stage_drift:distance_px=7", "--out", "OUT/m.tif",
        ],
        "stage_drift is given more than once",
    ),
    "a parameter of an effect twice": (
        ["simulate", "--preset", "FF", "--effect", "stage_drift:distance_px=1,distance_px=5", "--out", "OUT/m.tif"],
        "distance_px twice",
    ),
    "another kind as a parameter": (
        ["simulate", "--preset", "FF", "--effect", "stage_drift:kind=laser_drift", "--out", "OUT/m.tif"], "kind twice",
    ),
    "truth in the movie's place": (
        ["simulate", "--preset", "FF", "--frames", "2", "--out", "OUT/v.tif", "--truth", "OUT/v.tif"],
        "same output twice",
    ),
    "a solved model and a bad sweep": (
        ["design", "--model", "MODEL", "--target", "snr_spot=1", "--out-model", "OUT/m.json", "--vary", "foo.bar=1"],
        "foo",
    ),
    "a figure over words": (
        ["design", "--model", "MODEL", "--vary", "protocol=FF,STORM", "--out", "OUT/t.csv", "--figure", "OUT/f.png"],
        "FF of protocol has no place",
    ),
    "a figure over nothing": (
        [
            "design", "--model", "MODEL", "--vary", "fluorophore.cycles_before_bleaching=null,1000",
            "--vary", "excitation.power_density_w_per_cm2=1,10", "--out", "OUT/t.csv", "--figure", "OUT/f.png",
        ],
        "null of fluorophore",
    ),
    "a figure of another kind": (
        ["design", "--model", "MODEL", "--vary", "optics.psf_fwhm_nm=200,300", "--figure", "OUT/f.pdf"],
        "use .png or .svg",
    ),
    "power drawn into another kind": (
        ["power", "--model", "MODEL", "--effect", "row_noise", "--figure", "OUT/f.jpg"], "use .png or .svg",
    ),
    "a camera drawn into a file without suffix": (
        ["calibrate", "MOVIE", "--out", "OUT/c.json", "--figure", "OUT/f"], "use .png or .svg",
    ),
    "bad sweep": (["design", "--model", "MODEL", "--vary", "power"], "PATH=V1,V2"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_line_exit_2_and_no_file(case, cli, movie_file, model_file, tmp_path):
    cut = tmp_path / "cut.tif"
    cut.write_bytes(movie_file.read_bytes()[:20_000])
    (tmp_path / "out").mkdir()
    table = tmp_path / "t.csv"
    table.write_text("molecule,frame,photoelectrons\n0,0,1\n")
    paths = {
        "TABLE": str(table),
        "MOVIE": str(movie_file),
        "MODEL": str(model_file),
        "CUT": str(cut),
        "OUT": str(tmp_path / "out"),
    }
    arguments, expected = BAD[case]
    arguments = [paths.get(a, re.sub("^OUT", paths["OUT"], a)) for a in arguments]
    before = leftovers(model_file.parent)
    code, _, err = cli(*arguments)
    assert code == 2
    assert err.count("\n") == 1 and err.startswith("napari-mufasa: ") and "Traceback" not in err
    assert expected in err
    assert leftovers(tmp_path / "out") == [] and leftovers(model_file.parent) == before


def test_a_fault_of_ours_is_one_line_and_exit_1_with_the_traceback_on_request(cli, monkeypatch):
    from napari_mufasa.model import presets

    def broken(name: str) -> None:
        raise KeyError("inner")

    monkeypatch.setattr(presets, "preset", broken)
    code, _, err = cli("presets", "FF")
    assert code == 1 and err.count("\n") == 1 and "KeyError" in err and "report" in err
    code, _, err = cli("presets", "FF", "--debug")
    assert code == 1 and "Traceback" in err and "broken" in err


def test_a_full_disk_is_told_in_one_line(cli, monkeypatch, tmp_path):
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device", str(tmp_path / "m.tif"))

    monkeypatch.setattr(files, "write_movie", full)
    code, _, err = cli("simulate", "--preset", "FF", "--frames", 2, "--out", tmp_path / "m.tif")
    assert code == 2 and "no space left on device" in err and err.count("\n") == 1


def test_a_failure_while_writing_a_folder_leaves_no_part_of_it(
    cli, told, movie_file, model_file, tmp_path, monkeypatch
):
    from napari_mufasa.errors import MufasaError
    from napari_mufasa.report import html as html_report

    def fails(*_: object, **__: object) -> str:
        raise MufasaError("no")

    monkeypatch.setattr(html_report, "render", fails)
    code, _, _ = cli("diagnose", movie_file, "--model", model_file, "--out", tmp_path / "d")
    assert code == 2 and leftovers(tmp_path) == []


@pytest.mark.skipif(os.name == "nt", reason="POSIX signals")
def test_ctrl_c_stops_with_130_and_leaves_nothing(tmp_path):
    command = [sys.executable, "-m", "napari_mufasa", "simulate", "--preset", "FF", "--frames", "20000"]
    running = subprocess.Popen(
        [*command, "--shape", "256", "256", "--out", str(tmp_path / "m.ome.tif")], stderr=subprocess.PIPE, text=True
    )
    try:
        deadline = time.monotonic() + 60
        while not leftovers(tmp_path) and time.monotonic() < deadline:  # until it writes
            time.sleep(0.05)
        assert leftovers(tmp_path), "the movie was never begun"
        running.send_signal(signal.SIGINT)
        _, err = running.communicate(timeout=60)
    finally:
        running.kill()
    assert running.returncode == 130
    assert "stopped" in err and "Traceback" not in err
    assert leftovers(tmp_path) == []
