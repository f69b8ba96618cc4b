"""From file to file: a camera measured on dark frames from the command line, and movies larger than memory."""

from __future__ import annotations

import subprocess
import sys
import textwrap

import numpy as np
import pytest
import tifffile
import zarr
from benchmarks.speed import most_anonymous_gb
from tests.denoise.test_pipeline import EMCCD, record

import napari_mufasa as nm
from napari_mufasa import files
from napari_mufasa.cli import main
from napari_mufasa.denoise import reel


def test_the_command_line_measures_the_camera_on_dark_frames(tmp_path, capsys):
    rng = np.random.default_rng(1)
    truth = np.broadcast_to(np.linspace(2, 12, 64)[None, None, :], (40, 64, 64))
    movie, dark = record(truth, EMCCD, rng), record(np.zeros((30, 64, 64)), EMCCD, rng)
    for name, data in (("movie", movie), ("dark", dark)):
        tifffile.imwrite(tmp_path / f"{name}.tif", data)
    out = tmp_path / "photons.tif"
    with pytest.raises(SystemExit) as left:
        main(["denoise", str(tmp_path / "movie.tif"), "--dark", str(tmp_path / "dark.tif"), "--out", str(out)])
    assert not left.value.code
    assert "camera measured: baseline 200" in capsys.readouterr().out
    photons = files.load(out)
    np.testing.assert_allclose(photons, nm.denoise(movie, dark=dark), rtol=1e-5)
    # Photon transfer knows the gain to a few per cent.
    assert photons.mean() / truth.mean() == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("options", [[], ["--model", "m.json", "--dark", "d.tif"]])
def test_the_command_line_wants_one_source_of_the_camera(options, tmp_path, capsys):
    tifffile.imwrite(tmp_path / "movie.tif", np.zeros((3, 8, 8), np.uint16))
    with pytest.raises(SystemExit) as left:
        main(["denoise", str(tmp_path / "movie.tif"), "--out", str(tmp_path / "o.tif"), *options])
    message = capsys.readouterr().err
    assert left.value.code == 2
    assert "--model" in message and "--dark" in message
    assert not (tmp_path / "o.tif").exists()


def hand_back_what_is_freed(monkeypatch):
    """In processes that begin from here, so that peaks are what is held, and not what the C library keeps, for each
    thread by itself."""
    monkeypatch.setenv("MALLOC_MMAP_THRESHOLD_", "65536")
    monkeypatch.setenv("MALLOC_ARENA_MAX", "1")


