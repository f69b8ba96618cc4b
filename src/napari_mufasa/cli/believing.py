"""Verbs that measure what to believe: calibrate, propose, infer; and tell what a file says: info."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from napari_mufasa.cli import console
from napari_mufasa.cli.options import CameraName, DarkFile, ModelFile, MovieFile, Overwrite, TraceProfile, TraceUnit

if TYPE_CHECKING:
    from napari_mufasa.calibrate.found import Calibration
    from napari_mufasa.calibrate.known import Known
    from napari_mufasa.calibrate.value import Value

Gain = Annotated[float | None, typer.Option("--em-gain", min=1, metavar="G", help="If known.")]
PerAdu = Annotated[float | None, typer.Option("--electrons-per-adu", min=1e-6, metavar="E", help="If known.")]
Efficiency = Annotated[float, typer.Option("--quantum-efficiency", min=0.01, max=1, metavar="QE")]
ReportFile = Annotated[
    Path | None, typer.Option("--report", metavar="JSON", help="Also write all values with their intervals.")
]


def calibrate(
    movie: MovieFile,
    out: Annotated[Path, typer.Option("--out", metavar="camera.json", help="The camera part of a model.json.")],
    dark: DarkFile = None,
    camera_type: Annotated[CameraName | None, typer.Option("--type", help="Of the camera, if known.")] = None,
    em_gain: Gain = None,
    electrons_per_adu: PerAdu = None,
    baseline_adu: Annotated[
        float | None, typer.Option("--baseline-adu", min=0, metavar="B", help="If known, instead of dark frames.")
    ] = None,
    quantum_efficiency: Efficiency = 0.9,
    report: ReportFile = None,
    figure: Annotated[
        Path | None, typer.Option("--figure", metavar="PNG|SVG", help="Also draw the laws against the histograms.")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Measure the camera from a movie and its dark frames: numbers with 95 % intervals and a test of fit."""
    from napari_mufasa import files
    from napari_mufasa.calibrate.measure import calibrate as measure
    from napari_mufasa.files.instrument import read_instrument
    from napari_mufasa.propose.written import camera_told

    console.check_apart(out, report, figure)
    for path in (out, report, figure):
        if path is not None:
            console.check_file_out(path, overwrite)
            console.check_not_read(path, movie, dark)
    console.check_figure_out(figure)
    recorded = files.read_movie(movie).recorded().data
    background = console.dark_frames(dark)
    written = read_instrument(movie)
    known, gain, notes = camera_told(written, camera_type, em_gain)
    with console.working("calibrating") as work:
        found = measure(
            recorded, background, camera_type=known, em_gain=gain, electrons_per_adu=electrons_per_adu,
            quantum_efficiency=quantum_efficiency, baseline_adu=baseline_adu,
            **work.both(),
        )  # fmt: skip
    section = found.camera.model_dump(mode="json", exclude_none=True)
    if found.camera.type != "CMOS":
        section.pop("cmos_gain_curve")
    files.write_json(out, section)
    console.tell_origin(out, None, (movie, dark))
    if report is not None:
        files.write_json(report, found.report() | {"metadata": written.known()})
    if figure is not None:
        from napari_mufasa.report.figures import calibration_drawing

        files.whole.write_bytes(figure, console.figure_bytes(calibration_drawing(found), figure))
    console.print_table(("measured", "value [95 %]"), _rows(found))
    for fit in found.fits:
        typer.echo(f"test of fit, {fit.name}: {100 * fit.distance:.2g} % of the counts lie elsewhere than the law says")
    verdict = "the law holds" if found.law_holds else "the law is not all there is"
    typer.echo(f"test of fit, all: p = {found.p_value:.2g}: {verdict}")
    if written.known():
        typer.echo("metadata: " + ", ".join(f"{name} {value}" for name, value in written.known().items()))
    for note in (*notes, *found.notes):
        typer.echo(f"note: {note}")
    typer.echo(f"{out}: the camera part of a model.json")


def propose(
    movie: MovieFile,
    out: Annotated[Path, typer.Option("--out", metavar="model.json", help="The model to start from.")],
    dark: DarkFile = None,
    camera_type: Annotated[CameraName | None, typer.Option("--type", help="Of the camera, if known.")] = None,
    em_gain: Gain = None,
    electrons_per_adu: PerAdu = None,
    quantum_efficiency: Efficiency = 0.9,
    pixel_size_nm: Annotated[
        float | None, typer.Option("--pixel-size-nm", min=1e-3, metavar="NM", help="If known.")
    ] = None,
    frame_length_s: Annotated[
        float | None, typer.Option("--frame-length-s", min=1e-9, metavar="S", help="If known.")
    ] = None,
    report: ReportFile = None,
    overwrite: Overwrite = False,
) -> None:
    """Propose a first model: metadata, camera, spots and traces, and what could not be known."""
    from napari_mufasa import files
    from napari_mufasa.model.model import Model
    from napari_mufasa.propose import propose_model, stated

    console.check_apart(out, report)
    for path in (out, report):
        if path is not None:
            console.check_file_out(path, overwrite)
            console.check_not_read(path, movie, dark)
    read, background = files.read_movie(movie).recorded(), console.dark_frames(dark)
    known = stated(read.instrument, Model.stored_in(read.metadata))
    with console.working("proposing") as work:
        found = propose_model(
            read.data, background, instrument=known, camera_type=camera_type, em_gain=em_gain,
            electrons_per_adu=electrons_per_adu, quantum_efficiency=quantum_efficiency, pixel_size_nm=pixel_size_nm,
            frame_length_s=frame_length_s, **work.both(),
        )  # fmt: skip
    console.tell_origin(_written(found, "proposed", out, report), None, (movie, dark))
    typer.echo(f"{out}: a model to start from")


