"""The verb for many movies: batch."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from napari_mufasa.cli import console
from napari_mufasa.cli.options import (
    Budget,
    DarkFile,
    FollowDrift,
    FollowMolecules,
    MethodName,
    OutFolder,
    Overwrite,
    Scheduler,
    Seed,
)
from napari_mufasa.errors import MufasaError

if TYPE_CHECKING:
    from napari_mufasa.batch.run import Result

DEFAULT_STEPS = "traces,compare,diagnose"


def batch(
    source: Annotated[
        Path, typer.Argument(metavar="FOLDER|LIST", help="Movies, folders in it being conditions; or a CSV list.")
    ],
    out: OutFolder,
    do: Annotated[
        str, typer.Option("--do", metavar="STEP,…", help="Of denoise, traces, compare, diagnose.")
    ] = DEFAULT_STEPS,
    model: Annotated[
        Path | None, typer.Option("--model", metavar="MODEL.json", help="Of movies that the list names none for.")
    ] = None,
    dark: DarkFile = None,
    effects: Annotated[
        str | None, typer.Option("--effects", metavar="KIND,…", help="Consider only these effects in a diagnosis.")
    ] = None,
    seed: Seed = 1,
    budget: Budget = None,
    follow_drift: FollowDrift = False,
    follow_molecules: FollowMolecules = False,
    method: Annotated[MethodName, typer.Option("--method", help="Of denoising.")] = "pure-let-movie",
    scheduler: Scheduler = None,
    overwrite: Overwrite = False,
) -> None:
    """Do the same to many movies and tell them apart; what is finished is kept when it is run again."""
    from napari_mufasa.batch import Settings, read_entries, run
    from napari_mufasa.batch.table import difference_table, write_tables
    from napari_mufasa.report.batch import difference_line, nothing_told

    steps = tuple(dict.fromkeys(step.strip() for step in do.split(",") if step.strip()))
    if not steps:
        raise MufasaError("--do names no step: choose of denoise, traces, compare, diagnose")
    kinds = None if effects is None else tuple(kind.strip() for kind in effects.split(",") if kind.strip())
    console.check_folder_out(out, True, ())
    entries = read_entries(source, model=model, dark=dark)
    settings = Settings(
        steps=steps, seed=seed, effects=kinds, budget=budget, follow_drift=follow_drift,
        follow_molecules=follow_molecules, method=method,
    )  # fmt: skip
    results: list[Result] = []
    with console.working("batch", scheduler) as work:
        for result in run(entries, out, settings, overwrite=overwrite, **work.all()):
            results.append(result)
            for words in result.told.get("doubts") or []:
                console.note(f"{result.entry.name}: {words}")
            typer.echo(f"[{len(results)}/{len(entries)}] {_line(result, steps)}")
    write_tables(out, results, f"{source.name}: {len(results)} movies")
    apart = difference_table(results)
    differing = apart[apart["differs"]] if len(apart) else apart
    for _, row in differing.iterrows():
        typer.echo(f"conditions differ in {difference_line(row)}")
    if len(apart) and not len(differing):
        typer.echo(nothing_told(apart))
    failed = [result for result in results if result.error]
    typer.echo(f"see {out / 'summary.html'}")
    if failed:
        raise MufasaError(
            f"{len(failed)} of {len(results)} movies could not be done, the others are: {failed[0].entry.name}: "
            f"{failed[0].error}"
        )


def _line(result: Result, steps: tuple[str, ...]) -> str:
    from napari_mufasa.batch.table import strength_text

    told: dict[str, Any] = result.told
    parts = []
    if "molecules" in told:
        parts.append(f"{told['molecules']} molecules")
    if told.get("w1") is not None:
        floor = told["w1_floor"]  # none of fewer than two molecules
        parts.append(f"W1 {told['w1']:.3g} ({'no floor' if floor is None else f'floor {floor:.3g}'})")
    if "verdict" in told:
        found = "; ".join(strength_text(one) or one["effect"] for one in told["effects"]) or told["verdict"]
        parts.append(f"{found}, error {told['error_before']:.3g} → {told['error_after']:.3g}")
    if result.error:
        parts.append(f"failed: {result.error}")
    kept = set(result.kept) == set(steps)
    how = "done before" if kept else f"{result.seconds:.1f} s"
    return f"{result.entry.name}: {' · '.join([*parts, how])}"


VERBS = (batch,)