#: Denoises a stored movie under a limit on the data that the process may hold, beyond what it holds before.
UNDER_A_LIMIT = """
    import resource, sys, threading, numpy as np, zarr
    import napari_mufasa as nm
    from napari_mufasa.model.setup import Camera

    source, target, limit = sys.argv[1], sys.argv[2], int(sys.argv[3])
    camera = Camera(
        type="EMCCD", quantum_efficiency=0.9, read_noise_e=50, clock_induced_charge_e=0.002, electrons_per_adu=12,
        baseline_adu=200, em_gain=300,
    )
    movie, out = zarr.open(source, mode="r"), zarr.open(target, mode="r+")
    threading.stack_size(2**19)  # how many threads the reader begins hangs on the machine: they shall count little
    nm.denoise(movie[:40], camera)  # compiled code and threads do not count
    held = int(next(line for line in open("/proc/self/status") if line.startswith("VmData")).split()[1]) * 1024
    resource.setrlimit(resource.RLIMIT_DATA, (held + limit, held + limit))
    if len(sys.argv) > 4:
        np.ones(movie.shape, np.float32)  # does not fit
    nm.denoise(movie, camera, out=out)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="limits on a process's data are Linux's")
def test_a_movie_larger_than_memory_streams(tmp_path, monkeypatch):
    # 2000 frames of 160 x 160: 205 MB as float32 and as much again for the result, denoised with 180 MB to spare. (80
    # are too few, and so were 120 once, beside other work.) The frames repeat, so that the file is quickly made.
    frames, side, limit = 2000, 160, 180 * 2**20
    hand_back_what_is_freed(monkeypatch)
    rng = np.random.default_rng(2)
    part = record(np.full((40, side, side), 3.0), EMCCD, rng)
    movie = zarr.open(
        str(tmp_path / "in.zarr"), mode="w", shape=(frames, side, side), chunks=(40, side, side), dtype="u2"
    )
    for start in range(0, frames, 40):
        movie[start : start + 40] = part
    out = zarr.open(str(tmp_path / "out.zarr"), mode="w", shape=movie.shape, chunks=(40, side, side), dtype="f4")

    def run(*more: str) -> subprocess.CompletedProcess[str]:
        code = [sys.executable, "-c", textwrap.dedent(UNDER_A_LIMIT)]
        paths = [str(tmp_path / "in.zarr"), str(tmp_path / "out.zarr"), str(limit)]
        return subprocess.run([*code, *paths, *more], capture_output=True, text=True, check=False, timeout=250)

    whole = run("all at once")
    assert whole.returncode != 0 and "MemoryError" in whole.stderr, "the limit must be one"
    done = run()
    assert done.returncode == 0, done.stderr[-2000:]
    assert out[-1].mean() == pytest.approx(3.0, abs=0.1)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="a process's anonymous memory is told by Linux")
def test_memory_does_not_grow_with_the_length_of_a_movie(tmp_path, monkeypatch):
    # 256 frames more are 75 MB as recorded and 151 MB as float32.
    hand_back_what_is_freed(monkeypatch)
    nm.preset("FF").to_json(tmp_path / "model.json")
    given, peaks = ["--model", str(tmp_path / "model.json")], {}
    for frames in (160, 416):
        movie = str(tmp_path / f"{frames}.zarr")
        size = ["--frames", str(frames), "--shape", "384", "384", "--n-molecules", "100"]
        peaks[frames] = [
            most_anonymous_gb(arguments)
            for arguments in (
                ["simulate", *given, *size, "--out", movie],
                ["denoise", movie, *given, "--out", str(tmp_path / f"d{frames}.zarr")],
                ["traces", movie, *given, "--out", str(tmp_path / f"t{frames}")],
            )
        ]
    grown = np.subtract(peaks[416], peaks[160])
    assert np.all(grown < 0.04), (grown, peaks)


@pytest.mark.parametrize("frames", [1, 3, 8, 31])
@pytest.mark.parametrize("method", ["pure-let-movie", "pure-let", "none"])
def test_the_size_of_pieces_changes_no_bit(frames, method, monkeypatch):
    movie = record(np.random.default_rng(4).gamma(2.0, 2.0, (70, 24, 20)), EMCCD, np.random.default_rng(5))
    whole = nm.denoise(movie, EMCCD, method=method)
    monkeypatch.setattr(reel, "PIECE_PIXELS", frames * 24 * 20)
    monkeypatch.setattr(reel, "HELD_PIXELS", 1)
    assert reel.piece_frames(movie.shape) == max(frames, 2)
    np.testing.assert_array_equal(nm.denoise(movie, EMCCD, method=method), whole)


def test_a_reel_holds_few_frames_of_a_long_movie(monkeypatch):
    monkeypatch.setattr(reel, "PIECE_PIXELS", 4)
    monkeypatch.setattr(reel, "HELD_PIXELS", 1)
    read = []

    def frames(first, last):
        read.append((first, last))
        return np.arange(first, last, dtype=np.float32)[:, None, None] + np.zeros((1, 1, 1), np.float32)

    film = reel.Reel(frames, (99, 1, 1), reach=24)
    assert [film[t][0, 0] for t in range(99)] == list(range(99))
    assert len(film._held) == 12 and read[0] == (0, 4) and read[-1] == (96, 99) and len(read) == 25
    assert film[96][0, 0] == 96 and len(read) == 25
    assert film[5][0, 0] == 5 and read[-1] == (4, 8)
