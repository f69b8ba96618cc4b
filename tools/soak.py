"""200 rounds of simulate → denoise → extract → diagnose in one process: memory stays flat, no thread is left.

    python tools/soak.py [--rounds 200]

Resident memory is read after each round, as it is and after the C library has handed back what it keeps of freed
memory (malloc_trim; where pieces lie differs from run to run). Its growth is that of the median of the last tenth of
the rounds over the median of a tenth after the warm-up (the first fifth: compiled kernels, caches of fixed size); the
second decides. The outcome goes to benchmarks/results/soak.md.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import gc
import re
import sys
import threading
import time
from pathlib import Path

import numpy as np

import napari_mufasa as nm

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "soak.md"
WARM_UP, MOST_GROWTH = 0.2, 0.02
EFFECTS = ["laser_drift"]
PLACES = np.array([[7.2, 8.1], [8.4, 23.3], [16.0, 15.6], [23.1, 7.7], [24.2, 24.4]])


def status(key: str) -> int:
    """A number of /proc/self/status: VmRSS in kB, Threads."""
    found = re.search(rf"^{key}:\s*(\d+)", Path("/proc/self/status").read_text(), re.MULTILINE)
    return int(found[1]) if found else 0


def trimmed() -> int:
    """Resident memory in kB once freed memory is handed back; without glibc, as it is."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").malloc_trim(0)
    return status("VmRSS")


def growth(kb: list[int]) -> tuple[float, float]:
    """MB after the warm-up and at the end."""
    part, first = max(len(kb) // 10, 1), int(WARM_UP * len(kb))
    return float(np.median(kb[first : first + part])) / 1024, float(np.median(kb[-part:])) / 1024


def model() -> nm.Model:
    """The smallest movie that a diagnosis takes, bright enough for it."""
    return nm.preset("FF").with_values(
        {
            "acquisition.n_frames": 24,
            "acquisition.shape_px": (32, 32),
            "sample.n_molecules": len(PLACES),
            "excitation.power_density_w_per_cm2": 100,
            "fluorophore.cycles_before_bleaching": None,
            "camera.em_gain": 300,
            "camera.electrons_per_adu": 12,
        }
    )


def once(believed: nm.Model, seed: int) -> str:
    """A round; in every tenth of them an effect is there to be found."""
    drifting = believed.with_effects(nm.catalogue()["laser_drift"](change=-0.4))
    truth = drifting if seed % 10 == 0 else believed
    movie = nm.simulate(truth, PLACES, seed=seed).movie
    dark = nm.simulate_dark(truth, 20, seed=seed)
    photons = nm.denoise(movie, believed.camera)
    traces = nm.extract_traces(movie, believed.camera, dark, psf_sigma_px=believed.sigma_px)
    report = nm.diagnose(movie, believed, dark, seed=seed, effects=EFFECTS, max_effects=1)
    assert np.isfinite(photons).all() and len(traces.molecules)
    return report.verdict


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=200)
    rounds = parser.parse_args().rounds
    believed, begun = model(), time.monotonic()
    raw_kb: list[int] = []
    memory_kb: list[int] = []
    threads, python_threads = [], []
    for number in range(rounds):
        told = once(believed, 1 + number)
        gc.collect()
        raw_kb.append(status("VmRSS"))
        memory_kb.append(trimmed())
        threads.append(status("Threads"))
        python_threads.append(threading.active_count())
        if number % 10 == 0 or number == rounds - 1:
            spent = time.monotonic() - begun
            memory = f"{raw_kb[-1] / 1024:.1f} MB, {memory_kb[-1] / 1024:.1f} MB trimmed"
            print(f"{number + 1}: {memory}, {threads[-1]} threads, {spent:.0f} s, {told}", flush=True)
    first, spent = int(WARM_UP * rounds), time.monotonic() - begun
    grown_threads = threads[-1] - threads[first], python_threads[-1] - python_threads[first]
    lines = []
    for what, kb in (("resident memory", raw_kb), ("resident memory, freed memory handed back", memory_kb)):
        warm, end = growth(kb)
        lines.append(f"| {what} | {warm:.1f} MB | {end:.1f} MB | {100 * (end / warm - 1):+.2f} % |")
    lines.append(f"| threads of the process | {threads[first]} | {threads[-1]} | {grown_threads[0]:+d} |")
    lines.append(f"| threads of Python | {python_threads[first]} | {python_threads[-1]} | {grown_threads[1]:+d} |")
    print("\n".join(lines))
    if rounds >= 200:
        RESULTS.parent.mkdir(parents=True, exist_ok=True)
        RESULTS.write_text(
            f"# Soak\n\n`make soak`: {rounds} rounds of simulate, denoise, extract and diagnose in one process, "
            f"{spent / rounds:.1f} s each.\n\n"
            "| | after warm-up | at the end | growth |\n|---|---|---|---|\n" + "\n".join(lines) + "\n"
        )
    warm, end = growth(memory_kb)
    return int(end / warm - 1 >= MOST_GROWTH or max(grown_threads) > 0)


if __name__ == "__main__":
    sys.exit(main())
