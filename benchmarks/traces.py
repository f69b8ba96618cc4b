"""Molecules and traces against what is known of them: independent movies, real movies, the camera measured on them.

    python -m benchmarks.traces [--only WORD ...] [--write]

Prints tables in Markdown; ``--write`` puts them into docs/traces.md between its two marks. A section whose real
measurements are not beside the project says so and is left out.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from tests.blind import generator

import napari_mufasa as nm
from benchmarks.pages import DOCS, header, row, write
from benchmarks.scenes import REAL_DATA
from napari_mufasa import files
from napari_mufasa.calibrate.measure import calibrate
from napari_mufasa.traces import extract_traces
from napari_mufasa.traces.steps import idealise

NEAR_PX, APART_PX = 1.5, 5.0


def near(found: Any, truth: Any) -> tuple[Any, Any, Any]:
    """Pairs (found, truth) nearer than `NEAR_PX`, and their distances."""
    distance = np.hypot(*(found[:, None] - truth[None]).transpose(2, 0, 1))
    rows, columns = linear_sum_assignment(np.minimum(distance, 100.0))
    close = distance[rows, columns] < NEAR_PX
    return rows[close], columns[close], distance[rows, columns][close]


def judged(found: Any, truth: Any, side: int) -> list[object]:
    """Candidates, kept, false ones, recall of isolated molecules in %, rms position error in px."""
    _, columns, distance = near(found.positions_px[found.kept], truth)
    inside = np.all((truth > 1.5) & (truth < side - 1.5), axis=1)
    isolated = np.flatnonzero(inside & (cKDTree(truth).query(truth, k=2)[0][:, 1] > APART_PX))
    recall = 100 * np.isin(isolated, columns).mean()
    rms = float(np.sqrt(np.mean(distance**2)))
    kept = int(found.kept.sum())
    return [len(truth), len(found.molecules), kept, kept - len(distance), f"{recall:.0f}", rms]


def molecules_table() -> list[str]:
    """Independent movies (`tests/blind`) of 96 x 96 pixels, and molecules thrown at random onto 128 x 128."""
    out = header("movie", "molecules", "candidates", "kept", "false", "isolated ones kept %", "position error, px rms")
    for name, effects, seed in (
        ("always on", [], 10),
        ("bleaching", [("photobleaching", 0.5)], 11),
        ("long dark states", [("long_dark_state", 0.5)], 12),
    ):
        case = generator.make(generator.base_model("emccd"), seed=seed, n_molecules=92, effects=effects)
        model = nm.Model.from_dict(case.believed)
        found = extract_traces(case.movie, model.camera, case.dark, psf_sigma_px=model.sigma_px)
        out.append(row(name, *judged(found, np.array(case.truth["positions_px"]), 96)))
    model = nm.Model.from_dict(generator.base_model("emccd")).with_values(
        {"acquisition.shape_px": (128, 128), "fluorophore.cycles_before_bleaching": 1e5}
    )
    for seed in (5, 6):
        truth = np.random.default_rng(seed).uniform(-0.5, 127.5, (164, 2))
        movie = nm.simulate(model, truth, seed=seed).movie
        found = extract_traces(movie, model.camera, psf_sigma_px=model.sigma_px)
        out.append(row(f"scattered, overlapping, seed {seed}", *judged(found, truth, 128)))
    words = f"Kept within {NEAR_PX} px of a molecule or false; isolated: no neighbour within {APART_PX:g} px."
    return [*out, "", words]


def moving_table() -> list[str]:
    """A field that moves, with and without following it."""
    out = header("motion", "candidates", "kept", "position error, px rms", "candidates, followed", "kept",
                 "position error, px rms")  # fmt: skip
    cases: list[tuple[str, list[tuple[str, float]], int, int | None]] = [
        ("none", [], 4, None),
        *((f"stage drift of 2 px, {words}", [("stage_drift", 0.5)], 4, form) for form, words in enumerate(MOTIONS)),
        *((f"stage drift of 4 px, {words}", [("stage_drift", 1.0)], 4, form) for form, words in enumerate(MOTIONS)),
    ]
    for name, effects, seed, form in cases:
        case = generator.make(
            generator.base_model("emccd"), seed=seed, n_molecules=70, effects=effects, form=form if effects else None
        )
        model, truth = nm.Model.from_dict(case.believed), np.array(case.truth["positions_px"])
        cells: list[object] = []
        for follow in (False, True):
            found = extract_traces(
                case.movie, model.camera, case.dark, psf_sigma_px=model.sigma_px, follow_drift=follow
            )
            distance = near(found.positions_px[found.kept], truth)[2]
            rms = float(np.sqrt(np.mean(distance**2))) if len(distance) > 4 else float("nan")
            cells += [len(found.molecules), int(found.kept.sum()), rms]
        out.append(row(name, *cells))
    return [
        *out,
        "",
        "70 molecules on 96 x 96 pixels; error of the kept within 1.5 px of a molecule's place at the first frame.",
    ]


MOTIONS = generator.forms("stage_drift")


def steps_table() -> list[str]:
    """Traces without any step that are split, in % (1 is stated)."""
    rng = np.random.default_rng(2)
    out = header("noise", "split %")
    draws: dict[str, Any] = {"normal": rng.normal(size=(4000, 300))}
    for mean in (9.0, 2.0, 0.3):
        draws[f"electron-multiplied, {mean:g} photoelectrons per frame"] = rng.standard_gamma(
            rng.poisson(mean, (4000, 300))
        )
    for name, noise in draws.items():
        out.append(row(name, f"{100 * np.mean([len(s.starts) > 1 for s in idealise(noise, 0.01)]):.1f}"))
    return [*out, "", "4000 traces of 300 frames each."]


def real_table() -> list[str]:
    """What is found in real movies."""
    out = header("movie", "candidates", "kept", "of these bleach", "most common reasons")
    for name, model_name, dark, rules in (
        ("smfret_ixon_emccd.tif", "smfret_ixon", 0, {"max_steps": 1}),
        ("yeast_slimfield_emccd.tif", "yeast_slimfield", 27, {}),
    ):
        if not (REAL_DATA / name).is_file():
            out.append(row(name, "no file", "", "", ""))
            continue
        model, movie = nm.Model.from_json(DOCS / "models" / f"{model_name}.json"), files.load(REAL_DATA / name)
        found = extract_traces(
            movie[dark:], model.camera, movie[:dark] if dark else None, psf_sigma_px=model.sigma_px, **rules
        )
        table = found.molecules
        reasons = table["reason"][~found.kept].str.replace(r"[\d.]+", "…", regex=True).value_counts().head(4)
        words = ", ".join(f"{count} × {reason}" for reason, count in reasons.items())
        bleach = int((table["bleaching_frame"][found.kept] >= 0).sum())
        out.append(
            row(name + (", one step at most" if rules else ""), len(table), int(found.kept.sum()), bleach, words)
        )
    return out


def camera_table() -> list[str]:
    """Baseline, read noise and slope of real movies by photon transfer."""
    out = header("movie", "baseline ADU", "read noise ADU", "slope, F²·ADU per photoelectron")
    for name in ("yeast_slimfield_emccd.tif", "smfret_ixon_emccd.tif"):
        if (REAL_DATA / name).is_file():
            found = calibrate(files.load(REAL_DATA / name))
            values = (found.baseline_adu, found.read_noise_adu, found.slope_adu)
            out.append(row(name, *(str(v) if np.isfinite(v.sd) else "not measured" for v in values)))
    return [
        *out,
        "",
        "The first has dark frames of its own; of the second, the baseline is extrapolated from the light.",
    ]


def gain_table() -> list[str]:
    """EM gain of the gain series, against the ratio of the means."""
    out = header("gain set", "by photon transfer", "by the ratio of the means")
    folder = REAL_DATA / "emccd_gain_series"
    if not folder.is_dir():
        return [*out, row("no folder", "", "")]

    def signal(gain: int) -> tuple[Any, float, float]:
        import tifffile

        movie = tifffile.imread(folder / f"{gain}x-gain.tif")
        dark = [
            float(tifffile.imread(folder / f"{gain}x-gain_no-signal_{what}.tif").mean()) for what in ("S0", "sigma")
        ]
        return movie, dark[0], dark[1]

    unit = signal(1)
    for gain in (5, 25, 100, 300):
        movie, offset, noise = signal(gain)
        found = calibrate(movie, baseline_adu=offset, read_noise_adu=noise, electrons_per_adu=3.859)
        ratio = (movie.mean() - offset) / (unit[0].mean() - unit[1])
        out.append(row(gain, f"{found.camera.em_gain or 1:.3g}", f"{ratio:.3g}"))
    return out


def large_table() -> list[str]:
    """Time and memory of a large movie."""
    import resource
    import tempfile
    from pathlib import Path

    model = nm.Model.from_dict(generator.base_model("emccd")).with_values(
        {"acquisition.shape_px": (512, 512), "acquisition.n_frames": 100, "sample.n_molecules": 1900,
         "sample.min_distance_px": 6.0}
    )  # fmt: skip
    part, times = nm.simulate(model, seed=1, workers=2).movie, 10
    shape = (times * len(part), *part.shape[1:])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "large.zarr"
        files.write_movie(path, (part for _ in range(times)), shape, np.uint16)
        del part
        begin, busy = time.perf_counter(), time.process_time()
        found = extract_traces(files.read_movie(path).data, model.camera, psf_sigma_px=model.sigma_px)
        seconds, busy = time.perf_counter() - begin, time.process_time() - busy
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    out = header("movie", "candidates", "seconds", "processor seconds", "peak of the process, GB")
    return [
        *out,
        row(" x ".join(str(n) for n in shape), len(found.molecules), f"{seconds:.0f}", f"{busy:.0f}", f"{peak:.1f}"),
    ]


SECTIONS: dict[str, Callable[[], list[str]]] = {
    "Molecules": molecules_table,
    "A moving field": moving_table,
    "Steps where there are none": steps_table,
    "Real movies": real_table,
    "Camera of real movies": camera_table,
    "EM gain of the gain series": gain_table,
    "A large movie": large_table,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="put the tables into docs/traces.md")
    parser.add_argument("--only", nargs="*", default=[], help="sections whose title holds one of these words")
    options = parser.parse_args()
    for title, table in SECTIONS.items():
        if options.only and not any(word.lower() in title.lower() for word in options.only):
            continue
        section = "\n".join([f"### {title}", "", *table(), ""])
        print(section, flush=True)
        if options.write:
            write("traces.md", title, section, SECTIONS)


if __name__ == "__main__":
    main()
