"""Verbs of the discovery loop: diagnose, refine; and power, which asks before the movie is taken."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from napari_mufasa.cli import console
from napari_mufasa.cli.options import (
    Budget,
    Channel,
    DarkFile,
    ModelFile,
    MovieFile,
    OutFolder,
    Overwrite,
    Scheduler,
    Seed,
    TraceBackground,
    TraceProfile,
    TraceUnit,
)
from napari_mufasa.cli.registering import one_channel
from napari_mufasa.errors import MufasaError

if TYPE_CHECKING:
    from napari_mufasa.discover.result import Report
    from napari_mufasa.model.model import Model

TABLES = (".csv", ".h5", ".hdf5", ".traces")  # of traces; TIFF may be either


def diagnose(
    movie: MovieFile,
    model: ModelFile,
    out: OutFolder,
    dark: DarkFile = None,
    seed: Seed = 1,
    budget: Budget = None,
    traces: Annotated[
        bool,
        typer.Option(
            "--traces", help="MOVIE is a table of traces instead: CSV, TIFF, HDF5, OpenFRET .json or .traces."
        ),
    ] = False,
    unit: TraceUnit = None,
    profile: TraceProfile = None,
    with_background: TraceBackground = None,
    check: Annotated[
        Path | None,
        typer.Option("--check", metavar="MOVIE", help="Does it hold in this other movie of the same set-up?"),
    ] = None,
    halves: Annotated[
        bool, typer.Option("--halves", help="Do the two halves of the field say the same? (two diagnoses more)")
    ] = False,
    channel: Channel = None,
    scheduler: Scheduler = None,
    overwrite: Overwrite = False,
) -> None:
    """Find the physical effect the model lacks; write report.json, report.html, figures and the completed model."""
    from napari_mufasa import discover
    from napari_mufasa.files.outputs import DIAGNOSIS
    from napari_mufasa.files.traces import read_trace_file
    from napari_mufasa.model.model import Model

    console.check_folder_out(out, overwrite, DIAGNOSIS, movie, model, dark, check)
    believed = Model.from_json(model)
    if check is not None and halves:
        raise MufasaError("--check and --halves: one of them at a time")
    if traces:
        if check is not None or halves:
            raise MufasaError("--check and --halves belong to a movie: drop them for a table of traces")
        if dark is not None:
            raise MufasaError("--dark belongs to a movie; traces have their background taken off or not: drop it")
        if channel is not None:
            raise MufasaError("--channel belongs to a movie: drop it for a table of traces")
        table = read_trace_file(movie, unit=unit)
        without = None if with_background is None else not with_background
        with console.working("diagnosing", scheduler) as work:
            report = discover.diagnose_traces(
                table, believed, profile=profile, background_subtracted=without, seed=seed, budget=budget, **work.all()
            )
        subtitle = "{}: {} traces of {} frames".format(movie.name, *table.traces.shape)
        _finish(out, report, table.traces, subtitle, [movie, model])
        return
    for name, given in (("--unit", unit), ("--profile", profile), ("--with-background", with_background)):
        if given is not None:
            raise MufasaError(f"{name} belongs to a table of traces; add --traces if this is one")
    if movie.suffix.lower() in TABLES and movie.is_file():
        raise MufasaError(f"{movie} is no movie: is it a table of traces? add --traces")
    whole, dark_frames = believed, console.dark_frames(dark)
    recorded, believed, background = _loaded(movie, whole, dark_frames, channel)
    other = None if check is None else _loaded(check, whole, dark_frames, channel)[0]
    with console.working("diagnosing", scheduler) as work:
        report = discover.diagnose(recorded, believed, background, seed=seed, budget=budget, **work.all())
    if check is not None:
        with console.working(f"checking on {check.name}", scheduler) as work:
            held = discover.confirm(report, other, believed, background, seed=seed, budget=budget, **work.all())
        report = replace(report, check=held.to_dict(check.name))
    if halves:
        with console.working("checking on two halves", scheduler) as work:
            held = discover.confirm_halves(recorded, believed, background, seed=seed, budget=budget, **work.all())
        report = replace(report, check=held.to_dict("the two halves of the field, apart"))
    _finish_movie(out, report, recorded, background, [movie, model, dark, check])


def refine(
    movie: MovieFile,
    model: ModelFile,
    add: Annotated[
        list[str], typer.Option("--add", metavar="KIND[:NAME=VALUE,…] …", help="Effects to add and fit, in order.")
    ],
    out: OutFolder,
    dark: DarkFile = None,
    seed: Seed = 1,
    scheduler: Scheduler = None,
    overwrite: Overwrite = False,
) -> None:
    """Add the effects you name, fit them, and show how the error changes."""
    from napari_mufasa import discover
    from napari_mufasa.files.outputs import DIAGNOSIS
    from napari_mufasa.model.model import Model

    console.check_folder_out(out, overwrite, DIAGNOSIS, movie, model, dark)
    believed = Model.from_json(model)
    effects = [_effect(believed, text) for text in add]
    background = console.dark_frames(dark)
    recorded, believed, background = _loaded(movie, believed, background)
    with console.working("refining", scheduler) as work:
        report = discover.refine(recorded, believed, effects, background, seed=seed, **work.all())
    _finish_movie(out, report, recorded, background, [movie, model, dark])


def power(
    model: ModelFile,
    effect: Annotated[
        str, typer.Option("--effect", metavar="KIND[:NAME=VALUE,…]", help="What may be hidden in the movie.")
    ],
    strength: Annotated[
        str | None, typer.Option("--strength", metavar="V1,V2,…", help="Of the effect, instead of the one it has.")
    ] = None,
    movies: Annotated[int, typer.Option(min=2, max=10_000, metavar="N", help="Simulated with each strength.")] = 40,
    dark_frames: Annotated[int, typer.Option(min=0, max=10_000, metavar="N", help="Recorded beside the movie.")] = 50,
    seed: Seed = 1,
    out: Annotated[Path | None, typer.Option("--out", metavar="TABLE.csv", help="Also write the table.")] = None,
    figure: Annotated[
        Path | None, typer.Option("--figure", metavar="PNG|SVG", help="Draw the power over the strength.")
    ] = None,
    scheduler: Scheduler = None,
    overwrite: Overwrite = False,
) -> None:
    """Predict how likely a diagnosis sees an effect, before the movie is taken."""
    import pandas as pd

    from napari_mufasa import discover, files
    from napari_mufasa.discover.detection import strength_seen
    from napari_mufasa.model.model import Model

    console.check_apart(out, figure)
    console.check_figure_out(figure)
    for path in (out, figure):
        if path is not None:
            console.check_file_out(path, overwrite)
            console.check_not_read(path, model)
    believed = Model.from_json(model)
    hidden = console.effect_from_text(believed, effect)
    strengths = None if strength is None else _numbers(strength)
    with console.working("simulating", scheduler) as work:
        found = discover.power(
            believed, hidden, strengths, movies=movies, dark_frames=dark_frames, seed=seed, **work.all()
        )  # fmt: skip
    table = pd.DataFrame([one.row() for one in found])
    if out is not None:
        files.write_table(out, table)
        console.tell_origin(out, believed, (model,))
    if figure is not None:
        from napari_mufasa.report.figures import power_drawing

        files.whole.write_bytes(figure, console.figure_bytes(power_drawing(table, hidden.kind), figure))
    console.print_table(tuple(table), [tuple(row) for row in table.to_numpy()])
    asked = f"it must promise {found[0].needed:.3g} (median of {len(found[0].looks)} diagnoses)"
    typer.echo(f"{asked}: by chance alone some effect promises what it must in 1 of 50 movies")
    if len(found) > 1:
        least = strength_seen(found)
        told = "none of these" if least is None else f"from {hidden.strength} = {least:.3g} on"
        typer.echo(f"seen in nine of ten movies: {told}")


def _numbers(text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise MufasaError(f"--strength {text!r}: write numbers with commas between, as 0.2,0.5,1") from None


def _loaded(movie: Path, model: Model, dark: Any, channel: str | None = None) -> tuple[Any, Model, Any]:
    """Movie, lazy, model and dark frames; of one channel where that is asked for."""
    from napari_mufasa import files

    read, model, dark = one_channel(channel, files.read_movie(movie).recorded(), model, dark)
    console.tell_disagreement(read, model, dark)
    return read.data, model, dark


def _effect(model: Any, text: str) -> Any:
    """A kind alone leaves every value to the fit; with values it starts from them."""
    effect = console.effect_from_text(model, text)
    return effect if ":" in text else effect.kind


def _finish_movie(out: Path, report: Report, recorded: Any, background: Any, read: list[Path | None]) -> None:
    from napari_mufasa.report import figures

    n_frames, height, width = recorded.shape
    subtitle = f"{read[0].name if read[0] else None}: {n_frames} frames of {height} × {width} px"
    _finish(out, report, figures.traces_to_show(recorded, report.base, background), subtitle, read)


def _finish(out: Path, report: Report, traces: Any, subtitle: str, read: Sequence[Path | None]) -> None:
    from napari_mufasa.files.outputs import DIAGNOSIS
    from napari_mufasa.report import html as html_report
    from napari_mufasa.report.words import summary

    with console.filling(out, DIAGNOSIS, report.base, report.seed, read) as folder:
        html_report.export(folder, report, traces, subtitle)
    for line in summary(report):
        typer.echo(line)
    if w1 := report.w1:
        rows = [(f"W1 ({w1['unit']})", w1["before"], w1["after"], w1["floor"])]
        console.print_table(("", "before", "after", "floor"), rows)
    typer.echo(f"see {out / 'report.html'}")


VERBS = (diagnose, refine, power)
