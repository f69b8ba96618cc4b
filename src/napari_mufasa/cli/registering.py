"""Two channels at the command line: the verb register, one channel of a movie, donor and acceptor side by side."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from napari_mufasa.cli import console
from napari_mufasa.cli.options import KindName, Overwrite
from napari_mufasa.errors import MufasaError

if TYPE_CHECKING:
    from napari_mufasa.channels.rectangle import Rectangle
    from napari_mufasa.files import Movie
    from napari_mufasa.model.model import Model

RECTANGLE = "left, right, top, bottom or Y0:Y1,X0:X1 in pixels"


def register(
    beads: Annotated[
        Path, typer.Argument(metavar="BEADS", help="Beads, or a movie whose molecules both channels show.")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="channels.json", help="Rectangles and transform.")],
    donor: Annotated[str, typer.Option("--donor", metavar="RECT", help=f"The donor's channel: {RECTANGLE}.")] = "left",
    acceptor: Annotated[str, typer.Option("--acceptor", metavar="RECT", help="The acceptor's channel.")] = "right",
    kind: Annotated[
        KindName | None, typer.Option("--kind", help="Default: of second order where the beads show it.")
    ] = None,
    figure: Annotated[
        Path | None, typer.Option("--figure", metavar="PNG|SVG", help="Also draw the beads and how far off each is.")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Find which place of the acceptor's channel is which of the donor's, with a residual and intervals."""
    from napari_mufasa import files
    from napari_mufasa.channels import register as find_map
    from napari_mufasa.files.whole import write_bytes
    from napari_mufasa.report.figures import registration_drawing
    from napari_mufasa.report.lines import channels_lines

    console.check_apart(out, figure)
    console.check_figure_out(figure)
    for path in (out, figure):
        if path is not None:
            console.check_file_out(path, overwrite)
            console.check_not_read(path, beads)
    recorded = files.read_movie(beads).data
    with console.working("registering") as work:
        found = find_map(recorded, donor, acceptor, kind=kind, **work.both())
    found.to_json(out)
    if figure is not None:
        write_bytes(figure, console.figure_bytes(registration_drawing(found), figure))
    for line in channels_lines(found):
        typer.echo(line)
    typer.echo(f"{out}: donor {found.donor}, acceptor {found.acceptor}")


def one_channel(where: str | Rectangle | None, movie: Movie, model: Model | None, dark: Any) -> tuple[Movie, Any, Any]:
    """Movie, model and dark frames of one channel; all of them where none is asked for."""
    if where is None:
        return movie, model, dark
    from napari_mufasa.channels import rectangle

    frame_px = (int(movie.data.shape[1]), int(movie.data.shape[2]))
    side = rectangle(where, frame_px)
    if dark is not None and tuple(dark.shape[1:]) == frame_px:
        dark = side.crop(dark)
    return replace(movie, data=side.crop(movie.data)), None if model is None else side.model(model, frame_px), dark


def pair_traces(
    movie: Path, model: Path, dark: Path | None, channels: Path, out: Path, given: dict[str, Any], hdf5: bool,
    openfret: bool,
) -> None:  # fmt: skip
    """Donor and acceptor of the molecules of a movie, written to a folder, with figures."""
    from napari_mufasa import files
    from napari_mufasa.channels import Channels, extract_pair
    from napari_mufasa.channels.table import write_pair
    from napari_mufasa.files.outputs import PAIR, TRACES
    from napari_mufasa.model.model import Model
    from napari_mufasa.provenance import provenance
    from napari_mufasa.report import figures
    from napari_mufasa.report.lines import efficiency_line

    believed, registered = Model.from_json(model), Channels.from_json(channels)
    read = files.read_movie(movie)
    background = console.dark_frames(dark, read)
    console.tell_disagreement(*one_channel(registered.donor, read, believed, background))
    with console.working("traces") as work:
        found = extract_pair(
            read.data,
            believed.camera,
            registered,
            background,
            psf_sigma_px=believed.sigma_px,
            unit=read.unit,
            **given,
            **work.both(),
        )
    made = provenance(believed, None, (movie, model, dark, channels))
    with files.filling(out, (*TRACES, *PAIR)) as folder:
        write_pair(folder, found, hdf5=hdf5, openfret=openfret, acquisition=believed.acquisition, made=made)
        figures.write(folder, figures.pair_drawings(read.data, found))
    console.tell_molecules(out, found.donor)
    typer.echo(efficiency_line(found))


def pair_options(
    channels: Path | None, find_in: str | None, leakage: float, direct_e: float, gamma: float, sigma_px: float | None
) -> dict[str, Any]:
    """What belongs to two channels, as keywords; raises `MufasaError` where it is given without them."""
    plain = (find_in, leakage, direct_e, gamma, sigma_px) == (None, 0.0, 0.0, 1.0, None)
    if channels is None and not plain:
        raise MufasaError(
            "--find-in, --leakage, --direct-excitation, --gamma and --acceptor-sigma belong to two channels: "
            "add --channels channels.json, which register writes"
        )
    return {
        "find_in": find_in or "sum", "leakage": leakage, "direct_excitation_e": direct_e, "gamma": gamma,
        "acceptor_sigma_px": sigma_px,
    }  # fmt: skip


VERBS = (register,)
