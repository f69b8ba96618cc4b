"""The demonstration: an effect is hidden in an acquisition, and found again from the files alone.

`prepare` is the one who hides (`samples.hide`): it leaves movie, dark frames and the model a user would believe in; the
truth goes into a sealed envelope. `investigate` is the user: it reads those three files and
nothing else. `open_envelope` compares.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_mufasa import files
from napari_mufasa.errors import Cancelled
from napari_mufasa.files.outputs import DIAGNOSIS

if TYPE_CHECKING:
    from napari_mufasa.discover.result import Report
    from napari_mufasa.model.model import Model

Progress = Callable[[int, int], None]
Cancel = Callable[[], bool]
Say = Callable[[str], Any]

#: What it writes into its folder, as patterns.
WRITTEN = ("*.ome.tif", "*.json", "*.csv", "*.png", "diagnosis")

#: What the demonstration may hide: effects of molecules, light and motion.
KINDS = (
    "triplet_blinking", "photobleaching", "delayed_activation", "brightness_heterogeneity", "laser_drift",
    "laser_flicker", "periodic_modulation", "stage_drift", "focus_drift", "molecule_diffusion",
)  # fmt: skip


def run(
    directory: Path, seed: int = 1, say: Say = print, progress: Progress | None = None, cancel: Cancel | None = None
) -> Report:
    """The whole demonstration into `directory`; says what it does and finds, line by line."""
    directory.mkdir(parents=True, exist_ok=True)
    prepare(directory, seed)
    say(f"An effect, drawn by seed {seed}, is hidden in {directory / 'movie.ome.tif'}; the truth is sealed.")
    report = investigate(directory, say, progress, cancel)
    say("")
    for line in open_envelope(directory, report):
        say(line)
    return report


def prepare(directory: Path, seed: int) -> None:
    """Hide an effect: movie.ome.tif, dark.ome.tif and model.json for the user, envelope.json for later."""
    from napari_mufasa import samples
    from napari_mufasa.model.model import Model

    believed = Model.from_dict(samples.BELIEVED)
    puzzle = samples.hide(believed, KINDS, np.random.default_rng([seed, 0xDE30]))
    # The metadata hold what the user believes: the diagnosis must not find the answer there.
    for name, stack in (("movie.ome.tif", puzzle.movie), ("dark.ome.tif", puzzle.dark)):
        files.write_movie(directory / name, [stack], stack.shape, stack.dtype, model=believed)
    believed.to_json(directory / "model.json")
    effect = puzzle.truth.effects[0]
    files.write_json(
        directory / "envelope.json", {"seed": seed, "effect": effect.model_dump(), "model": puzzle.truth.to_dict()}
    )


def investigate(
    directory: Path, say: Say = print, progress: Progress | None = None, cancel: Cancel | None = None
) -> Report:
    """The user's part, from movie.ome.tif, dark.ome.tif and model.json alone; writes directory/diagnosis."""
    from napari_mufasa import discover
    from napari_mufasa.compare import compare_movie
    from napari_mufasa.denoise.pipeline import denoise
    from napari_mufasa.model.model import Model
    from napari_mufasa.report import figures
    from napari_mufasa.report import html as html_report
    from napari_mufasa.report.words import summary
    from napari_mufasa.traces import extract_traces
    from napari_mufasa.traces.table import write_traces

    model = Model.from_json(directory / "model.json")
    movie, dark = files.load(directory / "movie.ome.tif"), files.load(directory / "dark.ome.tif")
    n_frames, height, width = movie.shape
    say(f"Movie: {n_frames} frames of {height} × {width} px; dark: {len(dark)} frames.")

    photons = denoise(movie, model.camera, cancel=cancel)
    _write(directory / "denoised.ome.tif", photons, model)
    say(f"Denoised: {photons.mean():.2f} photons per pixel and frame on average.")

    traces = extract_traces(movie, model.camera, dark, psf_sigma_px=model.sigma_px, cancel=cancel)
    write_traces(directory, traces)
    say(f"Traces: {len(traces.traces)} molecules kept of {len(traces.molecules)} candidates.")

    before = compare_movie(movie, model, dark, fit=False, cancel=cancel)
    say(f"Distance W1 to the believed model: {_w1(before)}; floor {before.w1['floor']:.3g} {before.w1['unit']}.")
    _stop_if(cancel)

    say("Diagnosing …")
    report = discover.diagnose(movie, model, dark, progress=progress, cancel=cancel)
    folder = directory / "diagnosis"
    with files.filling(folder, DIAGNOSIS) as filled:
        html_report.export(filled, report, traces.traces, f"{n_frames} frames of {height} × {width} px")
    for line in summary(report):
        say(line)
    error = report.error
    say(
        f"Error on held-out data: before {error['before']:.2f}, after {error['after']:.2f}, floor {error['floor']:.2f}."
    )

    after = compare_movie(movie, report.model, dark, fit=False, cancel=cancel)
    say(f"Distance W1 to the completed model: {_w1(after)}.")
    pictures = [*figures.comparison_drawings(after), figures.movie_drawing("movie", movie, "ADU")]
    pictures.append(figures.movie_drawing("denoised", photons, "photons"))
    for drawing in pictures:
        files.write_bytes(directory / f"{drawing.name}.png", drawing.render("light"))
    say(f"Report: {folder / 'report.html'}")
    return report


