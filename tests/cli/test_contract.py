"""The contracts of docs/files.md and docs/api.md as somebody outside would check them: names, shapes, files, errors."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import tifffile
from tests.spec_example import EFFECTS, MODEL

import napari_mufasa as nm
from napari_mufasa.cli import main
from napari_mufasa.errors import MufasaError
from napari_mufasa.files import load, write_movie
from napari_mufasa.model.model import Model

# A smaller movie than the example's.
PRINTED = MODEL | {"acquisition": MODEL["acquisition"] | {"n_frames": 60, "shape_px": [64, 64]}}
SPARSE = {"sample": {"n_molecules": 10, "min_distance_px": 9}}


@pytest.fixture(scope="module")
def model() -> Model:
    return Model.from_dict(PRINTED | SPARSE)


@pytest.fixture(scope="module")
def recorded(model):
    return nm.simulate(model, positions_px=None, seed=1)


@pytest.fixture(scope="module")
def files(model, recorded, tmp_path_factory) -> Path:
    """A folder with model.json, movie.ome.tif and dark.tif."""
    folder = tmp_path_factory.mktemp("files")
    model.to_json(folder / "model.json")
    write_movie(folder / "movie.ome.tif", [recorded.movie], recorded.movie.shape, np.uint16, model=model, seed=1)
    tifffile.imwrite(folder / "dark.tif", nm.simulate_dark(model, 20, seed=2))
    return folder


@pytest.fixture
def cli(capfd):
    def run(*arguments: object) -> tuple[int, str]:
        with pytest.raises(SystemExit) as left:
            main([str(argument) for argument in arguments])
        return int(left.value.code or 0), capfd.readouterr().err

    return run


# --- Python ------------------------------------------------------------------------------------------------


def test_the_printed_model_is_a_model_and_survives_the_file(tmp_path):
    (tmp_path / "in.json").write_text(json.dumps(PRINTED))
    model = nm.Model.from_json(tmp_path / "in.json")
    model.to_json(tmp_path / "out.json")
    assert nm.Model.from_json(tmp_path / "out.json") == model
    written = json.loads((tmp_path / "out.json").read_text())
    for part, values in PRINTED.items():
        if isinstance(values, dict):
            assert {key: written[part][key] for key in values} == values, part
        else:
            assert written[part] == values


@pytest.mark.parametrize("engine", ["fast", "exact"])
@pytest.mark.parametrize("name", ["PALM", "STORM", "FF", "Blinking"])
def test_emission_is_whole_photons_per_molecule_and_frame(name, engine):
    preset = nm.preset(name)
    emission = nm.simulate_emission(preset, n_molecules=3, seed=1, engine=engine)
    assert emission.shape == (3, preset.acquisition.n_frames) and emission.dtype.kind == "i" and emission.min() >= 0
    np.testing.assert_array_equal(emission, nm.simulate_emission(preset, n_molecules=3, seed=1, engine=engine))
    assert not np.array_equal(emission, nm.simulate_emission(preset, n_molecules=3, seed=2, engine=engine))


def test_simulation_has_the_named_parts_and_keeps_given_positions(model, recorded):
    assert recorded.emission.shape == (10, 60) and recorded.positions_px.shape == (10, 2)
    assert recorded.optical.shape == recorded.movie.shape == (60, 64, 64)
    assert recorded.movie.dtype == np.uint16 and recorded.model == model
    given = [[10.0, 12.0], [40.5, 30.25]]
    again = nm.simulate(model, positions_px=given, seed=1)
    np.testing.assert_array_equal(again.positions_px, given)
    brightest = np.unravel_index(again.optical[0].argmax(), (64, 64))
    assert min(np.abs(np.subtract(given, brightest)).max(axis=1)) <= 1  # (y, x), not (x, y)


def test_denoise_gives_float32_photons_near_the_light(model, recorded):
    photons = nm.denoise(recorded.movie, model.camera)
    assert photons.dtype == np.float32 and photons.shape == (60, 64, 64)
    # 245 760 pixels, sd about 5 photons: the mean is known to 0.01; five of them.
    assert photons.mean() == pytest.approx(recorded.optical.mean(), abs=0.05)


def test_traces_and_molecules_have_the_named_columns(model, recorded):
    found = nm.extract_traces(recorded.movie, model.camera, dark=nm.simulate_dark(model, 20))
    assert {"molecule", "y_px", "x_px", "kept", "reason"} <= set(found.molecules.columns)
    kept = found.molecules["kept"]
    assert found.traces.shape == (kept.sum(), 60) and kept.sum() >= 3
    assert (found.molecules["reason"][~kept].str.len() > 0).all() and (found.molecules["reason"][kept] == "").all()


def test_wasserstein_takes_both_kinds_of_rows():
    a = np.array([[0.0, 4.0], [8.0, 4.0]])
    assert nm.wasserstein(a, a + 3, rows="frames") == pytest.approx(3)
    assert nm.wasserstein(a, a + 3, rows="traces") == pytest.approx(3 * np.sqrt(2))


@pytest.mark.parametrize("kind", EFFECTS)
def test_every_effect_of_the_contract_is_data_in_a_model(kind):
    model = Model.from_dict(PRINTED | {"effects": [{"kind": kind}]})
    assert Model.from_dict(json.loads(json.dumps(model.to_dict()))) == model
    assert [effect.kind for effect in model.effects] == [kind]


def test_a_diagnosis_has_the_report_of_the_contract(model, tmp_path):
    drifting = model.with_effects(Model.from_dict(PRINTED | {"effects": [{"kind": "stage_drift"}]}).effects[0])
    movie = nm.simulate(drifting, seed=3).movie
    report = nm.diagnose(movie, model, dark=None, seed=1, effects=["stage_drift", "laser_drift"])
    report.to_json(tmp_path / "report.json")
    data = json.loads((tmp_path / "report.json").read_text())
    assert set(data) >= {
        "verdict", "error", "failing", "ranking", "chosen", "history", "model", "seconds", "seed",
    }  # fmt: skip
    assert data["verdict"] == report.verdict and data["verdict"] in ("adequate", "missing_effect", "unexplained")
    assert set(data["error"]) >= {"before", "after", "floor", "unit"} and isinstance(data["error"]["unit"], str)
    assert all(set(row) >= {"observable", "z", "where"} for row in data["failing"])
    assert {row["effect"] for row in data["ranking"]} <= {"stage_drift", "laser_drift"}
    assert all(
        set(row) >= {
            "effect", "p_value", "error_after", "share_explained", "parameters", "parameters_sd",
            "indistinguishable_from",
        }
        for row in data["ranking"]
    )  # fmt: skip
    assert data["history"][0]["model"] == "base" and [row["added"] for row in data["history"][1:]] == data["chosen"]
    assert data["history"][-1]["error"] == data["error"]["after"] and data["seed"] == 1
    assert Model.from_dict(data["model"]) == report.model
    assert nm.simulate(report.model).movie.shape == movie.shape


def test_importing_the_package_brings_no_viewer_and_is_quick():
    code = (
        "import sys, time; start = time.perf_counter(); import napari_mufasa; spent = time.perf_counter() - start\n"
        "heavy = {'qtpy', 'PyQt5', 'PyQt6', 'PySide6', 'napari', 'matplotlib', 'magicgui'} & set(sys.modules)\n"
        "assert not heavy, heavy; print(spent)"
    )
    spent = []
    for _ in range(3):  # a busy machine may disturb one of them
        ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        assert ran.returncode == 0, ran.stderr
        spent.append(float(ran.stdout))
    assert min(spent) < 0.2


# --- files -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".ome.tif", ".zarr"])
def test_the_same_seed_gives_the_same_file_and_the_librarys_movie(cli, files, recorded, tmp_path, suffix):
    for name in ("a", "b"):
        arguments = ("simulate", "--model", files / "model.json", "--seed", 1, "--out", tmp_path / f"{name}{suffix}")
        assert cli(*arguments) == (0, "")
    np.testing.assert_array_equal(load(tmp_path / f"a{suffix}"), recorded.movie)
    assert _content(tmp_path / f"a{suffix}") == _content(tmp_path / f"b{suffix}")


def test_movies_of_other_seeds_have_other_identifiers(cli, files, tmp_path):
    identifiers = set()
    for seed in (1, 2):
        cli("simulate", "--model", files / "model.json", "--frames", 2, "--seed", seed, "--out", tmp_path / "m.ome.tif",
            "--overwrite")  # fmt: skip
        with tifffile.TiffFile(tmp_path / "m.ome.tif") as file:
            identifiers.add(file.ome_metadata.split('UUID="')[1].split('"')[0])
    assert len(identifiers) == 2


def _content(path: Path) -> dict[str, bytes]:
    if path.is_file():
        return {"": path.read_bytes()}
    return {str(part.relative_to(path)): part.read_bytes() for part in sorted(path.rglob("*")) if part.is_file()}


def test_compare_traces_and_calibrate_write_the_named_files(cli, files, tmp_path):
    movie, model, dark = files / "movie.ome.tif", files / "model.json", files / "dark.tif"
    assert (
        cli("traces", movie, "--model", model, "--dark", dark, "--window", 20, "--best", 3, "--out", tmp_path)[0] == 0
    )
    assert list(pd.read_csv(tmp_path / "traces.csv").columns) == ["molecule", "frame", "photoelectrons"]
    assert {"molecule", "y_px", "x_px", "kept", "reason"} <= set(pd.read_csv(tmp_path / "molecules.csv").columns)
    # Both have a place in one folder; a second time it is replaced only when asked to.
    again = ("compare", "--traces", tmp_path / "traces.csv", "--model", model, "--out", tmp_path)
    assert cli(*again)[0] == 0
    code, err = cli(*again)
    assert code == 2 and "would be replaced" in err and "--overwrite" in err
    assert cli(*again, "--overwrite")[0] == 0
    assert set(json.loads((tmp_path / "report.json").read_text())["w1"]) >= {
        "mufasa", "poisson", "sofi", "floor", "unit",
    }  # fmt: skip
    assert (tmp_path / "molecules.csv").exists()
    assert cli("calibrate", movie, "--dark", dark, "--out", tmp_path / "camera.json")[0] == 0
    camera = json.loads((tmp_path / "camera.json").read_text())
    Model.from_dict(PRINTED | {"camera": camera})  # fits into a model.json as it is


def test_calibrate_does_what_its_own_advice_says(cli, files, tmp_path):
    even = ("--model", files / "model.json", "--n-molecules", 0, "--out", tmp_path / "even.tif", "--seed", 4)
    assert cli("simulate", *even)[0] == 0
    arguments = ("calibrate", tmp_path / "even.tif", "--out", tmp_path / "camera.json")
    code, err = cli(*arguments)  # even light and no dark frames: not enough
    assert code == 2 and "baseline_adu" in err and not (tmp_path / "camera.json").exists()
    assert cli(*arguments, "--baseline-adu", 200)[0] == 0
    camera = json.loads((tmp_path / "camera.json").read_text())
    # Over five seeds of such a movie 12.36 ± 0.07 was measured: four of those, and the bias.
    assert camera["baseline_adu"] == 200 and camera["electrons_per_adu"] == pytest.approx(12, abs=0.65)


# --- bad input ---------------------------------------------------------------------------------------------

FRAMES = np.full((30, 32, 32), 210, np.uint16)
SPOILT = FRAMES.astype(float)
SPOILT[3, 4, 5] = np.nan
MOVIES = {
    "two axes too few": FRAMES[0, 0], "four axes": FRAMES[None], "no frame": FRAMES[:0], "no pixel": FRAMES[:, :0],
    "nan": SPOILT, "infinite": np.where(np.isnan(SPOILT), np.inf, SPOILT), "negative": FRAMES.astype(int) - 1000,
    "text": FRAMES.astype(str), "complex": FRAMES.astype(complex), "nothing": None,
}  # fmt: skip


@pytest.mark.parametrize("verb", ["denoise", "extract_traces", "diagnose"])
@pytest.mark.parametrize("case", MOVIES)
def test_a_bad_movie_is_told_in_one_line(model, verb, case):
    call = getattr(nm, verb)
    with pytest.raises(MufasaError) as told:
        call(MOVIES[case], model if verb == "diagnose" else model.camera)
    assert "\n" not in str(told.value)


@pytest.mark.parametrize(
    "dark", [FRAMES[:, :5], np.full((10, 32, 32), np.nan), FRAMES[:0], -FRAMES.astype(int), FRAMES.astype(str)]
)
def test_bad_dark_frames_are_told(model, dark):
    from napari_mufasa.calibrate.measure import calibrate

    with pytest.raises(MufasaError, match="dark"):
        nm.extract_traces(FRAMES, model.camera, dark)
    with pytest.raises(MufasaError, match="dark"):
        calibrate(FRAMES, dark)


@pytest.mark.parametrize("case", ["nan", "negative", "complex"])
def test_calibration_refuses_what_no_camera_records(case):
    from napari_mufasa.calibrate.measure import calibrate

    with pytest.raises(MufasaError, match=r"raw counts|real numbers"):
        calibrate(MOVIES[case], FRAMES)


def test_counts_around_zero_are_fine_once_the_baseline_is_zero(model):
    subtracted = FRAMES.astype(np.float32) - 210 + np.random.default_rng(1).normal(0, 4, FRAMES.shape)
    camera = model.camera.model_copy(update={"baseline_adu": 0.0})
    assert np.isfinite(nm.denoise(subtracted, camera)).all()
    with pytest.raises(MufasaError, match="baseline_adu to 0"):
        nm.denoise(subtracted, model.camera)


def test_the_wrong_thing_is_told_by_name(model):
    for call in (
        lambda: nm.simulate(PRINTED),
        lambda: nm.simulate_emission(None, 3),
        lambda: nm.simulate_dark("m", 3),
    ):
        with pytest.raises(MufasaError, match=r"model is a .*not a Model"):
            call()
    for call in (lambda: nm.denoise(FRAMES, model), lambda: nm.extract_traces(FRAMES, None)):
        with pytest.raises(MufasaError, match=r"give model\.camera"):
            call()
    for positions in ([["a", "b"]], [[1, 2], [3]], np.zeros(3), [[np.nan, 1]], []):
        with pytest.raises(MufasaError, match="positions_px"):
            nm.simulate(model, positions)
    for options in ({"window": 2.5}, {"best": 1.5}, {"best": 0}, {"window": 31}, {"windw": 3}):
        with pytest.raises(MufasaError, match=next(iter(options))):
            nm.extract_traces(FRAMES, model.camera, **options)
    for traces in (np.ones((2, 3), complex), [["a"]], None, np.ones((0, 3)), [[np.nan]]):
        with pytest.raises(MufasaError, match="measured traces"):
            nm.wasserstein(traces, np.ones((2, 3)))
    with pytest.raises(MufasaError, match=r"^the model = \[1\]"):
        Model.from_dict([1])  # type: ignore[arg-type]


def _damaged(files: Path, folder: Path) -> dict[str, Path]:
    movie = files / "movie.ome.tif"
    raw, data = movie.read_bytes(), load(movie)
    made = {name: folder / f"{name}.tif" for name in ("half", "head", "empty", "text", "nan", "negative", "colour")}
    made["half"].write_bytes(raw[: len(raw) // 2])
    made["head"].write_bytes(raw[:100])
    made["empty"].write_bytes(b"")
    made["text"].write_text("no picture")
    tifffile.imwrite(made["nan"], np.where(data > data.max() - 1, np.nan, data).astype(np.float32))
    tifffile.imwrite(made["negative"], data.astype(np.int32) - 1000)
    tifffile.imwrite(made["colour"], np.zeros((5, 64, 64, 3), np.uint8), photometric="rgb")
    return made | {"missing": folder / "missing.tif", "folder": folder}


@pytest.mark.parametrize("verb", ["denoise", "traces", "compare", "calibrate", "diagnose", "refine"])
def test_a_damaged_movie_leaves_one_line_and_nothing_else(cli, files, tmp_path, verb):
    (tmp_path / "in").mkdir()
    (tmp_path / "out").mkdir()
    out = tmp_path / "out" / {"denoise": "d.tif", "calibrate": "camera.json"}.get(verb, "folder")
    others = [] if verb == "calibrate" else ["--model", files / "model.json"]
    others += ["--add", "stage_drift"] if verb == "refine" else []
    others += [] if verb == "denoise" else ["--dark", files / "dark.tif"]
    for what, movie in _damaged(files, tmp_path / "in").items():
        code, err = cli(verb, movie, *others, "--out", out)
        assert code == 2, what
        assert err.count("\n") == 1 and err.startswith("napari-mufasa: ") and "Traceback" not in err, what
        assert list((tmp_path / "out").iterdir()) == [], what


@pytest.mark.parametrize("verb", ["traces", "compare", "diagnose", "demo"])
def test_an_impossible_folder_is_told_before_the_work(cli, files, monkeypatch, verb):
    def never(*_: object, **__: object) -> None:
        raise AssertionError("worked before looking at the output")

    monkeypatch.setattr("napari_mufasa.files.read_movie", never)
    monkeypatch.setattr("napari_mufasa.cli.demo.run", never)
    given = [] if verb == "demo" else [files / "movie.ome.tif", "--model", files / "model.json"]
    code, err = cli(verb, *given, "--out", files / "model.json" / "inside")
    assert code == 2 and "is a file" in err and err.count("\n") == 1


@pytest.mark.skipif(os.name == "nt" or getattr(os, "geteuid", lambda: 0)() == 0, reason="root may write anywhere")
def test_a_locked_folder_is_told_before_the_work(cli, files, tmp_path):
    tmp_path.chmod(0o500)
    try:
        for arguments in (
            ("simulate", "--model", files / "model.json", "--out", tmp_path / "m.tif"),
            ("traces", files / "movie.ome.tif", "--model", files / "model.json", "--out", tmp_path / "t"),
        ):
            code, err = cli(*arguments)
            assert code == 2 and "cannot write into" in err and err.count("\n") == 1
    finally:
        tmp_path.chmod(0o700)


def test_an_empty_list_of_positions_is_no_field(cli, files, tmp_path):
    for text in ("", "y_px,x_px\n", "y_px,x_px\n1,nan\n", "a,b\n1,2\n"):
        (tmp_path / "p.csv").write_text(text)
        code, err = cli("simulate", "--model", files / "model.json", "--positions", tmp_path / "p.csv",
                        "--out", tmp_path / "m.tif")  # fmt: skip
        assert code == 2 and err.count("\n") == 1 and not (tmp_path / "m.tif").exists()
