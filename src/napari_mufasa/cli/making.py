"""Verbs that start from a model: simulate, presets, design, demo."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from napari_mufasa import provenance
from napari_mufasa.checks import counted
from napari_mufasa.cli import console
from napari_mufasa.cli.options import EngineName, ModelFile, Overwrite, Resume, Scheduler, Seed, SnrBy
from napari_mufasa.errors import MufasaError

if TYPE_CHECKING:
    import pandas as pd

    from napari_mufasa.model.model import Model
    from napari_mufasa.report.figures import Drawing
    from napari_mufasa.simulate.movie import SimulatedAcquisition


def simulate(
    out: Annotated[Path, typer.Option("--out", metavar="MOVIE", help="MOVIE.ome.tif or MOVIE.zarr.")],
    preset: Annotated[str | None, typer.Option("--preset", metavar="NAME", help="A preset by name.")] = None,
    model: Annotated[Path | None, typer.Option("--model", metavar="MODEL.json", help="Or a model file.")] = None,
    n_molecules: Annotated[int | None, typer.Option("--n-molecules", min=0, metavar="N")] = None,
    frames: Annotated[int | None, typer.Option("--frames", min=1, metavar="N")] = None,
    shape: Annotated[tuple[int, int] | None, typer.Option("--shape", metavar="H W", help="Pixels.")] = None,
    positions: Annotated[
        Path | None, typer.Option("--positions", metavar="CSV", help="y_px, x_px or y_nm, x_nm.")
    ] = None,
    effect: Annotated[
        list[str] | None,
        typer.Option("--effect", metavar="KIND[:NAME=VALUE,…]", help="Add an effect; may be repeated."),
    ] = None,
    snr: Annotated[
        float | None,
        typer.Option("--snr", min=1e-6, metavar="S", help="Solve for this signal to noise of a whole spot in a frame."),
    ] = None,
    snr_by: Annotated[SnrBy | None, typer.Option("--snr-by", help="What --snr changes (power).")] = None,
    engine: Annotated[EngineName, typer.Option("--engine")] = "fast",
    truth: Annotated[
        Path | None,
        typer.Option(
            "--truth", metavar="DIR", help="Also write emission.csv (no rows of dark frames) and positions.csv."
        ),
    ] = None,
    seed: Seed = 0,
    scheduler: Scheduler = None,
    overwrite: Overwrite = False,
    resume: Resume = False,
) -> None:
    """Simulate a movie; the whole model and the seed travel in its metadata."""
    import numpy as np

    from napari_mufasa import files
    from napari_mufasa.files.outputs import TRUTH
    from napari_mufasa.report.words import hardly_seen
    from napari_mufasa.simulate.layout import read_positions
    from napari_mufasa.simulate.movie import SimulatedAcquisition

    console.check_movie_out(out, overwrite)
    console.check_not_read(out, model, positions)
    console.check_apart(out, truth)
    if truth is not None:
        console.check_folder_out(truth, overwrite, TRUTH, positions)
    asked = {"sample.n_molecules": n_molecules, "acquisition.n_frames": frames, "acquisition.shape_px": shape}
    chosen = _chosen_model(preset, model).with_values({k: v for k, v in asked.items() if v is not None})
    chosen = chosen.with_effects(*console.effects_from_texts(chosen, effect or []))
    if snr is not None:
        from napari_mufasa.design.solve import EXPOSURE, POWER

        chosen = _solved(chosen, {"snr_spot": snr}, EXPOSURE if snr_by == "exposure" else POWER)
    elif snr_by is not None:
        raise MufasaError("--snr-by goes with --snr, the signal to noise that is wanted: give both, or drop it")
    places = None if positions is None else read_positions(positions, chosen.acquisition.pixel_size_nm)
    if places is not None and n_molecules is not None:
        if n_molecules > len(places):
            raise MufasaError(f"--n-molecules {n_molecules}: {positions} has {len(places)} positions; give fewer")
        places = places[:n_molecules]
    if places is not None:  # the model in the metadata says what the movie holds
        chosen = chosen.with_values({"sample.n_molecules": len(places)})
    movie_shape = (chosen.acquisition.n_frames, *chosen.acquisition.shape_px)
    console.check_room(out, 2 * math.prod(movie_shape))
    acquisition = SimulatedAcquisition(chosen, places, seed, engine)
    with console.working("simulating", scheduler) as work:

        def blocks(first: int) -> Iterator[tuple[int, Any]]:
            for span, block in acquisition.blocks(first=first, **work.all()):
                yield span.start, block.movie

        at = acquisition.scene.positions_px
        made_from = {"model": chosen.to_dict(), "seed": seed, "engine": engine, "positions": at}
        files.write_movie(
            out, blocks, movie_shape, np.uint16, model=chosen, seed=seed, resume=made_from if resume else None
        )
    if truth is not None:
        _write_truth(truth, acquisition, (model, positions))
    n = len(acquisition.scene.positions_px)
    told = f"{counted(movie_shape[0], 'frame')} of {movie_shape[1]} × {movie_shape[2]} px, {counted(n, 'molecule')}"
    typer.echo(f"{out}: {told}, seed {seed}")
    if (faint := hardly_seen(chosen)) and n:
        typer.echo(faint)


def _chosen_model(preset: str | None, path: Path | None) -> Model:
    from napari_mufasa.model.model import Model
    from napari_mufasa.model.presets import preset as find_preset

    if (preset is None) == (path is None):
        raise MufasaError("give either --preset NAME or --model MODEL.json ('presets' lists the names)")
    return find_preset(preset) if preset is not None else Model.from_json(path or "")


def _write_truth(directory: Path, acquisition: SimulatedAcquisition, read: Sequence[Path | None]) -> None:
    import numpy as np
    import pandas as pd

    from napari_mufasa import files
    from napari_mufasa.files.outputs import TRUTH

    molecule, frame = np.nonzero(acquisition.emission)
    photons = acquisition.emission[molecule, frame]
    emission = pd.DataFrame({"molecule": molecule, "frame": frame, "photons": photons})
    positions = pd.DataFrame(acquisition.scene.positions_px, columns=["y_px", "x_px"])
    with console.filling(directory, TRUTH, acquisition.model, acquisition.seed, read) as folder:
        files.write_table(folder / "emission.csv", emission)
        files.write_table(folder / "positions.csv", positions.rename_axis("molecule").reset_index())


def presets(
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="Which one to print as model.json.")] = None,
    effects: Annotated[
        bool, typer.Option("--effects", help="List the effects instead, also of other packages.")
    ] = False,
) -> None:
    """Print a preset as model.json, or list them, or list the effects."""
    import json

    from napari_mufasa.model.presets import PRESETS, preset

    if effects:
        _print_effects()
        return
    if name is not None:
        typer.echo(json.dumps(preset(name).to_dict(), indent=1))
        return
    rows = []
    for each in PRESETS:
        model = preset(each)
        timing = model.acquisition
        frames = f"{timing.n_frames} × {1000 * timing.frame_length_s:g} ms"
        rows.append((each, model.protocol, model.camera.type, frames, f"{timing.shape_px[0]} × {timing.shape_px[1]}"))
    console.print_table(("preset", "protocol", "camera", "frames", "pixels"), rows)


def _print_effects() -> None:
    from napari_mufasa.effects import catalogue

    rows = []
    for kind, effect in catalogue().items():
        values = {name: field.default for name, field in effect.model_fields.items()}
        shown = ",".join(
            f"{name}={value:g}" if isinstance(value, float) else f"{name}={value}" for name, value in values.items()
        )
        rows.append((kind, effect.stage, shown))
    console.print_table(("effect", "stage", "NAME=VALUE (defaults)"), rows)


def design(
    model: ModelFile,
    vary: Annotated[
        list[str] | None,
        typer.Option("--vary", metavar="PATH=V1,V2,…", help="A value of the model to vary; may be repeated."),
    ] = None,
    target: Annotated[
        list[str] | None,
        typer.Option("--target", metavar="NAME=VALUE", help="A prediction that is wanted; may be repeated."),
    ] = None,
    solve: Annotated[
        str | None,
        typer.Option("--solve", metavar="PATH", help="The value of the model that targets are met by (power density)."),
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="TABLE.csv", help="Write the table as CSV.")] = None,
    out_model: Annotated[
        Path | None, typer.Option("--out-model", metavar="model.json", help="Write the model that meets the target.")
    ] = None,
    figure: Annotated[
        Path | None,
        typer.Option("--figure", metavar="PNG|SVG", help="Draw curves over one varied value, maps over two."),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Predict signal, noise, precision and life time before taking the movie, or solve for a target."""
    from napari_mufasa import files
    from napari_mufasa.design.predict import design as sweep
    from napari_mufasa.model.model import Model

    console.check_apart(out, out_model, figure)
    console.check_figure_out(figure)
    for path in (out, out_model, figure):
        if path is not None:
            console.check_file_out(path, overwrite)
            console.check_not_read(path, model)
    believed = Model.from_json(model)
    varied = _each_once("--vary", [_parse_vary(text) for text in vary or []])
    targets = _each_once("--target", [_parse_target(text) for text in target or []])
    if figure is not None and not 1 <= len(varied) <= 2:
        raise MufasaError("--figure draws over one value or two: give --vary once or twice")
    if out_model is not None and not targets:
        raise MufasaError("--out-model needs a --target that the model shall meet, as snr_spot=5")
    if solve is not None and not targets:
        raise MufasaError("--solve needs a --target that the value shall meet, as snr_spot=5")
    if targets:
        believed = _solved(believed, targets, solve)
    table = sweep(believed, varied)
    drawn = None if figure is None else console.figure_bytes(_drawn(table, varied, targets), figure)
    if out_model is not None:
        believed.to_json(out_model)
        typer.echo(f"{out_model}: the model with that value")
    if out is not None:
        files.write_table(out, table)
        console.tell_origin(out, believed, (model,))
    if figure and drawn:
        files.whole.write_bytes(figure, drawn)
    turned = table.astype(object).where(table.notna(), None).T
    head = ("quantity", *(f"case {i + 1}" for i in range(len(table)))) if len(table) > 1 else ("quantity", "value")
    console.print_table(head, [(name, *row) for name, row in zip(turned.index, turned.to_numpy(), strict=True)])


