"""Bad input at the doors of info, propose, infer, batch, of solving a design, and of molecules that are followed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.files.microscopes import WRITERS
from tests.trust import broken_files
from tests.trust.broken_files import DARK_MOVIES, MODELS, MOVIES, TRACES, counts, tiff
from tests.trust.refusal import BAD_STACKS, MODEL, check_line, not_none, refused

import napari_mufasa as nm
from napari_mufasa import files
from napari_mufasa.batch import Settings, read_entries, run
from napari_mufasa.calibrate.series import calibrate_gain_series
from napari_mufasa.errors import MufasaError

#: Read as far as a few lines ask: what is damaged farther in is not met by `info`.
FARTHER_IN = ("zarr, lost chunk", "zarr, flipped bit")
GOOD = counts()


# files at the command line ---------------------------------------------------------------------------------
@pytest.mark.parametrize("case", [*MOVIES, *DARK_MOVIES])
def test_a_movie_file_for_a_proposal(case, capfd, place):
    make, word = (MOVIES | DARK_MOVIES)[case]
    word = {"zarr, cut chunk": "2 frames"}.get(case, word)  # too few, before any is read
    refused(capfd, place, word, "propose", make(place / "in"), "--out", "out/model.json")


@pytest.mark.parametrize("case", MOVIES)
def test_a_movie_file_for_info(case, capfd, place):
    make, word = MOVIES[case]
    movie = make(place / "in")
    try:
        refused(capfd, place, word, "info", movie)
    except AssertionError:
        # Not refused: only what cannot be known without reading the pixels.
        with pytest.raises(MufasaError) as told:
            nm.denoise(files.load(movie), MODEL.camera)
        check_line(str(told.value), word)


@pytest.mark.parametrize("case", TRACES)
def test_a_file_of_traces_for_inference(case, capfd, place):
    make, word = TRACES[case]
    refused(capfd, place, word, "infer", make(place / "in"), "--model", "good/model.json", "--out", "out/m.json")


@pytest.mark.parametrize("case", MODELS)
def test_a_model_file_for_a_design(case, capfd, place):
    make, word = MODELS[case]
    refused(capfd, place, word, "design", "--model", make(place / "in"), "--out", "out/t.csv")


@pytest.mark.parametrize("suffix", sorted(WRITERS))
@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.97])
@pytest.mark.parametrize("verb", ["info", "propose"])
def test_a_truncated_file_of_a_microscope(suffix, share, verb, capfd, place):
    path = WRITERS[suffix](place / f"in/m{suffix}", GOOD)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    if verb == "info" and suffix == ".lif" and share > 0.05:  # all that is said of it stands at its beginning
        return
    refused(capfd, place, f"m{suffix}", verb, path, *(["--out", "out/model.json"] if verb == "propose" else []))


# what is asked for -----------------------------------------------------------------------------------------
TO, OF = "--out out/model.json", "infer in/traces.csv --model good/model.json"
BATCH = "batch in/list.csv --model good/model.json --out out/b"
FOLLOW = "traces good/movie.tif --model good/model.json --out out/t"
BAD_COMMANDS: dict[str, tuple[str, str]] = {
    "info: nothing": ("info", "missing argument"),
    "info: no file": ("info none.tif", "no file"),
    "info: an option": ("info good/movie.tif --out out/x", "no such option"),
    "info: a model": ("info good/model.json", "not a readable movie"),
    "propose: nothing": ("propose", "missing argument"),
    "propose: nowhere": ("propose good/movie.tif", "--out"),
    "propose: no folder": ("propose good/movie.tif --out out/none/m.json", "no folder"),
    "propose: over the movie": ("propose good/movie.tif --out good/movie.tif --overwrite", "is also read"),
    "propose: over the dark frames": (
        "propose good/movie.tif --dark good/dark.tif --out good/dark.tif --overwrite", "is also read",
    ),
    "propose: a report over the movie": (
        f"propose good/movie.tif {TO} --report good/movie.tif --overwrite", "is also read",
    ),
    "propose: over a model": ("propose good/movie.tif --out good/model.json", "--overwrite"),
    "propose: an unknown camera": (f"propose good/movie.tif {TO} --type phone", "phone"),
    "propose: quantum efficiency in percent": (f"propose good/movie.tif {TO} --quantum-efficiency 90", "--quantum"),
    "propose: no gain": (f"propose good/movie.tif {TO} --em-gain 0", "--em-gain"),
    "propose: no electrons": (f"propose good/movie.tif {TO} --electrons-per-adu 0", "--electrons"),
    "propose: a gain of words": (f"propose good/movie.tif {TO} --em-gain high", "--em-gain"),
    "propose: no pixel size": (f"propose good/movie.tif {TO} --pixel-size-nm 0", "--pixel-size-nm"),
    "propose: time backwards": (f"propose good/movie.tif {TO} --frame-length-s -1", "--frame-length-s"),
    "propose: not a number": (f"propose good/movie.tif {TO} --frame-length-s nan", "frame"),
    "propose: infinite pixels": (f"propose good/movie.tif {TO} --pixel-size-nm inf", "pixel"),
    "propose: dark frames of another region": (f"propose good/movie.tif --dark in/other.tif {TO}", "dark"),
    "propose: dark frames that are missing": (f"propose good/movie.tif --dark none.tif {TO}", "no file"),
    "infer: no model": ("infer in/traces.csv --out out/m.json", "--model"),
    "infer: a missing model": ("infer in/traces.csv --model none.json --out out/m.json", "no file"),
    "infer: missing traces": ("infer none.csv --model good/model.json --out out/m.json", "no file"),
    "infer: few traces": (f"{OF} {TO}", "too few"),
    "infer: short traces": (f"infer in/short.csv --model good/model.json {TO}", "too short"),
    "infer: dim traces": (f"infer in/dim.csv --model good/model.json {TO}", "bright"),
    "infer: a movie": (f"infer good/movie.tif --model good/model.json {TO}", "needs"),
    "infer: an unknown unit": (f"{OF} {TO} --unit lux", "lux"),
    "infer: over the traces": (f"{OF} --out in/traces.csv --overwrite", "is also read"),
    "infer: over the model": (f"{OF} --out good/model.json --overwrite", "is also read"),
    "infer: a report over the model": (f"{OF} {TO} --report good/model.json --overwrite", "is also read"),
    "infer: model and report are one": (
        f"infer in/many.csv --model good/model.json {TO} --report out/model.json", "twice",
    ),
    "batch: no model": ("batch in/list.csv --out out/b", "no model"),
    "batch: no such folder": ("batch none --model good/model.json --out out/b", "no file or folder"),
    "batch: an empty folder": ("batch out --model good/model.json --out out/b", "holds no movie"),
    "batch: an empty list": ("batch in/empty.csv --model good/model.json --out out/b", "is empty"),
    "batch: a list of a missing movie": ("batch in/missing.csv --model good/model.json --out out/b", "none.tif"),
    "batch: a list of a missing model": ("batch in/model_missing.csv --out out/b", "none.json"),
    "batch: a list of missing dark frames": ("batch in/dark_missing.csv --model good/model.json --out out/b", "dark0"),
    "batch: a list with an unknown column": ("batch in/column.csv --model good/model.json --out out/b", "'colour'"),
    "batch: a list of no movie": ("batch in/none_listed.csv --model good/model.json --out out/b", "lists no movie"),
    "batch: a list that is a TIFF": ("batch good/movie.tif --model good/model.json --out out/b", "is no list"),
    "batch: a model that is missing": ("batch in/list.csv --model none.json --out out/b", "none.json"),
    "batch: a model that is none": ("batch in/list.csv --model in/traces.csv --out out/b", "traces.csv"),
    "batch: dark frames that are missing": (f"{BATCH} --dark none.tif", "none.tif"),
    "batch: an unknown step": (f"{BATCH} --do traces,magic", "magic"),
    "batch: no step": (f"{BATCH} --do ,", "--do"),
    "batch: an unknown effect": (f"{BATCH} --effects stage_drft", "stage_drft"),
    "batch: an unknown method": (f"{BATCH} --do denoise --method magic", "magic"),
    "batch: a negative seed": (f"{BATCH} --seed -1", "--seed"),
    "batch: no budget": (f"{BATCH} --budget 0", "--budget"),
    "batch: out is a file": ("batch in/list.csv --model good/model.json --out good/model.json", "is a file"),
    "design: an unknown target": ("design --model good/model.json --target snr=5", "snr_spot"),
    "design: a target of words": ("design --model good/model.json --target snr_spot=high", "NAME=VALUE"),
    "design: a target without value": ("design --model good/model.json --target snr_spot", "NAME=VALUE"),
    "design: a target that is no number": ("design --model good/model.json --target snr_spot=nan", "snr_spot"),
    "design: an infinite target": ("design --model good/model.json --target snr_spot=inf", "snr_spot"),
    "design: a target out of reach": ("design --model good/model.json --target snr_spot=1e12", "cannot be reached"),
    "design: solving by what is not there": (
        "design --model good/model.json --target snr_spot=5 --solve camera.colour", "camera.colour",
    ),
    "design: solving by words": ("design --model good/model.json --target snr_spot=5 --solve camera.type", "no number"),
    "design: a figure of nothing": ("design --model good/model.json --figure out/f.png", "--vary"),
    "design: a figure of three": (
        "design --model good/model.json --figure out/f.png --vary camera.em_gain=10,20 --vary optics.psf_fwhm_nm=200 "
        "--vary camera.quantum_efficiency=0.9", "--vary",
    ),
    "design: a model without a target": ("design --model good/model.json --out-model out/m.json", "--target"),
    "design: over its model": (
        "design --model good/model.json --target snr_spot=5 --out-model good/model.json --overwrite", "is also read",
    ),
    "design: an absurd sweep": (
        "design --model good/model.json --vary camera.em_gain=" + ",".join(map(str, range(1, 2500))), "combinations",
    ),
    "simulate: no signal": ("simulate --preset FF --snr 0 --out out/m.tif", "--snr"),
    "simulate: a signal of words": ("simulate --preset FF --snr high --out out/m.tif", "--snr"),
    "simulate: a signal out of reach": ("simulate --preset FF --snr 1e12 --out out/m.tif", "snr"),
    "traces: a step without following": (f"{FOLLOW} --max-step 2", "--follow-molecules"),
    "traces: a gap without following": (f"{FOLLOW} --max-gap 2", "--follow-molecules"),
    "traces: no step": (f"{FOLLOW} --follow-molecules --max-step 0", "--max-step"),
    "traces: a step of words": (f"{FOLLOW} --follow-molecules --max-step far", "--max-step"),
    "traces: a negative gap": (f"{FOLLOW} --follow-molecules --max-gap -1", "--max-gap"),
    "design: two outputs in one file": (
        "design --model good/model.json --out out/m --out-model out/m --target snr_spot=5", "twice",
    ),
    "calibrate: camera and report in one file": (
        "calibrate good/movie.tif --out out/c.json --report out/c.json", "twice",
    ),
    "traces: no step, more than one": (f"{FOLLOW} --min-steps 3 --max-steps 2", "steps"),
    "calibrate: a figure over the movie": (
        "calibrate good/movie.tif --out out/c.json --figure good/movie.tif --overwrite", "is also read",
    ),
    "calibrate: a baseline below zero": ("calibrate good/movie.tif --out out/c.json --baseline-adu -1", "--baseline"),
    "diagnose: no budget": ("diagnose good/movie.tif --model good/model.json --out out/d --budget 0", "--budget"),
    "diagnose: a budget of words": (
        "diagnose good/movie.tif --model good/model.json --out out/d --budget much", "--budget",
    ),
}  # fmt: skip


@pytest.fixture
def listed(more: Path) -> Path:
    """Lists of a batch, and tables of traces."""
    lists = {
        "list": "movie\n../good/movie.tif\n", "empty": "\n\n", "missing": "movie\n../good/movie.tif\nnone.tif\n",
        "model_missing": "movie,model\n../good/movie.tif,none.json\n", "none_listed": "movie,model\n,\n",
        "dark_missing": "movie,dark\n../good/movie.tif,dark0.tif\n", "column": "movie,colour\n../good/movie.tif,red\n",
    }  # fmt: skip
    for name, text in lists.items():
        (more / "in" / f"{name}.csv").write_text(text)
    chance = np.random.default_rng(0)
    tables = {"short": chance.normal(100, 5, (80, 5)), "dim": np.zeros((80, 40)), "many": chance.normal(9, 5, (80, 40))}
    for name, table in tables.items():
        files.traces.write_trace_file(more / f"in/{name}.csv", table)
    return more


@pytest.mark.parametrize("case", BAD_COMMANDS)
def test_a_command(case, capfd, listed):
    words, expected = BAD_COMMANDS[case]
    refused(capfd, listed, expected, *words.split())


def test_a_movie_of_a_batch_that_cannot_be_done_is_told_and_the_others_are_done(capfd, listed):
    """Not before the others: one line, exit code 2, and what could be done is there."""
    from napari_mufasa.cli import main

    tiff(listed / "in", np.full((30, 32, 32), 100, np.uint16), "flat.tif")
    (listed / "in/list.csv").write_text("movie\nflat.tif\n../good/movie.tif\n")
    with pytest.raises(SystemExit) as left:
        main([*BATCH.split(), "--do", "traces"])
    out, err = capfd.readouterr()
    assert left.value.code == 2 and "1 of 2 movies could not be done" in err and "movie: 0 molecules" in out
    assert not [path for path in (listed / "out/b").rglob("*") if path.name.startswith(".")]
    assert (listed / "out/b/movie/traces").exists() or (listed / "out/b/movie").exists()


# Python ----------------------------------------------------------------------------------------------------
STACK_DOORS: dict[str, Callable[[Any], Any]] = {
    "propose_model": nm.propose_model,
    "mismatches": lambda movie: nm.mismatches(movie, MODEL),
    "follow molecules": lambda movie: nm.extract_traces(movie, MODEL.camera, psf_sigma_px=1.3, follow_molecules=True),
    "dark of propose_model": lambda dark: nm.propose_model(GOOD, not_none(dark)),
}
BAD_TABLES: dict[str, Any] = {
    "words": "traces", "nothing": None, "a number": 5, "a list of words": [["a"] * 30] * 80,
    "empty": np.zeros((0, 30)), "one axis": np.ones(30), "three axes": GOOD, "nan": np.full((80, 30), np.nan),
    "complex": np.ones((80, 30), complex), "idealised": np.repeat([[0.0, 90.0]], 80, 0).repeat(30, 1),
    "infinite": np.full((80, 30), np.inf), "objects": np.array([[broken_files.Boom()] * 30] * 80, dtype=object),
    "masks": np.ones((80, 30), bool), "no frames": np.ones((80, 0)),
}  # fmt: skip
BRIGHT = np.random.default_rng(0).normal(100, 5, (80, 40))
BAD_CALLS: dict[str, tuple[Callable[[], Any], str]] = {
    "infer: no model": (lambda: nm.infer_photophysics(BRIGHT, None), "model"),
    "infer: a dictionary": (lambda: nm.infer_photophysics(BRIGHT, MODEL.to_dict()), "model"),
    "infer: a unit": (lambda: nm.infer_photophysics(BRIGHT, MODEL, unit="lux"), "unit"),
    "infer: few": (lambda: nm.infer_photophysics(BRIGHT[:3], MODEL), "too few"),
    "infer: short": (lambda: nm.infer_photophysics(BRIGHT[:, :5], MODEL), "too short"),
    "propose: a camera": (lambda: nm.propose_model(GOOD, camera_type="phone"), "camera_type"),
    "propose: quantum efficiency": (lambda: nm.propose_model(GOOD, quantum_efficiency=90), "quantum_efficiency"),
    "propose: no gain": (lambda: nm.propose_model(GOOD, em_gain=0), "em_gain"),
    "propose: no pixel": (lambda: nm.propose_model(GOOD, pixel_size_nm=0), "pixel_size_nm"),
    "propose: pixels of words": (lambda: nm.propose_model(GOOD, pixel_size_nm="small"), "pixel_size_nm"),
    "propose: pixels that are no number": (lambda: nm.propose_model(GOOD, pixel_size_nm=np.nan), "pixel_size_nm"),
    "propose: time backwards": (lambda: nm.propose_model(GOOD, frame_length_s=-1), "frame_length_s"),
    "propose: infinite time": (lambda: nm.propose_model(GOOD, frame_length_s=np.inf), "frame_length_s"),
    "propose: dark of another shape": (lambda: nm.propose_model(GOOD, GOOD[:, :20]), "dark"),
    "mismatches: no model": (lambda: nm.mismatches(GOOD, None), "model"),
    "solve: no model": (lambda: nm.solve(None, {"snr_spot": 5.0}), "model"),
    "solve: no target": (lambda: nm.solve(MODEL, {}), "target"),
    "solve: targets of a number": (lambda: nm.solve(MODEL, 5), "target"),
    "solve: an unknown target": (lambda: nm.solve(MODEL, {"snr": 5.0}), "snr"),
    "solve: words": (lambda: nm.solve(MODEL, {"snr_spot": "high"}), "snr_spot"),
    "solve: not a number": (lambda: nm.solve(MODEL, {"snr_spot": np.nan}), "snr_spot"),
    "solve: no path": (lambda: nm.solve(MODEL, {"snr_spot": 5.0}, "camera"), "camera"),
    "solve: a path of a number": (lambda: nm.solve(MODEL, {"snr_spot": 5.0}, 5), "5"),
    "follow: no step": (
        lambda: nm.extract_traces(GOOD, MODEL.camera, psf_sigma_px=1.3, follow_molecules=True, max_step_px=0),
        "max_step",
    ),
    "follow: a step of words": (
        lambda: nm.extract_traces(GOOD, MODEL.camera, psf_sigma_px=1.3, follow_molecules=True, max_step_px="far"),
        "max_step",
    ),
    "follow: half a gap": (
        lambda: nm.extract_traces(GOOD, MODEL.camera, psf_sigma_px=1.3, follow_molecules=True, max_gap=0.5), "max_gap",
    ),
    "gain series: one": (lambda: calibrate_gain_series([(100.0, GOOD, None)]), "two gains"),
    "gain series: nothing": (lambda: calibrate_gain_series([]), "two gains"),
    "batch: no folder": (lambda: read_entries(Path("none")), "no file or folder"),
    "batch: an unknown step": (lambda: list(run([], Path("b"), Settings(steps=("magic",)))), "magic"),
}  # fmt: skip


@pytest.mark.parametrize("door", STACK_DOORS)
@pytest.mark.parametrize("case", BAD_STACKS)
def test_a_stack_from_python(case, door):
    if door == "mismatches" and case == "negative":
        assert STACK_DOORS[door](BAD_STACKS[case])[0].field == "camera.baseline_adu"  # that is what it is asked
        return
    with pytest.raises(MufasaError) as told:
        STACK_DOORS[door](BAD_STACKS[case])
    check_line(str(told.value), "")


@pytest.mark.parametrize("case", BAD_TABLES)
def test_a_table_of_traces_from_python(case):
    with pytest.raises(MufasaError) as told:
        nm.infer_photophysics(BAD_TABLES[case], MODEL)
    check_line(str(told.value), "")


@pytest.mark.parametrize("case", BAD_CALLS)
def test_a_call_from_python(case, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    call, word = BAD_CALLS[case]
    with pytest.raises(MufasaError) as told:
        call()
    check_line(str(told.value), word)
    assert list(tmp_path.iterdir()) == []


def test_there_are_enough_cases():
    of_commands = 2 * len(MOVIES) + len(DARK_MOVIES) + len(TRACES) + len(MODELS) + len(BAD_COMMANDS) + 37
    of_python = len(BAD_STACKS) * len(STACK_DOORS) + len(BAD_TABLES) + len(BAD_CALLS)
    assert of_commands >= 220 and of_python >= 80
