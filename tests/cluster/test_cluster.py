"""A cluster of separate processes gives what this one gives, to the last digit, also when one of them is killed."""

from __future__ import annotations

import contextlib
import json
import math
import operator
import os
import signal
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import napari_mufasa as nm
from napari_mufasa import cluster, files
from napari_mufasa.batch import Entry, Settings, run
from napari_mufasa.cli import main
from napari_mufasa.cluster import connection

distributed = pytest.importorskip("distributed")


def two_workers():
    """Two processes with one thread each."""
    return distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None)


def client_of(workers):
    return distributed.Client(workers.scheduler_address, set_as_default=False)


@pytest.fixture(scope="module")
def workers():
    with two_workers() as two:
        yield two


@pytest.fixture
def client(workers):
    with client_of(workers) as one:
        yield one


@pytest.fixture
def doomed():
    """A client of workers of its own: what is killed does not always come back, and no other test shall wait for it."""
    with two_workers() as two, client_of(two) as one:
        yield one
        with contextlib.suppress(TimeoutError):  # a cluster cannot be closed while a process of it is being started
            one.wait_for_workers(2, timeout=20)


def small(n_frames=60):
    return nm.preset("FF").with_values(
        {"acquisition.n_frames": n_frames, "acquisition.shape_px": (48, 48), "sample.n_molecules": 14}
    )


def a_worker(client):
    """The process of one worker."""
    return next(iter(client.run(os.getpid).values()))


def cli(capsys, *arguments):
    with pytest.raises(SystemExit) as leaving:
        main([str(a) for a in arguments])
    out, err = capsys.readouterr()
    return leaving.value.code, out, err


# jobs -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("elsewhere", [False, True])
def test_results_come_in_the_order_of_the_jobs_which_are_taken_as_they_are_needed(client, elsewhere):
    taken = []

    def jobs():
        for n in range(30):
            taken.append(n)
            yield n

    found = cluster.in_order(operator.neg, jobs(), client=client if elsewhere else None, workers=2, ahead=4)
    assert next(found) == 0 and len(taken) < 10
    assert list(found) == [-n for n in range(1, 30)]


def test_what_a_job_raises_is_raised(client):
    with pytest.raises(FileNotFoundError):  # not taken for a connection that failed
        list(cluster.in_order(os.listdir, ["/no such folder"], client=client))
    with pytest.raises(ValueError, match="factorial"):
        list(cluster.in_order(math.factorial, [-1], client=client))


def test_a_job_that_is_waited_for_can_be_cancelled_and_is_then_unwanted(client):
    begun = time.monotonic()
    with pytest.raises(nm.Cancelled):
        list(cluster.in_order(time.sleep, [60] * 4, client=client, cancel=lambda: time.monotonic() > begun + 1))
    assert not cluster.unwanted()  # this is no job


@pytest.mark.slow
def test_a_job_that_ends_every_worker_is_told(doomed):
    with pytest.raises(nm.MufasaError, match="ended 4 workers of the cluster"):
        list(cluster.in_order(os._exit, [1], client=doomed))


# the same digits --------------------------------------------------------------------------------------------
def test_a_simulation_is_the_same(client):
    model = small(800).with_effects(*(nm.catalogue()[kind]() for kind in ("stage_drift", "image_lag")))
    at = np.array([[10.0, 12.5], [30.25, 20.0], [40.0, 8.0]])
    here, there = (nm.simulate(model, at, seed=3, client=one) for one in (None, client))
    assert np.array_equal(here.movie, there.movie) and np.array_equal(here.optical, there.optical)


