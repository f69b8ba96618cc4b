"""What a diagnosis costs a user: `napari-mufasa diagnose` on movies of the independent generator, against its limits.

    python -m benchmarks.diagnosis [--seed N] [--only WORD]

Each movie is recorded by a process of its own (`tests.blind.generator`), and diagnosed from its files by another, whose
time by the clock and largest memory are divided by what is allowed. Run it with nothing else at work. Exit 1 when one
is above its limit or does not name what was hidden.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.blind.bases import base_model
from tests.blind.generator import suitable_base

LIMIT_GB = 3.0
ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Case:
    """One hidden effect at strength 0.5 in a movie of `frames` × `side` × `side`."""

    effect: str
    side: int
    frames: int
    limit_s: float

    @property
    def molecules(self) -> int:
        """As dense in large movies as in small ones, 50 in 96 × 96 pixels."""
        return round(50 * (self.side / 96) ** 2)

    @property
    def name(self) -> str:
        return f"{self.effect}, {self.side} × {self.side} × {self.frames}"


SMALL, LARGE = (96, 300, 60.0), (512, 1000, 300.0)
CASES = (
    *(Case(kind, *SMALL) for kind in ("triplet_blinking", "stage_drift", "row_noise", "background_gradient")),
    *(Case(kind, *LARGE) for kind in ("long_dark_state", "laser_drift")),
)


def record(case: Case, seed: int, folder: Path) -> None:
    """movie.tif, dark.tif and model.json in `folder`; the truth stays beside it."""
    believed = base_model(suitable_base(case.effect))
    believed["acquisition"] |= {"shape_px": [case.side, case.side], "n_frames": case.frames}
    model = folder.with_suffix(".json")
    model.write_text(json.dumps(believed))
    command = [sys.executable, "-m", "tests.blind.generator", "--effect", case.effect, "--model", str(model)]
    command += ["--seed", str(seed), "--n-molecules", str(case.molecules), "--out", str(folder)]
    subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)


def diagnosed(folder: Path) -> tuple[dict[str, Any], float, float]:
    """report.json, seconds by the clock, and the most memory in GB."""
    files = {"--model": "model.json", "--dark": "dark.tif", "--out": "report"}
    given = [word for option, name in files.items() for word in (option, str(folder / name))]
    command = [str(Path(sys.executable).with_name("napari-mufasa")), "diagnose", str(folder / "movie.tif"), *given]
    start = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    took = time.perf_counter() - start
    if status:
        raise SystemExit(f"diagnose failed on {folder}")
    return json.loads((folder / "report" / "report.json").read_text()), took, used.ru_maxrss * 1024 / 1e9


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1, help="of the first movie; each next one has the next")
    parser.add_argument("--only", default="", help="cases whose name holds this word")
    options = parser.parse_args()
    print("| hidden, movie | named | error / floor | time / limit | memory / limit |\n|---|---|---|---|---|")
    good = True
    for seed, case in enumerate(CASES, options.seed):
        if options.only not in case.name:
            continue
        with tempfile.TemporaryDirectory() as home:
            folder = Path(home) / "movie"
            record(case, seed, folder)
            report, took, memory = diagnosed(folder)
        chosen, error = report["chosen"], report["error"]
        print(
            f"| {case.name} | {' + '.join(chosen) or report['verdict']} | {error['after'] / error['floor']:.2f} "
            f"| {took / case.limit_s:.2f} of {case.limit_s:.0f} s | {memory / LIMIT_GB:.2f} of {LIMIT_GB:.0f} GB |",
            flush=True,
        )
        good &= chosen == [case.effect] and took <= case.limit_s and memory <= LIMIT_GB
    return 0 if good else 1


if __name__ == "__main__":
    raise SystemExit(main())
