"""Nothing is lost: outputs are whole or not there, older files stay, runs that end early go on from finished blocks."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import tifffile
from tests.trust.broken_files import counts, tiff

import napari_mufasa as nm
from napari_mufasa import files
from napari_mufasa.cli import main
from napari_mufasa.errors import Cancelled, MufasaError
from napari_mufasa.files import growing, outputs
from napari_mufasa.files.traces import write_trace_file
from napari_mufasa.simulate.movie import SimulatedAcquisition

MODEL = nm.preset("FF").with_values(
    {"acquisition.shape_px": (64, 64), "acquisition.n_frames": 700, "sample.n_molecules": 8}
)
SHAPE = (700, 64, 64)
posix = pytest.mark.skipif(os.name != "posix", reason="POSIX limits and signals")


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as left:
        main([str(argument) for argument in arguments])
    return int(left.value.code or 0)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


# older files stay ------------------------------------------------------------------------------------------
@pytest.fixture
def place(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    small = MODEL.with_values({"acquisition.n_frames": 30, "acquisition.shape_px": (32, 32)})
    small.to_json("model.json")
    tiff(tmp_path, nm.simulate(small, seed=1).movie, "movie.tif")
    write_trace_file("traces.csv", np.random.default_rng(0).normal(100, 10, (6, 20)))
    return tmp_path


WRITERS = {
    "simulate tif": ("simulate --model model.json --out m.ome.tif", "m.ome.tif"),
    "simulate zarr": ("simulate --model model.json --out m.zarr", "m.zarr/zarr.json"),
    "truth": ("simulate --model model.json --out n.tif --truth truth", "truth/positions.csv"),
    "denoise": ("denoise movie.tif --model model.json --method none --out d.tif", "d.tif"),
    "traces": ("traces movie.tif --model model.json --out t", "t/molecules.csv"),
    "compare": ("compare --traces traces.csv --model model.json --out c", "c/report.json"),
    "design": ("design --model model.json --out d.csv", "d.csv"),
}


def outcome(file: Path) -> object:
    """What a file holds: of a denoised TIFF the movie, its identifier is drawn anew."""
    return files.load(file) if file.name == "d.tif" else np.frombuffer(file.read_bytes(), np.uint8)


@pytest.mark.parametrize("case", WRITERS)
def test_a_file_is_replaced_only_when_asked_to(case, place, capfd):
    words, file = WRITERS[case]
    assert run(*words.split()) == 0
    first = outcome(place / file)
    (place / file).write_bytes(b"{}" if file.endswith("json") else b"precious")
    before = {path: path.read_bytes() for path in place.rglob("*") if path.is_file()}
    capfd.readouterr()
    assert run(*words.split()) == 2
    told = capfd.readouterr().err
    assert told.count("\n") == 1 and "--overwrite" in told
    assert {path: path.read_bytes() for path in place.rglob("*") if path.is_file()} == before
    assert run(*words.split(), "--overwrite") == 0
    np.testing.assert_array_equal(outcome(place / file), first)


def test_files_of_others_in_the_folder_are_left_alone(place):
    (place / "t").mkdir()
    (place / "t/notes.txt").write_text("mine")
    assert run("traces", "movie.tif", "--model", "model.json", "--out", "t") == 0
    assert (place / "t/notes.txt").read_text() == "mine" and (place / "t/traces.csv").exists()


def test_every_name_that_a_verb_writes_is_looked_for_before(place, monkeypatch):
    """What is written and what is asked for beforehand are one list."""
    run("traces", "movie.tif", "--model", "model.json", "--hdf5", "--out", "t")
    run("compare", "--traces", "traces.csv", "--model", "model.json", "--out", "c")
    run("simulate", "--model", "model.json", "--out", "s.tif", "--truth", "truth")
    for folder, known in (("t", outputs.TRACES), ("c", outputs.COMPARISON), ("truth", outputs.TRUTH)):
        assert all(outputs.is_one_of(name, known) for name in names(place / folder)), folder


def test_a_folder_that_is_written_again_is_of_one_run(place):
    words = ("traces", "movie.tif", "--model", "model.json", "--out", "t")
    assert run(*words, "--hdf5", "--openfret") == 0
    kept = {"notes.txt": "mine", "my traces.csv": "mine", "other.png": "mine", ".paths.csv": "mine"}
    kept["channels.json"] = "what register found"
    (place / "t/donor.csv").write_text("of an earlier run of two channels")
    for name, text in kept.items():
        (place / "t" / name).write_text(text)
    assert run(*words, "--overwrite") == 0
    assert names(place / "t") == sorted(
        [*kept, "molecules.csv", "molecules.png", "traces.csv", "traces.png", "traces.provenance.json"]
    )
    assert {name: (place / "t" / name).read_text() for name in kept} == kept


def test_what_is_written_anew_and_fails_leaves_the_old(tmp_path):
    (tmp_path / "t").mkdir()
    (tmp_path / "t/traces.h5").write_text("old")
    with pytest.raises(Cancelled), files.filling(tmp_path / "t", outputs.TRACES) as folder:
        assert not outputs.is_one_of(folder.name, outputs.TRACES)
        (folder / "traces.csv").write_text("new")
        raise Cancelled
    assert names(tmp_path) == ["t"] and names(tmp_path / "t") == ["traces.h5"]


@pytest.mark.parametrize("there", [True, False])
def test_a_folder_may_be_a_disk_of_its_own(tmp_path, monkeypatch, there):
    """As with `docker -v`: from beside it nothing can be moved into it."""
    disk = tmp_path / "disk"
    disk.mkdir()
    move = os.replace

    def on_one_disk(source, target):
        if disk not in Path(source).parents:
            raise OSError(errno.EXDEV, "Invalid cross-device link", str(source))
        move(source, target)

    monkeypatch.setattr(os, "replace", on_one_disk)
    out = disk if there else disk / "t"
    with files.filling(out) as folder:
        (folder / "traces.csv").write_text("new")
    assert names(out) == ["traces.csv"] and names(tmp_path) == ["disk"]


def test_a_folder_below_one_that_is_locked_is_written_into(place, monkeypatch):
    may = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).resolve() != place and may(path, mode))
    (place / "t").mkdir()
    words = ("traces", "movie.tif", "--model", "model.json", "--out")
    assert run(*words, "t") == 0 and "traces.csv" in names(place / "t")
    assert run(*words, "u") == 2 and not (place / "u").exists()


# failures --------------------------------------------------------------------------------------------------
def acquired(first: int):
    """Blocks of a simulated movie from a frame on."""
    for span, block in SimulatedAcquisition(MODEL, seed=3).blocks(first=first):
        yield span.start, block.movie


@pytest.fixture(scope="module")
def whole():
    return nm.simulate(MODEL, seed=3).movie


@pytest.mark.parametrize("name", ["m.zarr", "m.ome.tif"])
@pytest.mark.parametrize("stops", [1, 3, 5])
def test_a_run_goes_on_from_finished_blocks(name, stops, tmp_path, whole):
    begun: list[int] = []

    def interrupted(first):
        begun.append(first)
        for number, (start, block) in enumerate(acquired(first)):
            if number == stops:
                raise Cancelled
            yield start, block

    made_from = {"seed": 3}
    with pytest.raises(Cancelled):
        files.write_movie(tmp_path / name, interrupted, SHAPE, np.uint16, model=MODEL, seed=3, resume=made_from)
    assert names(tmp_path) == [f".{name}.partial"]

    def onwards(first):
        begun.append(first)
        yield from acquired(first)

    files.write_movie(tmp_path / name, onwards, SHAPE, np.uint16, model=MODEL, seed=3, resume=made_from)
    chunk = growing.chunk_frames(SHAPE, np.uint16)
    assert begun[0] == 0 and begun[1] == stops * 128 // chunk * chunk  # blocks have 128 frames of 64 × 64
    np.testing.assert_array_equal(files.load(tmp_path / name), whole)
    assert names(tmp_path) == [name]
    files.write_movie(tmp_path / f"peace.{name}", acquired, SHAPE, np.uint16, model=MODEL, seed=3)
    assert content(tmp_path / name) == content(tmp_path / f"peace.{name}")  # the same bytes as in one go


def content(path: Path) -> list[bytes]:
    return [part.read_bytes() for part in sorted(path.rglob("*")) if part.is_file()] or [path.read_bytes()]


def test_other_work_does_not_go_on_from_them(tmp_path, whole):
    def interrupted(first):
        yield 0, np.zeros((600, 64, 64), np.uint16)  # of another model
        raise Cancelled

    with pytest.raises(Cancelled):
        files.write_movie(tmp_path / "m.zarr", interrupted, SHAPE, np.uint16, resume={"seed": 4})
    files.write_movie(tmp_path / "m.zarr", acquired, SHAPE, np.uint16, resume={"seed": 3})
    np.testing.assert_array_equal(files.load(tmp_path / "m.zarr"), whole)


def test_a_run_that_starts_anew_leaves_no_old_blocks(tmp_path):
    growing.Growing(tmp_path / "m.zarr", SHAPE, np.uint16, {})
    files.write_movie(tmp_path / "m.zarr", [np.zeros(SHAPE, np.uint16)], SHAPE, np.uint16)
    assert names(tmp_path) == ["m.zarr"]


@pytest.mark.parametrize("first", [0, 1, 31, 32, 40])
def test_denoising_goes_on_to_the_same_movie(first):
    from napari_mufasa.denoise.pipeline import denoised

    movie = counts()
    movie = np.concatenate([movie, movie[::-1], movie])[:70]
    camera = MODEL.camera
    all_of_it = nm.denoise(movie, camera)
    for start, block in denoised(movie, camera, first=first):
        assert start <= first or start % 32 == 0
        np.testing.assert_array_equal(block, all_of_it[start : start + len(block)])


@posix
@pytest.mark.parametrize("name", ["m.ome.tif", "m.zarr", "t.csv", "t.tif", "t.h5", "r.json"])
def test_a_full_disk_leaves_nothing(name, tmp_path):
    """Files may have 8 kB in the child: writing fails in the middle, as on a full disk."""
    code = f"""