def test_denoised_movies_and_traces_are_the_same(client):
    model = small(100)
    movie = nm.simulate(model.with_effects(nm.catalogue()["stage_drift"](distance_px=3.0)), seed=2).movie
    for method in ("pure-let-movie", "source"):
        here, there = (nm.denoise(movie, model.camera, method=method, client=one) for one in (None, client))
        assert np.array_equal(here, there)
    for options in ({}, {"follow_drift": True}, {"follow_molecules": True}):
        here, there = (
            nm.extract_traces(movie, model.camera, psf_sigma_px=model.sigma_px, client=one, **options)
            for one in (None, client)
        )
        assert len(here.all_traces) > 3 and np.array_equal(here.all_traces, there.all_traces)
        pd.testing.assert_frame_equal(here.molecules, there.molecules, check_exact=True)


def test_many_blocks_of_a_movie_are_the_same(client, monkeypatch):
    from napari_mufasa.camera import frames

    model = small(100)
    movie = nm.simulate(model, seed=2).movie
    monkeypatch.setattr(frames, "BLOCK_BYTES", 4 * 48 * 48 * 16)
    for follow in (False, True):
        here, there = (
            nm.extract_traces(
                movie, model.camera, psf_sigma_px=model.sigma_px, follow_molecules=follow, client=one,
            )
            for one in (None, client)
        )  # fmt: skip
        assert np.array_equal(here.all_traces, there.all_traces)
        pd.testing.assert_frame_equal(here.molecules, there.molecules, check_exact=True)


def diagnosed(movie, model, dark, client, progress=None):
    report = nm.diagnose(
        movie, model, dark, effects=["stage_drift", "laser_drift"], budget=60, client=client, progress=progress
    )
    told = report.to_dict()
    told.pop("seconds")
    return json.dumps(told)


@pytest.mark.slow
def test_a_worker_killed_in_a_diagnosis_changes_no_digit(doomed):
    model = small()
    movie = nm.simulate(model.with_effects(nm.catalogue()["stage_drift"](distance_px=2.0)), seed=1).movie
    dark = nm.simulate_dark(model, 20, 1)
    victim, done = a_worker(doomed), []

    def kill_in_the_middle(n, _all):
        done.append(n)
        if len(done) == 12:
            os.kill(victim, signal.SIGKILL)

    there = diagnosed(movie, model, dark, doomed, kill_in_the_middle)
    assert len(done) > 30 and victim not in doomed.run(os.getpid).values()
    assert there == diagnosed(movie, model, dark, None)


def test_traces_alone_are_diagnosed_there_too(client):
    """What is sent for tables: fields and eyes."""
    from napari_mufasa.discover.trace_bench import TraceBench

    model = small()
    table = np.random.default_rng(1).poisson(80, (80, 60)).astype(float)
    here, there = (TraceBench(table, model, client=one) for one in (None, client))
    jobs = [(model, k) for k in range(3)]
    assert np.array_equal(here.rows(jobs), there.rows(jobs), equal_nan=True)


# batches ----------------------------------------------------------------------------------------------------
@pytest.fixture
def movies(tmp_path):
    small().to_json(tmp_path / "model.json")
    entries = []
    for seed in range(4):
        path = tmp_path / f"m{seed}.tif"
        movie = nm.simulate(small(), seed=seed).movie
        files.write_movie(path, [movie], movie.shape, np.uint16)
        entries.append(Entry(path, f"m{seed}", model=tmp_path / "model.json"))
    return entries


def written(folder: Path) -> dict[str, bytes]:
    """What is in each file; of a movie its pixels: every denoised one has a UUID of its own."""
    found = {
        str(path.relative_to(folder)): files.load(path).tobytes() if path.suffix == ".tif" else path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }
    assert not [name for name in found if Path(name).name.startswith(".")]
    return found


