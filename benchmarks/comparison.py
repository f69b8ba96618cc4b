"""W1 of a real movie against a model, its baselines and its fit, seed by seed.

    python -m benchmarks.comparison [--write]

Prints a table in Markdown; ``--write`` puts it into docs/comparison.md between its two marks.
"""

from __future__ import annotations

import argparse
from typing import Any

import napari_mufasa as nm
from benchmarks.pages import DOCS, header, row, write
from benchmarks.scenes import REAL_DATA
from napari_mufasa import files
from napari_mufasa.compare import compare_movie

MOVIE = "smfret_ixon_emccd.tif"
NAMES = ("mufasa", "poisson", "sofi", "fitted", "floor")


def table(movie: Any, model: nm.Model) -> list[str]:
    """Photoelectrons per frame; the fitted values of each seed."""
    out = header("molecules", "seed", *NAMES[:3], "fitted (95 %)", "floor (95 %)", "values of the fit")
    for rules, seeds in (({"max_steps": 1}, (0, 1, 2, 3)), ({}, (0,))):
        for seed in seeds:
            told = compare_movie(movie, model, seed=seed, **rules).report()
            w1 = told["w1"]
            fitted, floor = (
                f"{w1[name]:.1f} ({low:.1f} – {high:.1f})"
                for name, (low, high) in (
                    ("fitted", told["w1_interval_95"]["fitted"]),
                    ("floor", told["floor_range_95"]),
                )
            )
            values = ", ".join(f"{name.split('.')[-1]} {value:.3g}" for name, value in told["fitted"].items())
            count = f"{told['molecules']['measured']}{', one step at most' if rules else ''}"
            out.append(row(count, seed, *(f"{w1[name]:.1f}" for name in NAMES[:3]), fitted, floor, values))
            print(out[-1], flush=True)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="put the table into docs/comparison.md")
    options = parser.parse_args()
    model = nm.Model.from_json(DOCS / "models" / "smfret_ixon.json")
    section = "\n".join([f"### {MOVIE}", "", *table(files.load(REAL_DATA / MOVIE), model), ""])
    print(section)
    if options.write:
        write("comparison.md", MOVIE, section, [MOVIE])


if __name__ == "__main__":
    main()
