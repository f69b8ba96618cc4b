"""Verbs of the discovery loop: diagnose, refine."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from napari_mufasa.cli import console
from napari_mufasa.cli.making import ModelFile, Seed
from napari_mufasa.cli.measuring import DarkFile, MovieFile, OutFolder

if TYPE_CHECKING:
    from napari_mufasa.discover.result import Report


def diagnose(movie: MovieFile, model: ModelFile, out: OutFolder, dark: DarkFile = None, seed: Seed = 1) -> None:
    """Find the physical effect the model lacks; write report.json, report.html, figures and the completed model."""
    from napari_mufasa import discover, io
    from napari_mufasa.model import Model

    console.check_folder_out(out)
    believed = Model.from_json(model)
    recorded, background = io.load(movie), None if dark is None else io.load(dark)
    with console.working("diagnosing") as work:
        report = discover.diagnose(recorded, believed, background, seed=seed, **work.both())
    _finish(out, report, movie, recorded, background)


def refine(
    movie: MovieFile,
    model: ModelFile,
    add: Annotated[
        list[str], typer.Option("--add", metavar="KIND[:NAME=VALUE,…] …", help="Effects to add and fit, in order.")
    ],
    out: OutFolder,
    dark: DarkFile = None,
    seed: Seed = 1,
) -> None:
    """Add the effects you name, fit them, and show how the error changes."""
    from napari_mufasa import discover, io
    from napari_mufasa.model import Model

    console.check_folder_out(out)
    believed = Model.from_json(model)
    effects = [_effect(believed, text) for text in add]
    recorded, background = io.load(movie), None if dark is None else io.load(dark)
    with console.working("refining") as work:
        report = discover.refine(recorded, believed, effects, background, seed=seed, **work.both())
    _finish(out, report, movie, recorded, background)


def _effect(model: Any, text: str) -> Any:
    """A kind alone leaves every value to the fit; with values it starts from them."""
    effect = console.effect_from_text(model, text)
    return effect if ":" in text else effect.kind


def _finish(out: Path, report: Report, movie: Path, recorded: Any, background: Any) -> None:
    from napari_mufasa import figures, html_report
    from napari_mufasa.wording import summary

    traces = figures.traces_to_show(recorded, report.base, background)
    n_frames, height, width = recorded.shape
    subtitle = f"{movie.name}: {n_frames} frames of {height} × {width} px"
    with console.folder(out) as folder:
        html_report.export(folder, report, traces, subtitle)
    for line in summary(report):
        typer.echo(line)
    typer.echo(f"see {out / 'report.html'}")


VERBS = (diagnose, refine)