@pytest.mark.slow
def test_a_worker_killed_in_a_batch_loses_nothing(doomed, movies, tmp_path):
    settings, victim = Settings(steps=("denoise", "traces")), a_worker(doomed)
    here = list(run(movies, tmp_path / "here", settings))

    def kill_in_the_middle(done, _all):
        if done == 1:
            os.kill(victim, signal.SIGKILL)

    there = list(run(movies, tmp_path / "there", settings, client=doomed, progress=kill_in_the_middle))
    assert [r.told for r in there] == [r.told for r in here] and [r.entry for r in there] == movies
    assert not any(r.error for r in there)
    one, other = written(tmp_path / "here"), written(tmp_path / "there")
    assert set(one) == set(other) and len(one) >= 20
    assert [name for name in one if one[name] != other[name]] == []


def test_a_movie_that_cannot_be_done_there_is_told(client, movies, tmp_path):
    movies[1].movie.write_bytes(b"no movie")
    found = list(run(movies[:2], tmp_path / "out", Settings(steps=("traces",)), client=client))
    assert not found[0].error and "m1.tif" in found[1].error


# the command line and bad input -----------------------------------------------------------------------------
def test_a_verb_writes_the_same_file(workers, capsys, tmp_path):
    small().to_json(tmp_path / "model.json")
    for folder, more in (("here", ()), ("there", ("--scheduler", workers.scheduler_address))):
        (tmp_path / folder).mkdir()
        out = tmp_path / folder / "movie.ome.tif"
        code, _, err = cli(capsys, "simulate", "--model", tmp_path / "model.json", "--out", out, "--seed", 5, *more)
        assert (code, err) == (0, "")
    assert (tmp_path / "here/movie.ome.tif").read_bytes() == (tmp_path / "there/movie.ome.tif").read_bytes()


@pytest.mark.parametrize("address", ["nonsense", "tcp://127.0.0.1:9"])
def test_a_scheduler_that_does_not_answer_is_told_in_one_line(capsys, tmp_path, monkeypatch, address):
    monkeypatch.setattr(connection, "PATIENCE_S", 0.5)
    out = tmp_path / "movie.tif"
    code, _, err = cli(capsys, "simulate", "--preset", "FF", "--out", out, "--scheduler", address)
    assert code == 2 and err.count("\n") == 1 and f"no scheduler answers at {address}: start one" in err
    assert not list(tmp_path.iterdir())


def test_a_cluster_without_workers_is_told(monkeypatch):
    monkeypatch.setattr(connection, "PATIENCE_S", 0.5)
    with (
        distributed.LocalCluster(n_workers=0, processes=True, dashboard_address=None) as none,
        pytest.raises(nm.MufasaError, match="has no workers: start some with 'dask worker"),
        cluster.connected(none.scheduler_address),
    ):
        raise AssertionError("not reached")


def test_bad_input_is_told(client):
    with pytest.raises(nm.MufasaError, match="client is a str"):
        nm.simulate(small(), client="tcp://127.0.0.1:8786")
    with pytest.raises(nm.MufasaError, match="cannot be sent there"):
        list(cluster.in_order(lambda n: n, [1], client=client))
    with client.as_current(), pytest.raises(nm.MufasaError, match="set_as_default=False"):
        cluster.check(client)
    with (
        distributed.Client(client.scheduler.address) as default,
        pytest.raises(nm.MufasaError, match="set_as_default=False"),
    ):
        nm.simulate(small(), client=default)
    client.close()
    with pytest.raises(nm.MufasaError, match="client is closed"):
        nm.denoise(np.full((30, 32, 32), 400, np.uint16), small().camera, method="none", client=client)


def test_a_scheduler_that_is_gone_is_told():
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as gone:
        client = distributed.Client(gone.scheduler_address, set_as_default=False, timeout=2)
        found = cluster.in_order(time.sleep, [0, 60], client=client)
        next(found)
        gone.close()
        with pytest.raises(nm.MufasaError, match="the scheduler of the cluster is gone"):
            next(found)
        client.close()


def test_workers_that_differ_are_told(client, monkeypatch):
    monkeypatch.setattr(connection, "version", lambda: "99")
    with pytest.raises(nm.MufasaError, match="not 99: install the same version"):
        cluster.check(client)
