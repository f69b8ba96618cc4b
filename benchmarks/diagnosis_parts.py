"""What one simulation of a diagnosis costs, part by part: of 96 × 96 × 300, as `benchmarks.diagnosis` has it.

    python -m benchmarks.diagnosis_parts                    shares, and each part over one float32 normal per pixel
    python -m benchmarks.diagnosis_parts --against FOLDER   this code over that of another clone, part by part
    python -m benchmarks.diagnosis_parts --same FOLDER      whether both see the same in simulations of every effect

Processor time of one core, the least of three runs, in rounds; the two codes take turns, a process each. Run it with
nothing else at work.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from tests.blind.generator import base_model, make

import napari_mufasa as nm
from benchmarks.pages import header, row
from napari_mufasa.discover.measurement import prepare
from napari_mufasa.discover.movie_bench import MovieBench
from napari_mufasa.effects import catalogue
from napari_mufasa.observe import observe, photoelectrons_per_adu, view_dark
from napari_mufasa.observe.pixels import pixel_statistics
from napari_mufasa.simulate.movie import simulate, simulate_dark
from napari_mufasa.spots.follow import find_and_follow
from napari_mufasa.traces.dynamics import dynamics

ROOT = Path(__file__).resolve().parents[1]
ROUNDS = 12
WHOLE, LIMIT = "one simulation, observed", "limit: one float32 normal per pixel"


def bench_of(base: str, seed: int = 1, n_molecules: int = 50) -> MovieBench:
    """The bench of a movie of the independent generator that lacks nothing."""
    believed = base_model(base)
    recorded = make(believed, seed=seed, n_molecules=n_molecules)
    return MovieBench(prepare(recorded.movie, nm.Model.from_dict(believed), recorded.dark), seed)


def least(run: Callable[[], object], repeats: int = 3) -> float:
    times = []
    for _ in range(repeats):
        begun = time.process_time()
        run()
        times.append(time.process_time() - begun)
    return min(times)


class Parts:
    """What a simulation is made of, ready to be timed."""

    def __init__(self, seed: int = 1) -> None:
        bench = bench_of("emccd")
        model, eyes, shown = bench.matched(bench.start), bench.start, bench.measurement.dark
        assert shown is not None
        camera, scale, sigma = eyes.camera, photoelectrons_per_adu(eyes), eyes.sigma_px
        movie, dark = simulate(model, seed=seed).movie, simulate_dark(model, len(shown), seed)
        view, label = view_dark(dark, eyes), np.ones(movie.shape[1:], np.int8)
        light = find_and_follow(movie, camera, scale, sigma).light
        rng = np.random.default_rng(0)
        self.runs: dict[str, Callable[[], object]] = {
            WHOLE: lambda: bench.simulated((model, seed)),  # the least of several: dark frames seen before
            "simulate": lambda: simulate(model, seed=seed),
            "observe": lambda: observe(movie, eyes, view),
            "find and follow": lambda: find_and_follow(movie, camera, scale, sigma),
            "on and off": lambda: dynamics(light),
            "pixels": lambda: pixel_statistics(movie, camera.baseline_adu, label, 2),
            "dark frames, simulated": lambda: simulate_dark(model, len(shown), seed),
            "dark frames, observed": lambda: view_dark(dark, eyes),
            LIMIT: lambda: rng.standard_normal(movie.shape, dtype=np.float32),
        }
        for run in self.runs.values():
            run()

    def seconds(self, name: str) -> float:
        return least(self.runs[name])


def seen() -> Iterator[tuple[str, np.ndarray[Any, Any]]]:
    """Observables of simulations: of every camera, and of every effect on one of them."""
    for base in ("emccd", "cmos", "ccd", "emccd_short"):
        bench = bench_of(base)
        for seed in (1, 2):
            yield f"{base}, seed {seed}", bench.simulated((bench.start, seed)).values
        for kind, effect in catalogue().items():
            if base == "emccd":
                yield kind, bench.simulated((bench.start.with_effects(effect()), 3)).values


def serve() -> None:
    """Answer each line that comes in with a line: the side of `--against` and `--same` that runs a given code."""
    parts: Parts | None = None
    for line in sys.stdin:
        if (asked := line.strip()) == "seen":
            print(json.dumps({name: values.tolist() for name, values in seen()}), flush=True)
            continue
        parts = parts or Parts()
        print(json.dumps(parts.seconds(asked) if asked else list(parts.runs)), flush=True)


class Code:
    """A process that runs the code of a folder."""

    def __init__(self, folder: Path) -> None:
        command = [sys.executable, "-m", "benchmarks.diagnosis_parts", "--serve"]
        paths = {"PYTHONPATH": str(folder / "src")}
        self.process = subprocess.Popen(
            command, cwd=ROOT, env=os.environ | paths, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def ask(self, what: str) -> Any:
        assert self.process.stdin is not None and self.process.stdout is not None
        self.process.stdin.write(what + "\n")
        self.process.stdin.flush()
        return json.loads(self.process.stdout.readline())


def shares(rounds: int) -> Iterator[str]:
    parts = Parts()
    found = {name: min(parts.seconds(name) for _ in range(rounds)) for name in parts.runs}
    yield from header("part", "share of one simulation, observed", "over one float32 normal per pixel")
    for name, seconds in found.items():
        yield row(name, seconds / found[WHOLE], seconds / found[LIMIT])


def against(folder: Path, rounds: int) -> Iterator[str]:
    ours, theirs = Code(ROOT), Code(folder)
    names = [name for name, _ in zip(ours.ask(""), theirs.ask(""), strict=True)]
    yield from header("part", "this code / the other, median", "half of the pairs lie within")
    for name in names:
        ratios = [ours.ask(name) / theirs.ask(name) for _ in range(rounds)]
        low, middle, high = np.quantile(ratios, [0.25, 0.5, 0.75])
        yield row(name, float(middle), f"{low:.2f} … {high:.2f}")


def same(folder: Path) -> Iterator[str]:
    ours, theirs = (Code(place).ask("seen") for place in (ROOT, folder))
    yield from header("simulation", "observables that are not the same to the last bit", "largest relative difference")
    for name in ours:
        a, b = np.array(ours[name]), np.array(theirs[name])
        other = ~((a == b) | (np.isnan(a) & np.isnan(b)))
        relative = np.abs(a - b)[other] / np.maximum(np.maximum(np.abs(a), np.abs(b))[other], 1e-3)
        yield row(name, f"{other.sum()} of {a.size}", f"{relative.max(initial=0.0):.1e}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--against", type=Path, metavar="FOLDER", help="another clone, whose src is run in turns")
    parser.add_argument("--same", type=Path, metavar="FOLDER", help="another clone, whose src sees the same or not")
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve:
        serve()
        return
    lines = shares(options.rounds)
    if options.same is not None:
        lines = same(options.same)
    elif options.against is not None:
        lines = against(options.against, options.rounds)
    for line in lines:
        print(line, flush=True)


if __name__ == "__main__":
    main()