import resource, signal, sys
import numpy as np, h5py
from napari_mufasa import files
from napari_mufasa.files.traces import write_trace_file
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (8192, 8192))
noise = np.random.default_rng(0).integers(0, 65535, (30, 64, 64), dtype=np.uint16)
path = {str(tmp_path / name)!r}
if path.endswith(("m.ome.tif", ".zarr")):
    files.write_movie(path, [noise], noise.shape, noise.dtype)
elif path.endswith("json"):
    files.write_json(path, noise)
else:
    write_trace_file(path, noise[0])
"""
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert ran.returncode == 1 and "OSError" in ran.stderr, ran.stderr[-500:]
    assert names(tmp_path) == []


LIMITED = """
import resource, signal, sys
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
from napari_mufasa.cli import main
main(sys.argv[1:])
"""


@posix
@pytest.mark.parametrize(
    "words",
    ["simulate --model model.json --frames 300 --out m.tif", "simulate --model model.json --frames 300 --out m.zarr",
     "simulate --model model.json --out m.tif --resume", "denoise movie.tif --model model.json --out d.tif",
     "traces movie.tif --model model.json --out t", "compare --traces traces.csv --model model.json --out c"],
)  # fmt: skip
def test_a_full_disk_at_the_command_line(words, place):
    before = names(place)
    here = os.environ | {"PYTHONPATH": str(Path(nm.__file__).parents[1])}
    command = [sys.executable, "-c", LIMITED, *words.split()]
    ran = subprocess.run(command, capture_output=True, text=True, cwd=place, env=here)
    assert ran.returncode == 2 and ran.stderr.count("\n") == 1 and "space on the disk" in ran.stderr, ran.stderr
    left = [name for name in names(place) if name not in before]
    assert left == ([".m.tif.partial"] if "--resume" in words else [])  # kept on purpose


@posix
def test_a_killed_process_leaves_no_file_and_the_next_one_clears_up(tmp_path):
    """`make kill` does this twenty times for each of three commands."""
    words = [sys.executable, "-m", "napari_mufasa", "simulate", "--preset", "FF", "--frames", "20000",
             "--out", str(tmp_path / "m.ome.tif")]  # fmt: skip
    running = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 90
        while not names(tmp_path) and time.monotonic() < deadline:
            time.sleep(0.05)
        time.sleep(0.3)
    finally:
        running.send_signal(signal.SIGKILL)
        running.wait()
    left = names(tmp_path)
    assert len(left) == 1 and left[0].startswith(".") and left[0].endswith("-m.ome.tif")
    files.write_movie(tmp_path / "m.ome.tif", [counts()], counts().shape, np.uint16)
    assert names(tmp_path) == ["m.ome.tif"]


@posix
def test_a_terminated_job_clears_up_itself(tmp_path):
    words = [sys.executable, "-m", "napari_mufasa", "simulate", "--preset", "FF", "--frames", "20000",
             "--out", str(tmp_path / "m.ome.tif")]  # fmt: skip
    running = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    try:
        deadline = time.monotonic() + 90
        while not names(tmp_path) and time.monotonic() < deadline:
            time.sleep(0.05)
        running.terminate()
        _, told = running.communicate(timeout=60)
    finally:
        running.kill()
    assert running.returncode == 130 and "stopped" in told and names(tmp_path) == []


def test_what_is_being_written_is_no_ones_leftover(tmp_path):
    """Two writers of one file in one process do not take each other's temporary file away."""
    with files.replacing(tmp_path / "a.txt") as one:
        one.write_text("one")
        with files.replacing(tmp_path / "a.txt") as two:
            two.write_text("two")
        assert (tmp_path / "a.txt").read_text() == "two"
    assert (tmp_path / "a.txt").read_text() == "one" and names(tmp_path) == ["a.txt"]


