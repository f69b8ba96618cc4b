"""What can be done to a movie of a batch: each step writes into a folder and tells its numbers (docs/batches.md)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_mufasa import files
from napari_mufasa.files.outputs import COMPARISON, DENOISED, DIAGNOSIS, TRACES

if TYPE_CHECKING:
    from napari_mufasa.batch.settings import Settings
    from napari_mufasa.model.model import Model

Told = dict[str, Any]


def denoise(folder: Path, movie: files.Movie, model: Model, dark: Any, settings: Settings, **work: Any) -> Told:
    from napari_mufasa.denoise.pipeline import denoised

    blocks = (block for _, block in denoised(movie.data, model.camera, method=settings.method, **work))
    shape, role = movie.data.shape, files.PHOTONS
    files.write_movie(folder / "denoised.ome.tif", blocks, shape, np.float32, model=model, role=role)
    return {}


def traces(folder: Path, movie: files.Movie, model: Model, dark: Any, settings: Settings, **work: Any) -> Told:
    from napari_mufasa.report import figures
    from napari_mufasa.traces import extract_traces
    from napari_mufasa.traces.table import write_traces

    found = extract_traces(
        movie.data, model.camera, dark, psf_sigma_px=model.sigma_px, follow_drift=settings.follow_drift,
        follow_molecules=settings.follow_molecules, **work,
    )  # fmt: skip
    write_traces(folder, found)
    figures.write(folder, figures.molecule_drawings(movie.data, found))
    kept = found.molecules[found.kept]
    told: Told = {"molecules": len(kept), "candidates": len(found.molecules)}
    columns = {"brightness": "brightness_e", "snr": "snr", "diffusion_px2_per_frame": "diffusion_px2_per_frame"}
    told |= {name: float(kept[column].median()) for column, name in columns.items() if column in kept and len(kept)}
    if len(kept):
        told["bleached_share"] = float((kept["bleaching_frame"] >= 0).mean())
    return told


def compare(folder: Path, movie: files.Movie, model: Model, dark: Any, settings: Settings, **work: Any) -> Told:
    from napari_mufasa.compare import compare_movie
    from napari_mufasa.report import figures

    result = compare_movie(movie.data, model, dark, seed=settings.seed, follow_drift=settings.follow_drift, **work)
    files.write_json(folder / "report.json", result.report())
    figures.write(folder, figures.comparison_drawings(result))
    w1 = result.w1
    return {"w1": w1["mufasa"], "w1_fitted": w1.get("fitted"), "w1_floor": w1["floor"], "w1_unit": str(w1["unit"])}


def diagnose(folder: Path, movie: files.Movie, model: Model, dark: Any, settings: Settings, **work: Any) -> Told:
    from napari_mufasa import discover
    from napari_mufasa.report import figures
    from napari_mufasa.report import html as html_report

    report = discover.diagnose(
        movie.data, model, dark, seed=settings.seed, effects=settings.effects, budget=settings.budget, **work
    )
    n_frames, height, width = movie.data.shape
    subtitle = f"{movie.path.name}: {n_frames} frames of {height} × {width} px"
    html_report.export(folder, report, figures.traces_to_show(movie.data, report.base, dark), subtitle)
    by_kind = {candidate.effect: candidate for candidate in report.ranking}
    effects = [
        {
            "effect": kind,
            "p_value": c.p_value,
            "evidence": c.evidence,
            "parameters": c.parameters,
            "sd": c.parameters_sd,
        }
        for kind in report.chosen
        if (c := by_kind.get(kind)) is not None
    ]
    error = report.error
    return {
        "verdict": report.verdict, "effects": effects, "error_before": error["before"], "error_after": error["after"],
        "error_floor": error["floor"], "explained": report.explained, "report": "report.html",
        "brightest_misfit": [row["observable"] for row in report.failing[:3]],
    }  # fmt: skip


STEPS: Mapping[str, Callable[..., Told]] = {
    "denoise": denoise, "traces": traces, "compare": compare, "diagnose": diagnose,
}  # fmt: skip
#: What each writes, as patterns.
WRITTEN: Mapping[str, tuple[str, ...]] = {
    "denoise": DENOISED, "traces": TRACES, "compare": COMPARISON, "diagnose": DIAGNOSIS,
}  # fmt: skip