def _drawn(table: pd.DataFrame, varied: dict[str, list[Any]], targets: dict[str, float]) -> Drawing:
    """The figure of a sweep over numbers."""
    from napari_mufasa.report.figures import design_drawing

    for path, values in varied.items():
        if words := [value for value in values if not isinstance(value, (int, float))]:
            word = words[0] or "null"
            raise MufasaError(
                f"--figure draws over numbers: {word} of {path} has no place on an axis; drop it, or --figure"
            )
    shown = [name for name in targets if name in table]
    return design_drawing(table, list(varied), shown, targets)


def _solved(believed: Model, targets: dict[str, float], path: str | None) -> Model:
    """The model that meets the first target, by its power without a path; says what is met, and where all would be."""
    from napari_mufasa.design.solve import POWER, solve
    from napari_mufasa.report.lines import solution_lines

    found = solve(believed, targets, path or POWER)
    for line in solution_lines(found):
        typer.echo(line)
    return found.model


def _each_once(option: str, given: list[tuple[str, Any]]) -> dict[str, Any]:
    names = [name for name, _ in given]
    for name in names:
        if names.count(name) > 1:
            raise MufasaError(f"{option} {name} is given more than once: give it once, with all that is wanted")
    return dict(given)


def _parse_target(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        return name.strip(), float(value)
    except ValueError:
        raise MufasaError(f"--target {text!r}: write NAME=VALUE as in snr_spot=5") from None


def _parse_vary(text: str) -> tuple[str, list[Any]]:
    path, _, values = text.partition("=")
    if not path.strip() or not values.strip():
        raise MufasaError(f"--vary {text!r}: write PATH=V1,V2,… as in excitation.power_density_w_per_cm2=1,10,100")
    return path.strip(), [console.plain_value(value) for value in values.split(",")]


def demo(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Where to write.")] = Path("demo"),
    seed: Seed = 1,
    viewer: Annotated[bool, typer.Option("--viewer", help="Open the result in napari at the end.")] = False,
    overwrite: Overwrite = False,
) -> None:
    """Hide an effect in a simulated movie, find it from the files alone, then open the envelope."""
    from napari_mufasa import files
    from napari_mufasa.cli.demo import WRITTEN, open_viewer, run

    console.check_folder_out(out, overwrite, WRITTEN)
    with console.working("demo") as work:
        run(out, seed, say=typer.echo, **work.both())
    files.write_json(out / "demo.provenance.json", provenance.provenance(None, seed))
    if viewer:
        open_viewer(out)


VERBS = (demo, simulate, design, presets)
