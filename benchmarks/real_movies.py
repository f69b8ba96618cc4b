"""Real movies through `diagnose`, from models without triplet states or heterogeneity: as they come out.

    python -m benchmarks.real_movies            prints what docs/real_movies.md shows
    python -m benchmarks.real_movies --write    and puts each movie's section there, its errors into results/
    python -m benchmarks.real_movies --seed 2   by other simulations: what hangs on their chance

    python -m benchmarks.real_movies --only smfret --model build/real_movies/smfret_ixon_emccd/model.json --add KIND
        fits the effects of a completed model anew beside one more, and prints what comes of it

The figures of each report go to build/real_movies.

W1 is that of extracted traces (photoelectrons per frame) against the model believed and the completed one, over the
floor: W1 between halves of the measured molecules.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import napari_mufasa as nm
from benchmarks.pages import write
from benchmarks.scenes import REAL_DATA as DATA
from napari_mufasa import files
from napari_mufasa.cli.console import working
from napari_mufasa.compare import compare_movie
from napari_mufasa.discover.bench import WORKERS
from napari_mufasa.discover.measurement import cropped, prepare
from napari_mufasa.report import html as html_report
from napari_mufasa.report.words import chosen_candidates, effect_title, parameter_lines, verdict_text
from napari_mufasa.traces import extract_traces

ROOT = Path(__file__).parents[1]
MODELS = ROOT / "docs" / "models"
ERRORS = ROOT / "benchmarks" / "results" / "real_movies.json"  # what docs/gallery/real.py draws
NAMES = ("smfret_ixon_emccd.tif", "polymerase_ixon888_emccd.tif", "yeast_slimfield_emccd.tif")
INJECTED = "Known disturbances"  # what benchmarks/injected.py adds to the page
TITLES = (*NAMES, INJECTED)
SIMULATED = 3  # movies of a completed model, in which molecules are counted


def movies() -> Iterator[tuple[str, Any, nm.Model, Any, dict[str, Any]]]:
    """Name, movie, believed model, dark frames, and how traces are chosen."""
    smfret = nm.Model.from_json(MODELS / "smfret_ixon.json")
    yield NAMES[0], files.load(DATA / NAMES[0]), smfret, None, {"max_steps": 1}
    polymerase = nm.Model.from_json(MODELS / "polymerase_ixon888.json")
    dark = files.load(DATA / "polymerase_ixon888_dark.tif")
    yield NAMES[1], files.load(DATA / NAMES[1]), polymerase, dark, {}
    yeast = nm.Model.from_json(MODELS / "yeast_slimfield.json")
    yeast = yeast.with_values({"fluorophore.cycles_before_bleaching": None})
    counts = files.load(DATA / NAMES[2])
    yield NAMES[2], counts[27:], yeast, counts[:27], {}


def told(name: str, report: nm.Report, distances: list[str], size: str) -> str:
    """One movie's section, as Markdown."""
    line, fall = verdict_text(report)
    used = report.simulations
    cores = f"{WORKERS} core{'s' * (WORKERS > 1)}"
    spent = f"{used['spent']} of {used['budget']} simulations, {report.seconds / 60:.1f} min on {cores}"
    rows = [f"### {name}", "", f"{size}. **{line}** {fall} ({spent}.)", ""]
    rows += ["| model | error | fitted |", "|---|---|---|"]
    candidates = {c.effect: c for c in chosen_candidates(report)}
    for step in report.history:
        kind = step.get("added")
        fitted = ", ".join(parameter_lines(candidates[kind])) if kind in candidates else ""
        rows.append(f"| {effect_title(kind) if kind else 'believed'} | {step['error']:.2f} | {fitted} |")
    rows += [f"| floor | {report.error['floor']:.2f} | |", ""]
    near = [f"{effect_title(c.effect)} (evidence {c.evidence:.0f})" for c in report.ranking[:5]]
    rows += [f"Ranking at the first step: {'; '.join(near)}.", ""]
    rows += [*distances, ""]
    still = [f"{f['title']} ({f['z']:.0f} → {f['z_after']:.0f} sd)" for f in report.failing if abs(f["z_after"]) > 3]
    rows += [f"Still off: {'; '.join(still[:8]) or 'nothing beyond 3 sd'}.", ""]
    rows += [f"* {note}" for note in report.notes]
    return "\n".join(rows) + "\n"