def test_a_damaged_zarr_of_ours_is_told_not_read_as_zeros(tmp_path, whole):
    """A chunk that is gone would be read as zeros by others' rules."""
    files.write_movie(tmp_path / "m.zarr", [whole], SHAPE, np.uint16)
    chunks = [path for path in (tmp_path / "m.zarr/c").rglob("*") if path.is_file()]
    chunks[-1].unlink()
    with pytest.raises(MufasaError, match="chunks are missing"):
        files.read_movie(tmp_path / "m.zarr")
    zeros = np.zeros((3, 8, 8), np.uint16)  # while a movie of zeros is one
    files.write_movie(tmp_path / "z.zarr", [zeros], zeros.shape, np.uint16)
    np.testing.assert_array_equal(files.load(tmp_path / "z.zarr"), zeros)


# where outputs come from -----------------------------------------------------------------------------------
def test_every_output_says_where_it_comes_from(place):
    for words, _ in WRITERS.values():
        assert run(*words.split()) == 0
    assert run("calibrate", "movie.tif", "--baseline-adu", "367", "--out", "camera.json") in (0, 2)
    said = {}
    for path in place.rglob("*provenance.json"):
        said[str(path.relative_to(place))] = json.loads(path.read_text())
    for name in ("m.ome.tif", "m.zarr", "d.tif"):
        said[name] = files.read_movie(place / name).metadata
    assert {"t/traces.provenance.json", "c/compare.provenance.json", "truth/simulate.provenance.json",
            "d.csv.provenance.json", "m.ome.tif", "m.zarr", "d.tif"} <= set(said)  # fmt: skip
    for name, made in said.items():
        assert made["version"] == nm.__version__, name
        assert made["command"].split()[0] in ("simulate", "denoise", "traces", "compare", "design", "calibrate"), name
        assert "--out" not in made["command"] and str(place) not in made["command"], name
    assert said["m.zarr"]["seed"] == 0 and nm.Model.from_dict(said["m.zarr"]["model"]) == nm.Model.from_json(
        "model.json"
    )
    assert said["c/compare.provenance.json"]["inputs"][0]["name"] == "traces.csv"
    assert said["t/traces.provenance.json"]["model"]["protocol"] == "FF"
    with tifffile.TiffFile(place / "m.ome.tif") as file:
        assert "simulate --model model.json" in file.ome_metadata
