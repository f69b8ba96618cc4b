"""What a second worker of a cluster gains: a diagnosis and a batch on one and on two local processes, as a ratio.

    python -m benchmarks.cluster [--only diagnosis|batch] [--kill] [--side N] [--frames N] [--movies N]
        [--repetitions N]

Each worker has one thread and keeps its memory (`MEMORY`, as docs/clusters.md has it), and has done a piece of the work
before the clock runs, so that loops are compiled; the time is the least of some repetitions. The answers of one and two
workers are compared digit by digit; with --kill a third run loses one of its workers in the middle. Run it with nothing
else at work: other programs take the second core away. Exit 1 when a digit differs.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from distributed import Client, LocalCluster

import napari_mufasa as nm
from napari_mufasa import files
from napari_mufasa.batch import Entry, Settings, run

Work = Callable[[Client, Callable[[int, int], None] | None], str]
#: The library tells its workers to give memory back at once, and simulations ask for it again and again.
MEMORY = {"MALLOC_TRIM_THRESHOLD_": "67108864", "MALLOC_MMAP_THRESHOLD_": "33554432"}
EFFECTS = ["stage_drift", "laser_drift", "triplet_blinking"]


def movie_model(options: argparse.Namespace) -> nm.Model:
    side = options.side
    values = {"acquisition.n_frames": options.frames, "acquisition.shape_px": (side, side)}
    return nm.preset("FF").with_values(values | {"sample.n_molecules": max(10, round(50 * (side / 96) ** 2))})


def diagnosis(options: argparse.Namespace) -> Work:
    model = movie_model(options)
    movie = nm.simulate(model.with_effects(nm.catalogue()["stage_drift"](distance_px=1.0)), seed=1).movie
    dark = nm.simulate_dark(model, 50, 1)

    def work(client: Client, progress: Any) -> str:
        told = nm.diagnose(movie, model, dark, effects=EFFECTS, budget=300, client=client, progress=progress).to_dict()
        told.pop("seconds")
        return json.dumps(told)

    return work


def batch(options: argparse.Namespace, home: Path) -> Work:
    model = movie_model(options)
    model.to_json(home / "model.json")
    entries = []
    for seed in range(options.movies):
        path = home / f"movie{seed}.tif"
        movie = nm.simulate(model, seed=seed).movie
        files.write_movie(path, [movie], movie.shape, np.uint16)
        entries.append(Entry(path, path.stem, model=home / "model.json"))

    def work(client: Client, progress: Any) -> str:
        settings = Settings(steps=("denoise", "compare"))
        with tempfile.TemporaryDirectory(dir=home) as out:
            return json.dumps([r.told for r in run(entries, Path(out), settings, client=client, progress=progress)])

    return work


def done(work: Work, workers: int, repetitions: int = 1, *, kill: bool = False) -> tuple[str, float]:
    """The answer and the least of the seconds it took, of workers that have done it before."""
    with (
        LocalCluster(
            n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=None, env=MEMORY
        ) as cluster,
        Client(cluster.scheduler_address, set_as_default=False) as client,
    ):
        work(client, None)
        victims = list(client.run(os.getpid).values())[:1] if kill else []

        def progress(count: int, _all: int) -> None:
            if victims and count >= 2:
                os.kill(victims.pop(), signal.SIGKILL)

        times = []
        for _ in range(repetitions):
            begun = time.perf_counter()
            answer = work(client, progress)
            times.append(time.perf_counter() - begun)
        return answer, min(times)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=("diagnosis", "batch"))
    parser.add_argument("--kill", action="store_true", help="also kill one of two workers in the middle")
    parser.add_argument("--side", type=int, default=96)
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--movies", type=int, default=8)
    parser.add_argument("--repetitions", type=int, default=3)
    options = parser.parse_args()
    same = True
    print("| work | two workers over one | same digits | load of the machine |\n|---|---|---|---|")
    with tempfile.TemporaryDirectory() as home:
        works = {"diagnosis": lambda: diagnosis(options), "batch": lambda: batch(options, Path(home))}
        for name, made in works.items():
            if options.only not in (None, name):
                continue
            work = made()
            (one, alone), (two, together) = (done(work, workers, options.repetitions) for workers in (1, 2))
            same &= one == two
            print(f"| {name} | {alone / together:.2f} × | {one == two} | {os.getloadavg()[0]:.1f} |", flush=True)
            if options.kill:
                killed, _ = done(work, 2, kill=True)
                same &= killed == one
                print(f"| {name}, one of two killed | – | {killed == one} | {os.getloadavg()[0]:.1f} |", flush=True)
    return 0 if same else 1


if __name__ == "__main__":
    raise SystemExit(main())
