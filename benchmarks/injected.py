"""Known disturbances put into a real movie, one at a time: is each among the names?

    python -m benchmarks.injected                      prints what docs/real_movies.md shows
    python -m benchmarks.injected --model MODEL.json   from a model completed before, which saves its minutes
    python -m benchmarks.injected --only row_noise,none --write
    python -m benchmarks.injected --only baseline_drift --size 0.25   a quarter as large
    python -m benchmarks.injected --only image_lag --budget 1500      with more simulations

The movie is diagnosed as it is. The completed model is then believed, and the disturbed movie diagnosed from there,
with a budget of its own; the row "nothing" is the movie as it is once more. Disturbances are made of the counts
themselves, by no code of the package; sizes are in the temporal noise of a pixel.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import napari_mufasa as nm
from benchmarks.pages import header, row, write
from benchmarks.real_movies import INJECTED, MODELS, NAMES, TITLES
from benchmarks.scenes import REAL_DATA as DATA
from napari_mufasa import files
from napari_mufasa.cli.console import working

BUDGET = 900
SEED = 1

Counts = NDArray[np.float64]
Rng = np.random.Generator


def row_noise(counts: Counts, noise: float, rng: Rng) -> Counts:
    return counts + 0.3 * noise * rng.standard_normal((*counts.shape[:2], 1))


def image_lag(counts: Counts, noise: float, rng: Rng) -> Counts:
    lagged = counts.copy()
    lagged[1:] += 0.05 * (counts[:-1] - counts[1:])
    return lagged


def column_offset(counts: Counts, noise: float, rng: Rng) -> Counts:
    return counts + 0.3 * noise * rng.standard_normal(counts.shape[2])


def hot_pixels(counts: Counts, noise: float, rng: Rng) -> Counts:
    hot = rng.random(counts.shape[1:]) < 0.003
    return counts + 4 * noise * hot * rng.exponential(1.0, hot.shape)


def cosmic_rays(counts: Counts, noise: float, rng: Rng) -> Counts:
    struck = counts.copy()
    hits = rng.poisson(counts.size / 2e5)
    where = tuple(rng.integers(0, n, hits) for n in counts.shape)
    np.add.at(struck, where, noise * (10 + rng.exponential(30, hits)))
    return struck


def baseline_drift(counts: Counts, noise: float, rng: Rng) -> Counts:
    return counts + noise * np.linspace(0, 1, len(counts))[:, None, None]


def stage_drift(counts: Counts, noise: float, rng: Rng) -> Counts:
    """Four pixels along y, one at a time: no pixel is interpolated, so that noise stays as it is."""
    moved = np.linspace(0, 4.999, len(counts)).astype(int)
    height = counts.shape[1] - 4
    return np.stack([frame[at : at + height] for frame, at in zip(counts, moved, strict=True)])


def pixel_gain_variation(counts: Counts, noise: float, rng: Rng) -> Counts:
    offset = np.quantile(counts, 0.001)
    return offset + (counts - offset) * (1 + 0.06 * rng.standard_normal(counts.shape[1:]))


DISTURBANCES: tuple[Callable[[Counts, float, Rng], Counts], ...] = (
    row_noise, image_lag, column_offset, hot_pixels, cosmic_rays, baseline_drift, stage_drift, pixel_gain_variation,
)  # fmt: skip


def disturbed(
    movie: NDArray[Any], disturb: Callable[[Counts, float, Rng], Counts] | None, size: float = 1.0
) -> NDArray[np.uint16]:
    """The movie (frame, y, x) with a disturbance in it, of `size` times a pixel's noise; None: as it is."""
    if disturb is None:
        return np.asarray(movie, np.uint16)
    counts = movie.astype(float)
    noise = float(np.median(np.diff(counts, axis=0).std(axis=0)) / np.sqrt(2))
    changed = disturb(counts, size * noise, np.random.default_rng(SEED))
    return np.clip(np.rint(changed), 0, 65535).astype(np.uint16)


def main() -> None:
    names = {f.__name__: f for f in DISTURBANCES}
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", type=Path, help="model.json of the movie as it is, completed by a diagnosis")
    parser.add_argument("--only", default="none," + ",".join(names), help="some of: none, " + ", ".join(names))
    parser.add_argument(
        "--size", type=float, default=1.0, help="of disturbances that are told in a pixel's noise, over the usual"
    )
    parser.add_argument("--budget", type=int, default=BUDGET, help="simulations of each diagnosis")
    parser.add_argument("--write", action="store_true", help="store in docs/real_movies.md")
    given = parser.parse_args()
    movie = np.asarray(files.load(DATA / NAMES[0]))
    if given.model is not None:
        completed = nm.Model.from_json(given.model)
    else:
        with working("diagnosing the movie as it is") as work:
            believed = nm.Model.from_json(MODELS / "smfret_ixon.json")
            completed = nm.diagnose(movie, believed, seed=SEED, **work.both()).model
    rows, found, tried = [], 0, 0
    for name in given.only.split(","):
        with working(f"diagnosing {name}") as work:
            report = nm.diagnose(
                disturbed(movie, names.get(name), given.size), completed, seed=SEED, budget=given.budget, **work.both()
            )
        named = name in report.chosen
        found, tried = found + named, tried + (name in names)
        before, after, floor = (report.error[key] for key in ("before", "after", "floor"))
        said = ("yes" if named else "no") if name in names else ""
        rows.append(row(name if name in names else "nothing", said, ", ".join(report.chosen), before, after, floor))
        print(rows[-1], flush=True)
    section = "\n".join(
        [
            f"### {INJECTED}",
            "",
            f"Put into {NAMES[0]}, one at a time; diagnosed from its completed model: {found} of {tried} are named.",
            "",
            *header("put in", "named", "all names", "error before", "after", "floor"),
            *rows,
            "",
        ]
    )
    print(section)
    if given.write:
        write("real_movies.md", INJECTED, section, TITLES)


if __name__ == "__main__":
    main()
