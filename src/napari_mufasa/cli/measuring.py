"""Verbs that start from a movie and a camera: denoise, traces, compare, calibrate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from napari_mufasa.cli import console
from napari_mufasa.cli.making import ModelFile, Seed
from napari_mufasa.errors import MufasaError

if TYPE_CHECKING:
    from napari_mufasa.calibrate.measure import Value
    from napari_mufasa.report.figures import Drawing

MovieFile = Annotated[Path, typer.Argument(metavar="MOVIE", help="TIFF, OME-TIFF or zarr, (frame, y, x).")]
DarkFile = Annotated[Path | None, typer.Option("--dark", metavar="DARK", help="Frames without light.")]
OutFolder = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to write into.")]
Window = Annotated[
    int | None, typer.Option("--window", min=1, metavar="N", help="Keep N frames just before each bleaching.")
]
Best = Annotated[int | None, typer.Option("--best", min=1, metavar="N", help="Keep the N best molecules.")]
MaxSteps = Annotated[
    int | None, typer.Option("--max-steps", min=0, metavar="N", help="At most N bleaching steps (1: single molecules).")
]
FollowDrift = Annotated[bool, typer.Option("--follow-drift", help="Let positions follow the motion of the field.")]
IN_MEMORY_BYTES = 2**30


class CameraName(StrEnum):
    CCD = "CCD"
    EMCCD = "EMCCD"
    CMOS = "CMOS"


class UnitName(StrEnum):
    photoelectrons = "photoelectrons"
    photons = "photons"
    adu = "adu"


class ProfileName(StrEnum):
    psf = "psf"
    sum = "sum"
    brightest_pixel = "brightest_pixel"


TraceUnit = Annotated[UnitName | None, typer.Option("--unit", help="Of the traces; default: as the file says.")]
TraceProfile = Annotated[
    ProfileName | None, typer.Option("--profile", help="What each trace holds; default: psf, TIFF: brightest_pixel")
]
TraceBackground = Annotated[
    bool | None,
    typer.Option(
        "--with-background/--without-background", help="Is the background in the traces? Default: in a TIFF only."
    ),
]


class TimesName(StrEnum):
    model = "model"
    tool = "tool"


class ThresholdName(StrEnum):
    sigma = "sigma"
    percentile = "percentile"
    otsu = "otsu"
    triangle = "triangle"


def denoise(
    movie: MovieFile,
    out: Annotated[Path, typer.Option("--out", metavar="OUT", help="OUT.tif or OUT.zarr.")],
    model: Annotated[Path | None, typer.Option("--model", metavar="MODEL.json", help="With the camera.")] = None,
    dark: Annotated[
        Path | None,
        typer.Option("--dark", metavar="DARK", help="Or frames without light: an EMCCD is measured on the data."),
    ] = None,
    method: Annotated[str | None, typer.Option("--method", metavar="NAME", help="Default: the best one.")] = None,
) -> None:
    """Estimate the light: photons per pixel and frame, float32."""
    import numpy as np

    from napari_mufasa import files
    from napari_mufasa.denoise.pipeline import denoise as run
    from napari_mufasa.denoise.pipeline import measured_camera
    from napari_mufasa.model.model import Model

    if (model is None) == (dark is None):
        raise MufasaError(
            "give --model MODEL.json, which holds the camera, or --dark DARK, frames without light to measure it on"
        )
    console.check_movie_out(out)
    believed = None if model is None else Model.from_json(model)
    source = files.read_movie(movie)
    n_frames, height, width = source.data.shape
    options: dict[str, Any] = {} if method is None else {"method": method}
    size_nm = None if believed is None else believed.acquisition.pixel_size_nm
    in_memory = 4 * n_frames * height * width <= IN_MEMORY_BYTES
    with console.scratch(out, (n_frames, height, width), np.float32, in_memory=in_memory) as result:
        with console.working("denoising") as work:
            if believed is not None:
                camera = believed.camera
            else:
                camera = measured_camera(source.data, None if dark is None else files.load(dark), work.cancel)
            run(source.data, camera, out=result, **options, **work.both())
        blocks = (result[start : start + 64] for start in range(0, n_frames, 64))
        files.write_movie(out, blocks, (n_frames, height, width), np.float32, pixel_size_nm=size_nm)
    if believed is None:
        per_electron = (camera.em_gain or 1.0) / camera.electrons_per_adu
        typer.echo(
            f"camera measured: baseline {camera.baseline_adu:.4g} ADU, {per_electron:.4g} ADU per photoelectron, "
            f"quantum efficiency {camera.quantum_efficiency:g} assumed"
        )
    typer.echo(f"{out}: {n_frames} frames of {height} × {width} px, photons per pixel and frame")


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
    profile: Annotated[
        ProfileName, typer.Option("--profile", help="The whole spot (psf), a disc (sum), or one pixel.")
    ] = ProfileName.psf,
    with_background: Annotated[
        bool, typer.Option("--with-background", help="Leave the local background in the traces.")
    ] = False,
    threshold: Annotated[ThresholdName, typer.Option("--threshold", help="How candidates are told from noise.")] = (
        ThresholdName.sigma
    ),
    threshold_value: Annotated[
        float | None, typer.Option("--threshold-value", metavar="V", help="Noise sd (6) or percentile (98).")
    ] = None,
    min_snr: Annotated[float, typer.Option("--min-snr", min=0, metavar="R", help="Level over noise per frame.")] = 1.0,
    hdf5: Annotated[bool, typer.Option("--hdf5", help="Also write traces.h5, traces and table in one file.")] = False,
) -> None:
    """Find the molecules and write their traces, all candidates with reasons, and a figure."""
    from napari_mufasa import files
    from napari_mufasa.model.model import Model
    from napari_mufasa.report import figures
    from napari_mufasa.report import plots as plotting
    from napari_mufasa.traces import extract_traces
    from napari_mufasa.traces.table import write_traces

    console.check_folder_out(out)
    believed = Model.from_json(model)
    source = files.read_movie(movie)
    background = None if dark is None else files.load(dark)
    with console.working("traces") as work:
        found = extract_traces(
            source.data, believed.camera, background, psf_sigma_px=believed.sigma_px, window=window, best=best,
            max_steps=max_steps, min_steps=min_steps, follow_drift=follow_drift, profile=profile.value,
            subtract_background=not with_background, threshold=threshold.value, threshold_value=threshold_value,
            min_snr=min_snr, **work.both(),
        )  # fmt: skip
    picture = figures.mean_image(source.data)
    kept = found.molecules["molecule"][found.kept].tolist()
    drawings = [
        figures.Drawing(
            "molecules", "", (5.4, 5.0), lambda f: plotting.molecules(f.add_subplot(), picture, found.molecules)
        ),
        figures.Drawing("traces", "", (7.2, 6.2), lambda f: plotting.contact_sheet(f, found.traces, kept, most=24)),
    ]
    with console.folder(out) as folder:
        write_traces(folder, found, hdf5=hdf5)
        write_figures(folder, drawings)
    typer.echo(f"{out}: {len(kept)} molecules kept of {len(found.molecules)} candidates")
    reasons = found.molecules["reason"][~found.kept].str.replace(r"[\d.]+", "…", regex=True)
    for reason, count in reasons.value_counts().head(6).items():
        typer.echo(f"  {count} × {reason}")
    for note in found.notes:
        typer.echo(f"note: {note} (--follow-drift)")


def compare(
    model: ModelFile,
    out: OutFolder,
    movie: Annotated[Path | None, typer.Argument(metavar="[MOVIE]", help="A movie, or --traces instead.")] = None,
    traces: Annotated[Path | None, typer.Option("--traces", metavar="FILE", help="CSV, TIFF, HDF5 or .traces.")] = None,
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
    ] = TimesName.model,
    seed: Seed = 0,
) -> None:
    """Measure the distance W1 between measurement and model, with baselines and floor."""
    from napari_mufasa import compare as comparing
    from napari_mufasa import files
    from napari_mufasa.model.model import Model
    from napari_mufasa.report import figures

    if (movie is None) == (traces is None):
        raise MufasaError("give either a MOVIE or --traces FILE")
    console.check_folder_out(out)
    believed = Model.from_json(model)
    shared: dict[str, Any] = {"window": window, "best": best, "seed": seed, "sofi_times": sofi_times.value}
    if movie is not None:
        if unit is not None:
            raise MufasaError("--unit belongs to --traces; a movie is in ADU")
        recorded = files.load(movie)
        background = None if dark is None else files.load(dark)
        with console.working("comparing") as work:
            result = comparing.compare_movie(
                recorded, believed, background, max_steps=max_steps, follow_drift=follow_drift,
                profile=profile.value if profile else "psf", subtract_background=not with_background, **shared,
                **work.both(),
            )  # fmt: skip
    else:
        if dark is not None:
            raise MufasaError("--dark belongs to a movie; traces have their background taken off or not")
        if max_steps is not None or follow_drift:
            raise MufasaError("--max-steps and --follow-drift choose molecules in a movie; give one, or drop them")
        table = trace_table(traces or Path(), unit, profile, with_background)
        with console.working("comparing") as work:
            result = comparing.compare_traces(**table, model=believed, **shared, **work.both())
    with console.folder(out) as folder:
        files.write_json(folder / "report.json", result.report())
        write_figures(folder, figures.comparison_drawings(result))
    rows = [(name, value) for name, value in result.w1.items() if name != "unit"]
    console.print_table(("W1", str(result.w1["unit"])), rows)
    for note in result.notes:
        typer.echo(f"note: {note}")


def trace_table(
    path: Path, unit: UnitName | None, profile: ProfileName | None, with_background: bool | None
) -> dict[str, Any]:
    """The traces of a file and what they hold, as keywords; a TIFF in ADU holds brightest pixels with background."""
    from napari_mufasa.files import traces as trace_files

    values, found_unit = trace_files.read_traces(path)
    raw = found_unit == "adu" and path.suffix.lower() in (".tif", ".tiff")
    return {
        "traces": values,
        "unit": unit.value if unit else found_unit,
        "profile": profile.value if profile else ("brightest_pixel" if raw else "psf"),
        "background_subtracted": not (raw if with_background is None else with_background),
    }


def calibrate(
    movie: MovieFile,
    out: Annotated[Path, typer.Option("--out", metavar="camera.json", help="The camera part of a model.json.")],
    dark: DarkFile = None,
    camera_type: Annotated[CameraName, typer.Option("--type", help="Of the camera.")] = CameraName.EMCCD,
    em_gain: Annotated[float | None, typer.Option("--em-gain", min=1, metavar="G", help="If known.")] = None,
    electrons_per_adu: Annotated[
        float | None, typer.Option("--electrons-per-adu", min=1e-6, metavar="E", help="If known.")
    ] = None,
    baseline_adu: Annotated[
        float | None, typer.Option("--baseline-adu", min=0, metavar="B", help="If known, instead of dark frames.")
    ] = None,
    quantum_efficiency: Annotated[float, typer.Option("--quantum-efficiency", min=0.01, max=1, metavar="QE")] = 0.9,
) -> None:
    """Measure the camera: baseline, read noise and gain, from a movie and its dark frames."""
    from napari_mufasa import files
    from napari_mufasa.calibrate.measure import calibrate as measure

    console.check_file_out(out)
    source = files.read_movie(movie)
    background = None if dark is None else files.load(dark)
    with console.working("calibrating") as work:
        found = measure(
            source.data, background, camera_type=camera_type.value, em_gain=em_gain,
            electrons_per_adu=electrons_per_adu, quantum_efficiency=quantum_efficiency, baseline_adu=baseline_adu,
            **work.both(),
        )  # fmt: skip
    section = found.camera.model_dump(mode="json", exclude_none=True)
    if found.camera.type != "CMOS":
        section.pop("cmos_gain_curve")
    files.write_json(out, section)
    console.print_table(
        ("measured", "value ± sd"),
        [
            ("baseline (ADU)", _measured(found.baseline_adu)),
            ("read noise (ADU)", _measured(found.read_noise_adu)),
            ("ADU per photoelectron", _measured(found.adu_per_photoelectron)),
            ("clock-induced charge (e/px/frame)", _measured(found.clock_induced_charge_e)),
        ],
    )
    for note in found.notes:
        typer.echo(f"note: {note}")
    typer.echo(f"{out}: the camera part of a model.json")


def _measured(found: Value) -> str:
    if not math.isfinite(found.value):
        return "unknown"
    return str(found) if math.isfinite(found.sd) else f"{found.value:.4g} (given)"


def write_figures(folder: Path, drawings: Sequence[Drawing]) -> None:
    for drawing in drawings:
        (folder / f"{drawing.name}.png").write_bytes(drawing.render("light"))


VERBS = (denoise, traces, compare, calibrate)
