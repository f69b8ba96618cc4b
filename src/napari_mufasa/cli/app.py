"""The typer application: global options and the list of verbs."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from napari_mufasa.cli import batching, believing, discovering, making, measuring, registering

app = typer.Typer(
    name="napari-mufasa",
    help="Simulate, denoise, extract, compare single-molecule movies, and find the physics a model lacks.",
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

for verb in (
    *making.VERBS,
    *measuring.VERBS,
    *registering.VERBS,
    *believing.VERBS,
    *discovering.VERBS,
    *batching.VERBS,
):
    app.command(verb.__name__)(verb)


def _tell_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"napari-mufasa {version('napari-mufasa')}")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def options(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", help="Show the version and leave.", callback=_tell_version, is_eager=True)
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show where an error comes from.")] = False,
) -> None:
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


def spread_lists(arguments: Sequence[str]) -> list[str]:
    """``--add A B`` as ``--add A --add B``: typer's options take a fixed number of values, a list only repeated.

    A word belongs to the list while it looks like KIND or KIND:NAME=VALUE and is no file.
    """
    spread: list[str] = []
    listing = False
    for argument in arguments:
        if listing and re.fullmatch(r"[A-Za-z]\w*(:.*)?", argument) and not Path(argument).exists():
            if spread[-1] != "--add":
                spread.append("--add")
            spread.append(argument)
            continue
        listing = argument == "--add"
        spread.append(argument)
    return spread