def keep(name: str, report: nm.Report) -> None:
    """A movie's errors: of the model believed, the completed one, its floor, and without each effect."""
    kept = json.loads(ERRORS.read_text()) if ERRORS.exists() else {}
    without = {c.effect: c.error_without for c in chosen_candidates(report)}
    kept[name] = {key: report.error[key] for key in ("before", "after", "floor")} | {"without": without}
    ERRORS.write_text(json.dumps({name: kept[name] for name in NAMES if name in kept}, indent=1) + "\n")


def distance(movie: Any, model: nm.Model, dark: Any, what: str, options: dict[str, Any], seed: int = 0) -> str:
    """W1 of the extracted traces against simulations of a model, in words."""
    try:
        found = compare_movie(movie, model, dark, fit=False, seed=seed, **options)
    except nm.MufasaError as error:
        return f"W1, {what}: not to be had ({error})"
    w1 = found.w1
    if w1["mufasa"] is None:
        return f"W1, {what}: not to be had (no simulated molecule passes the selection)"
    floor = f"floor {w1['floor']:.3g}" if np.isfinite(w1["floor"]) else "too few molecules for a floor"
    return f"W1, {what}: {w1['mufasa']:.3g} {w1['unit']} ({floor})"


def distances_of(
    movie: Any, believed: nm.Model, completed: nm.Model, dark: Any, rules: dict[str, Any], seed: int = 0
) -> list[str]:
    """W1 of a movie's traces against two models, and how many molecules the movie and the completed model show; that
    also in the part that was looked at."""
    told = [
        distance(movie, believed, dark, "model believed", rules, seed),
        distance(movie, completed, dark, "completed model", rules, seed),
        counted(movie, completed, dark, "", rules),
    ]
    part = prepare(movie, believed, dark)
    if not part.part.is_whole:
        there = cropped(completed)
        told.append(distance(part.movie, there, part.dark, "there, in the part looked at", rules, seed))
        told.append(counted(part.movie, there, part.dark, " in the part looked at", rules))
    return [f"* {line}" for line in told]


def counted(movie: Any, model: nm.Model, dark: Any, where: str, rules: dict[str, Any]) -> str:
    """How many molecules' traces are kept in a movie, and in movies of a model, in words."""
    simulated = (nm.simulate(model, seed=k).movie for k in range(SIMULATED))
    measured, *kept = (len(extract_traces(m, model.camera, dark, **rules).traces) for m in (movie, *simulated))
    return (
        f"Molecules kept{where}: {measured}; in {SIMULATED} movies of the completed model {', '.join(map(str, kept))}"
    )


def fitted_with(
    path: Path, kinds: list[str], name: str, movie: Any, model: nm.Model, dark: Any, rules: dict[str, Any], seed: int
) -> None:
    """Print what comes of a movie's completed model fitted anew with further effects."""
    effects = nm.Model.from_json(path).effects
    with working(f"fitting {name}") as work:
        report = nm.refine(movie, model, [*effects, *kinds], dark, seed=seed, **work.both())
    lines = distances_of(movie, model, report.model, dark, rules)
    print(told(name, report, lines, " × ".join(str(n) for n in movie.shape) + " (frame, y, x)"), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="movies whose name holds this word")
    parser.add_argument("--write", action="store_true", help="store in docs/real_movies.md")
    parser.add_argument("--seed", type=int, default=1, help="of the simulations; the page is that of seed 1")
    parser.add_argument(
        "--model", type=Path, help="of one movie, completed before: no diagnosis, but fitted anew with …"
    )
    parser.add_argument("--add", default=[], nargs="+", metavar="KIND", help="… these effects more; nothing is stored")
    options = parser.parse_args()
    if options.write and options.seed != 1:
        parser.error("the page is that of seed 1: leave out --write or --seed")
    if bool(options.model) != bool(options.add) or (options.model and options.write):
        parser.error("--model and --add go together, and without --write")
    for name, movie, model, dark, rules in movies():
        if options.only not in name:
            continue
        if options.model:
            fitted_with(options.model, options.add, name, movie, model, dark, rules, options.seed)
            continue
        with working(f"diagnosing {name}") as work:
            report = nm.diagnose(movie, model, dark, seed=options.seed, **work.both())
        folder = ROOT / "build" / "real_movies" / Path(name).stem
        folder.mkdir(parents=True, exist_ok=True)
        shape = " × ".join(str(n) for n in movie.shape)
        html_report.export(folder, report, extract_traces(movie, model.camera, dark, **rules).traces, shape)
        distances = distances_of(movie, model, report.model, dark, rules)
        section = told(name, report, distances, f"{shape} (frame, y, x)")
        print(section, flush=True)
        if options.write:
            write("real_movies.md", name, section, TITLES)
            keep(name, report)


if __name__ == "__main__":
    main()