def open_envelope(directory: Path, report: Report) -> list[str]:
    """What was hidden, and whether the verdict named it."""
    from napari_mufasa.report.words import effect_title, number

    effect = files.read_json(directory / "envelope.json")["effect"]
    kind = effect.pop("kind")
    values = ", ".join(f"{k} = {number(v) if isinstance(v, float) else v}" for k, v in effect.items())
    lines = [f"The envelope: {effect_title(kind)} ({kind}: {values})."]
    if kind in report.chosen:
        others = [other for other in report.chosen if other != kind]
        lines.append("The verdict named it" + (f", and also {', '.join(others)}." if others else "."))
    elif any(kind in candidate.indistinguishable_from for candidate in report.ranking[:1]):
        lines.append("The verdict named another effect and said that the two cannot be told apart.")
    else:
        lines.append(f"The verdict did not name it (verdict: {report.verdict}; named: {report.chosen or 'nothing'}).")
    return lines


def open_viewer(directory: Path) -> None:
    """napari with the workflow, the movie and its dark frames, its denoised form and the molecules; returns when the
    window is closed."""
    import napari
    import pandas as pd

    from napari_mufasa.files.layers import movie_layer
    from napari_mufasa.widgets.turns.session import session_of

    viewer = napari.Viewer(title="napari-mufasa demo")
    viewer.window.add_plugin_dock_widget("napari-mufasa", "MUFASA workflow")
    dark, dark_options, _ = movie_layer(directory / "dark.ome.tif")
    data, options, _ = movie_layer(directory / "movie.ome.tif")
    space = {name: options[name] for name in ("scale", "units", "axis_labels") if name in options}
    ours = {files.METADATA_KEY: {"role": "dark frames"}}
    viewer.add_image(dark, **(dark_options | space | {"visible": False, "metadata": ours}))
    movie = viewer.add_image(data, **options)
    photons, photons_options, _ = movie_layer(directory / "denoised.ome.tif")
    viewer.add_image(photons, **(photons_options | space | {"visible": False}))
    table = pd.read_csv(directory / "molecules.csv")
    kept = table[table["kept"]].reset_index(drop=True)
    viewer.add_points(
        kept[["y_px", "x_px"]].to_numpy(), name="molecules", scale=movie.scale[-2:], units=movie.units[-2:], size=6,
        features=kept, face_color="transparent", border_color="cyan", border_width=0.07,
    )  # fmt: skip
    session = session_of(viewer)
    session.set_movie(movie)
    session.set_dark(viewer.layers[0])
    model = Model.stored_in(files.read_movie(directory / "movie.ome.tif").metadata)
    if model is not None:
        session.set_model(model, f"metadata of {movie.name}")
    viewer.dims.set_point(0, 0)
    napari.run()


def _write(path: Path, photons: np.ndarray[Any, Any], model: Model) -> None:
    files.write_movie(path, [photons], photons.shape, photons.dtype, model=model, role=files.PHOTONS)


def _w1(comparison: Any) -> str:
    value = comparison.w1["mufasa"]
    return "unknown (no molecule in the simulated movie)" if value is None else f"{value:.3g}"


def _stop_if(cancel: Cancel | None) -> None:
    if cancel is not None and cancel():
        raise Cancelled
