"""Verbs that start from a movie and a camera: denoise, traces, compare."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from napari_mufasa.checks import counted
from napari_mufasa.cli import console, registering
from napari_mufasa.cli.options import (
    AcceptorSigma,
    Best,
    CameraName,
    Channel,
    ChannelsFile,
    DarkFile,
    DirectExcitation,
    FindIn,
    FollowDrift,
    FollowMolecules,
    Gamma,
    Leakage,
    MaxGap,
    MaxStep,
    MaxSteps,
    MethodName,
    ModelFile,
    MovieFile,
    OutFolder,
    Overwrite,
    ProfileName,
    Resume,
    Scheduler,
    Seed,
    ThresholdName,
    TimesName,
    TraceBackground,
    TraceProfile,
    TraceUnit,
    Window,
)
from napari_mufasa.errors import MufasaError

if TYPE_CHECKING:
    from napari_mufasa.model.setup import Camera


def denoise(
    movie: MovieFile,
    out: Annotated[Path, typer.Option("--out", metavar="OUT", help="OUT.tif or OUT.zarr.")],
    model: Annotated[Path | None, typer.Option("--model", metavar="MODEL.json", help="With the camera.")] = None,
    dark: Annotated[
        Path | None,
        typer.Option("--dark", metavar="DARK", help="Or frames without light: the camera is measured on the data."),
    ] = None,
    camera_type: Annotated[
        CameraName | None, typer.Option("--type", help="Of the camera, with --dark; else the data tell.")
    ] = None,
    method: Annotated[MethodName, typer.Option("--method", help="Which estimator.")] = "pure-let-movie",
    channel: Channel = None,
    scheduler: Scheduler = None,
    overwrite: Overwrite = False,
    resume: Resume = False,
) -> None:
    """Estimate the light: photons per pixel and frame, float32."""
    import numpy as np

    from napari_mufasa import files
    from napari_mufasa.denoise.pipeline import denoised, measured_camera
    from napari_mufasa.model.model import Model

    if (model is None) == (dark is None):
        raise MufasaError(
            "give --model MODEL.json, which holds the camera, or --dark DARK, frames without light to measure it on"
        )
    if camera_type is not None and dark is None:
        raise MufasaError("--type goes with --dark: a model says itself of which type its camera is")
    console.check_movie_out(out, overwrite)
    console.check_not_read(out, movie, model, dark)
    believed = None if model is None else Model.from_json(model)
    background, read = console.dark_frames(dark), files.read_movie(movie).recorded()
    read, believed, background = registering.one_channel(channel, read, believed, background)
    recorded = read.data
    console.check_room(out, 4 * math.prod(recorded.shape))
    if believed is not None:
        console.tell_disagreement(read, believed)
    with console.working("denoising", scheduler) as work:
        if believed is not None:
            camera = believed.camera
        else:
            camera = measured_camera(recorded, background, work.cancel, camera_type)

        def blocks(first: int) -> Iterator[tuple[int, Any]]:
            yield from denoised(recorded, camera, method=method, first=first, **work.all())

        made_from = {"denoise": method, "camera": camera.model_dump(mode="json"), **files.signature(movie)}
        made_from |= {} if channel is None else {"channel": channel}
        files.write_movie(
            out, blocks, recorded.shape, np.float32, model=believed, role=files.PHOTONS,
            pixel_size_nm=read.pixel_size_nm if believed is None else None, resume=made_from if resume else None,
        )  # fmt: skip
    if believed is None:
        typer.echo(_camera_measured(camera))
        if camera_type is None:
            typer.echo(f"{camera.type} taken: if that is wrong, say --type CCD, CMOS or EMCCD (light differs by 2)")
    n_frames, height, width = recorded.shape
    typer.echo(f"{out}: {counted(n_frames, 'frame')} of {height} × {width} px, photons per pixel and frame")


def _camera_measured(camera: Camera) -> str:
    per_electron = (camera.em_gain or 1.0) / camera.electrons_per_adu
    return (
        f"camera measured: baseline {camera.baseline_adu:.4g} ADU, {per_electron:.4g} ADU per photoelectron, "
        f"quantum efficiency {camera.quantum_efficiency:g} assumed"
    )


def traces(
    movie: MovieFile,
    model: ModelFile,
    out: OutFolder,
    dark: DarkFile = None,
    window: Window = None,
    best: Best = None,
    max_steps: MaxSteps = None,
    min_steps: Annotated[
        int | None, typer.Option("--min-steps", min=0, metavar="N", help="At least N bleaching steps.")
    ] = None,
    follow_drift: FollowDrift = False,
    follow_molecules: FollowMolecules = False,
    max_step: MaxStep = None,
    max_gap: MaxGap = None,
    profile: Annotated[
        ProfileName, typer.Option("--profile", help="The whole spot (psf), a disc (sum), or one pixel.")
    ] = "psf",
    with_background: Annotated[
        bool, typer.Option("--with-background", help="Leave the local background in the traces.")
    ] = False,
    threshold: Annotated[
        ThresholdName, typer.Option("--threshold", help="How candidates are told from noise.")
    ] = "sigma",
    threshold_value: Annotated[
        float | None, typer.Option("--threshold-value", metavar="V", help="Noise sd (6) or percentile (98).")
    ] = None,
    min_snr: Annotated[float, typer.Option("--min-snr", min=0, metavar="R", help="Level over noise per frame.")] = 1.0,
    hdf5: Annotated[bool, typer.Option("--hdf5", help="Also write traces.h5, traces and table in one file.")] = False,
    openfret: Annotated[bool, typer.Option("--openfret", help="Also write traces.openfret.json.")] = False,
    channel: Channel = None,
    channels: ChannelsFile = None,
    find_in: FindIn = None,
    leakage: Leakage = 0.0,
    direct_excitation: DirectExcitation = 0.0,
    gamma: Gamma = 1.0,
    acceptor_sigma: AcceptorSigma = None,
    scheduler: Scheduler = None,
    overwrite: Overwrite = False,
) -> None:
    """Find the molecules and write their traces, all candidates with reasons, and a figure."""
    from napari_mufasa import files
    from napari_mufasa.files.outputs import PAIR, REGISTRATION, TRACES
    from napari_mufasa.model.model import Model
    from napari_mufasa.provenance import provenance
    from napari_mufasa.report import figures
    from napari_mufasa.traces import extract_traces
    from napari_mufasa.traces.table import write_traces

    console.check_folder_out(out, overwrite, (*TRACES, *PAIR, REGISTRATION), movie, model, dark, channels)
    options = {
        "window": window, "best": best, "max_steps": max_steps, "min_steps": min_steps, "follow_drift": follow_drift,
        "profile": profile, "subtract_background": not with_background, "threshold": threshold,
        "threshold_value": threshold_value, "min_snr": min_snr, **_following(follow_molecules, max_step, max_gap),
    }  # fmt: skip
    of_two = registering.pair_options(channels, find_in, leakage, direct_excitation, gamma, acceptor_sigma)
    if channels is not None:
        if channel is not None:
            raise MufasaError("--channel reads one channel, --channels two: give one of them")
        if scheduler is not None:
            raise MufasaError("--scheduler: two channels are read on this machine alone; drop it, or --channels")
        registering.pair_traces(movie, model, dark, channels, out, options | of_two, hdf5, openfret)
        return
    believed, read = Model.from_json(model), files.read_movie(movie)
    background = console.dark_frames(dark, read)
    read, believed, background = registering.one_channel(channel, read, believed, background)
    recorded = read.data
    console.tell_disagreement(read, believed, background)
    with console.working("traces", scheduler) as work:
        found = extract_traces(
            recorded,
            believed.camera,
            background,
            psf_sigma_px=believed.sigma_px,
            unit=read.unit,
            **options,
            **work.all(),
        )
    made = provenance(believed, None, (movie, model, dark))
    with files.filling(out, (*TRACES, *PAIR)) as folder:
        write_traces(folder, found, hdf5=hdf5, openfret=openfret, acquisition=believed.acquisition, made=made)
        figures.write(folder, figures.molecule_drawings(recorded, found))
    console.tell_molecules(out, found)


def _following(molecules: bool, max_step: float | None, max_gap: int | None) -> dict[str, Any]:
    given = {name: v for name, v in (("max_step_px", max_step), ("max_gap", max_gap)) if v is not None}
    if given and not molecules:
        raise MufasaError("--max-step and --max-gap belong to molecules that are followed: add --follow-molecules")
    return {"follow_molecules": molecules, **given}


def compare(
    model: ModelFile,
    out: OutFolder,
    movie: Annotated[Path | None, typer.Argument(metavar="[MOVIE]", help="A movie, or --traces instead.")] = None,
    traces: Annotated[
        Path | None, typer.Option("--traces", metavar="FILE", help="CSV, TIFF, HDF5, OpenFRET .json or .traces.")
    ] = None,
    dark: DarkFile = None,
    unit: TraceUnit = None,
    profile: TraceProfile = None,
    with_background: TraceBackground = None,
    window: Window = None,
    best: Best = None,
    max_steps: MaxSteps = None,
    follow_drift: FollowDrift = False,
    sofi_times: Annotated[
        TimesName, typer.Option("--sofi-times", help="On, off and bleaching times of SOFI: the model's or the tool's.")
    ] = "model",
    seed: Seed = 0,
    overwrite: Overwrite = False,
) -> None:
    """Measure the distance W1 between measurement and model, with baselines and floor."""
    from napari_mufasa import compare as comparing
    from napari_mufasa import files
    from napari_mufasa.files.outputs import COMPARISON
    from napari_mufasa.model.model import Model
    from napari_mufasa.report import figures

    _check_what_is_compared(movie, traces, dark, unit, max_steps, follow_drift)
    console.check_folder_out(out, overwrite, COMPARISON, movie or traces, model, dark)
    believed = Model.from_json(model)
    shared: dict[str, Any] = {"window": window, "best": best, "seed": seed, "sofi_times": sofi_times}
    if movie is not None:
        read, background = files.read_movie(movie).recorded(), console.dark_frames(dark)
        console.tell_disagreement(read, believed, background)
        with console.working("comparing") as work:
            result = comparing.compare_movie(
                read.data, believed, background, max_steps=max_steps, follow_drift=follow_drift,
                profile=profile or "psf", subtract_background=not with_background, **shared, **work.both(),
            )  # fmt: skip
    else:
        table = files.traces.read_trace_file(traces or Path(), unit=unit)
        without = None if with_background is None else not with_background
        with console.working("comparing") as work:
            result = comparing.compare_traces(
                table, believed, profile=profile, background_subtracted=without, **shared, **work.both()
            )
    with console.filling(out, COMPARISON, believed, seed, (movie or traces, model, dark)) as folder:
        files.write_json(folder / "report.json", result.report())
        figures.write(folder, figures.comparison_drawings(result))
    from napari_mufasa.report.lines import w1_rows

    console.print_table(("W1", f"{result.w1['unit']} [95 %]"), w1_rows(result))
    for note in result.notes:
        typer.echo(f"note: {note}")


def _check_what_is_compared(
    movie: Path | None, traces: Path | None, dark: Path | None, unit: str | None, max_steps: int | None, drift: bool
) -> None:
    if (movie is None) == (traces is None):
        raise MufasaError("give either a MOVIE or --traces FILE")
    if movie is not None and unit is not None:
        raise MufasaError("--unit belongs to --traces; a movie is in ADU: drop it")
    if traces is not None and dark is not None:
        raise MufasaError("--dark belongs to a movie; traces have their background taken off or not: drop it")
    if traces is not None and (max_steps is not None or drift):
        raise MufasaError("--max-steps and --follow-drift choose molecules in a movie; give one, or drop them")


VERBS = (denoise, traces, compare)