def infer(
    traces: Annotated[
        Path, typer.Argument(metavar="TRACES", help="CSV, TIFF, HDF5, OpenFRET .json or .traces, whole movies.")
    ],
    model: ModelFile,
    out: Annotated[Path, typer.Option("--out", metavar="model.json", help="The model with what was inferred.")],
    unit: TraceUnit = None,
    profile: TraceProfile = None,
    all_molecules: Annotated[
        bool, typer.Option("--all-molecules", help="Molecules that never shone are among the traces.")
    ] = False,
    report: ReportFile = None,
    overwrite: Overwrite = False,
) -> None:
    """Infer brightness, bleaching, dark state and activation from traces, and say what cannot be told apart."""
    from napari_mufasa.files.traces import read_trace_file
    from napari_mufasa.infer import infer_photophysics
    from napari_mufasa.model.model import Model
    from napari_mufasa.traces.extract import held_share

    console.check_apart(out, report)
    for path in (out, report):
        if path is not None:
            console.check_file_out(path, overwrite)
            console.check_not_read(path, traces, model)
    table, believed = read_trace_file(traces, unit=unit), Model.from_json(model)
    share = None if profile is None else held_share(profile, believed.sigma_px)  # else as the file says
    with console.working("inferring") as work:
        found = infer_photophysics(table, believed, pixel_share=share, all_molecules=all_molecules, **work.both())
    typer.echo(f"{traces}: {found.n_molecules} molecules")
    console.tell_origin(_written(found, "inferred", out, report), believed, (traces, model))
    typer.echo(f"{out}: the model with what was inferred")


def info(movie: MovieFile) -> None:
    """Print what a movie is: its size, and what the recording software wrote of the instrument."""
    from napari_mufasa import files

    read = files.read_movie(movie)
    n_frames, height, width = read.data.shape
    model = read.metadata.get("model")
    rows: list[tuple[str, Any]] = [
        ("frames", n_frames),
        ("pixels", f"{height} × {width}"),
        ("numbers", str(read.data.dtype)),
    ]
    rows += [(name, read.metadata[name]) for name in ("role", "unit") if read.metadata.get(name)]
    rows += list(read.instrument.known().items())
    rows += [("model", f"{model.get('protocol')}, seed {read.seed}")] if isinstance(model, dict) else []
    console.print_table(("what", "value"), rows)


def _written(found: Known, how: str, out: Path, report: Path | None) -> Path:
    """The model and the report written, values, gaps and notes printed."""
    from napari_mufasa import files

    found.model.to_json(out)
    if report is not None:
        files.write_json(report, found.report())
    console.print_table((how, "value [95 %]"), [(name, _measured(v)) for name, v in found.values.items()])
    for name, words in found.unknown.items():
        typer.echo(f"unknown: {name}: {words}")
    for note in found.notes:
        typer.echo(f"note: {note}")
    return out


def _rows(found: Calibration) -> list[tuple[str, str]]:
    readout = found.readout
    values = {
        "baseline (ADU)": found.baseline_adu, "read noise (ADU)": found.read_noise_adu,
        "ADU per photoelectron": found.adu_per_photoelectron, "electrons per ADU": found.electrons_per_adu,
        "EM gain": found.em_gain, "excess noise factor": found.excess_noise_measured,
        "clock-induced charge (e/px/frame)": found.clock_induced_charge_e,
        "baseline, even and odd frames ± (ADU)": readout.alternation_adu,
        "baseline, jitter (ADU)": readout.jitter_adu,
    }  # fmt: skip
    rows = [(name, _measured(value)) for name, value in values.items()]
    rows += [(f"read-out, share of pixel x − {lag}", _measured(v)) for lag, v in enumerate(readout.shares, 1)]
    seen = {"row": readout.row_correlations, "column": readout.column_correlations}
    rows += [
        (f"neighbours, {name}, molecules included", _measured(values[0]))
        for name, values in (("row", readout.everywhere_row), ("column", readout.everywhere_column))
    ]
    if readout.dark_row_correlations is not None:
        seen |= {"row, dark": readout.dark_row_correlations}
    return rows + [(f"neighbours, {name}", " ".join(f"{c:+.3f}" for c in row[:3])) for name, row in seen.items()]


def _measured(found: Value) -> str:
    if not math.isfinite(found.value):
        return "unknown"
    low, high = found.interval
    return f"{found.value:.4g} [{low:.4g}, {high:.4g}]" if math.isfinite(low) else f"{found.value:.4g} (not measured)"


VERBS = (calibrate, propose, infer, info)
