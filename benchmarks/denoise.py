"""Denoising against the recipe of the source note, GAT + BM3D, non-local means and the temporal median.

    python -m benchmarks.denoise [--quick] [--write] [--only WORD ...] [--without bm3d]

Prints tables in Markdown; ``--write`` puts them into docs/denoising.md between its two marks. Every number comes from
this one run; times are ratios within it.
"""

from __future__ import annotations

import argparse
import os
import time
import warnings
from collections.abc import Callable
from typing import Literal

import numpy as np
from scipy.ndimage import median_filter

import napari_mufasa as nm
from benchmarks.denoise_parts import memory_table, second_pass_table, single_pass_table
from benchmarks.denoise_references import CAMERA, SKIPPED, Array, gat_bm3d, gat_nlm, picture, psnr, timed, wanted
from benchmarks.denoise_risk import honest_ratio
from benchmarks.pages import header, row, write
from benchmarks.scenes import PSF_SIGMA_PX, REAL_DATA, emccd, filaments, photograph, spots
from napari_mufasa.camera.detector import photoelectrons
from napari_mufasa.denoise import pure_let, pure_let_movie, pure_let_traces
from napari_mufasa.denoise.pipeline import Method, source_recipe
from napari_mufasa.denoise.preview import Preview
from napari_mufasa.denoise.purelet import Method as PureLet


def poisson_table(quick: bool) -> list[str]:
    """Pure Poisson pictures at 256 x 256; the one with published values in several draws."""
    out = header("picture", "peak", "noisy", "GAT+BM3D", "NLM", "cycle spinning", "`undecimated`", "`pure_let`",
                 "minus BM3D", "least of the draws")  # fmt: skip
    for name in ("camera",) if quick else ("camera", "coins", "astronaut", "cell"):
        image = picture(name)
        # BM3D takes most of the time: it is run on one picture only.
        bm3d, draws = name == "camera" and wanted("bm3d"), 4 if name == "camera" and not quick else 1
        for peak in (1, 10, 30, 120):
            x, found = image * peak, []
            for draw in range(draws):
                y = np.random.default_rng(100 * peak + draw).poisson(x).astype(float)
                best = psnr(pure_let(y), x, peak)
                reference = psnr(gat_bm3d(y), x, peak) if bm3d else float("nan")
                others = [psnr(pure_let(y, method=m), x, peak) for m in ("cycle-spinning", "undecimated")]
                noisy, nlm = psnr(y, x, peak), psnr(gat_nlm(y), x, peak)
                found.append([noisy, reference, nlm, *others, best, best - reference])
            out.append(row(name, peak, *np.mean(found, axis=0).tolist(), float(np.min(found, axis=0)[-1])))
    return [*out, "", "The mean of four draws of the noise for `camera`, one for the others."]


def risk_table(quick: bool) -> list[str]:
    """Estimated over true risk on `camera`."""
    out = header("peak", "like patches: draws", "estimated / true", "scatter of one draw", "`undecimated`: draws",
                 "estimated / true", "scatter of one draw")  # fmt: skip
    image = photograph()
    for peak, few, draws in ((1, 60, 80), (10, 60, 60), (30, 40, 60), (120, 40, 40)):
        cells: list[object] = [peak]
        methods: tuple[tuple[PureLet, int], ...] = (("patches", few), ("undecimated", draws))
        for method, number in methods:
            n = 12 if quick else number
            ratio, error, scatter = honest_ratio(image * peak, np.random.default_rng(1000 + peak), n, method)
            cells += [n, f"{ratio:.3f} ± {error:.3f}", f"{scatter:.3f}"]
        out.append(row(*cells))
    return out


def emccd_table(quick: bool) -> list[str]:
    """Simulated EMCCD movies; BM3D and NLM on a few frames of them, ours judged on the same frames."""
    out = header("scene", "photons", "raw", "source recipe", "NLM", "GAT+BM3D", "median of 5 frames", "`pure-let`",
                 "`pure-let-patches`", "`pure-let-movie`", "bias %")  # fmt: skip
    frames = [5, 12] if quick else [3, 8, 13, 18]
    for name, scene in (("spots", spots), ("filaments", filaments)):
        for peak in (1, 3, 10, 30):
            rng = np.random.default_rng(peak)
            x = scene(rng) * peak
            movie = emccd(x, rng)
            electrons = photoelectrons(movie, CAMERA)
            sigma = CAMERA.read_noise_e / (CAMERA.em_gain or 1.0)
            back = lambda e: (np.asarray(e) - 0.002) / 0.9  # noqa: E731
            results = {
                "raw": back(electrons[frames]),
                "source": nm.denoise(movie, CAMERA, method="source")[frames],
                "nlm": back([gat_nlm(electrons[t], 2.0, sigma) for t in frames]),
                "bm3d": back([gat_bm3d(electrons[t], 2.0, sigma) for t in frames])
                if wanted("bm3d")
                else np.full_like(x[frames], np.nan),
                "median": back(median_filter(electrons, (5, 1, 1))[frames]),
                "single": nm.denoise(movie, CAMERA, method="pure-let")[frames],
                "patches": nm.denoise(movie, CAMERA, method="pure-let-patches")[frames],
            }
            whole = nm.denoise(movie, CAMERA, method="pure-let-movie")
            results["movie"] = whole[frames]
            bias = 100 * (float(whole.mean(dtype=float)) / float(x.mean()) - 1)
            out.append(row(name, peak, *(psnr(r, x[frames], peak) for r in results.values()), f"{bias:+.2f}"))
    return out


def best_step(trace: Array) -> int:
    """Frame of the least-squares downward step."""
    n = len(trace)
    before = np.arange(1, n)
    total = np.cumsum(trace)
    drop = total[:-1] / before - (total[-1] - total[:-1]) / (n - before)
    return int(np.argmax(np.where(drop > 0, drop**2 * before * (n - before), 0))) + 1


def step_table(quick: bool) -> list[str]:
    """Bleaching steps of isolated molecules, 5 photoelectrons at the peak pixel.

    Read off the brightest pixel, and by `extract_traces` with its usual profile and background.
    """
    from napari_mufasa.traces import extract_traces

    rng = np.random.default_rng(0)
    n_frames, side = (60, 96) if quick else (120, 160)
    grid = np.arange(10, side - 9, 14)
    place = np.array([(y, x) for y in grid for x in grid]) + rng.uniform(-0.5, 0.5, (grid.size**2, 2))
    bleach = rng.integers(15, n_frames - 15, len(place))
    y, x = np.mgrid[:side, :side]
    truth = np.full((n_frames, side, side), 0.5)
    for (py, px), stop in zip(place, bleach, strict=True):
        truth[:stop] += 5 / 0.9 * np.exp(-((y - py) ** 2 + (x - px) ** 2) / (2 * PSF_SIGMA_PX**2))
    movie = emccd(truth, rng)
    centre = np.rint(place).astype(int)

    def drops(traces: Array) -> Array:
        return np.array([t[:b].mean() - t[b:].mean() for t, b in zip(traces, bleach, strict=True)])

    def at(stack: Array) -> Array:
        return np.asarray(stack)[:, centre[:, 0], centre[:, 1]].T

    def extracted(stack: Array, unit: Literal["adu", "photons"]) -> Array:
        # Every molecule is kept, in the order of its place.
        return extract_traces(
            stack, CAMERA, positions_px=place, unit=unit, psf_sigma_px=PSF_SIGMA_PX
        ).all_traces.astype(float)

    raw = at(photoelectrons(movie, CAMERA))
    found = {"raw": ((raw - 0.002) / 0.9, extracted(movie, "adu"))}
    for method in ("source", "pure-let", "pure-let-patches", "pure-let-movie"):
        stack = nm.denoise(movie, CAMERA, method=method)
        found[f"`{method}`"] = at(stack), extracted(stack, "photons")
    filtered = (pure_let_traces(raw, 2.0, 50 / 300, multiplied=True) - 0.002) / 0.9
    true = drops(at(truth)).mean(), drops(extracted(truth.astype(np.float32), "photons")).mean()
    out = header("traces from", "brightest pixel: steps within ±1 frame %", "amplitude bias %",
                 "extracted: steps within ±1 frame %", "amplitude bias %")  # fmt: skip
    for name, kinds in found.items():
        cells: list[object] = [name]
        for traces, height in zip(kinds, true, strict=True):
            hit = np.mean([abs(best_step(t) - b) <= 1 for t, b in zip(traces, bleach, strict=True)])
            cells += [f"{100 * hit:.1f}", f"{100 * (drops(traces).mean() / height - 1):+.1f}"]
        out.append(row(*cells))
    alone = np.mean([abs(best_step(t) - b) <= 1 for t, b in zip(filtered, bleach, strict=True)])
    alone_bias = drops(filtered).mean() / true[0] - 1
    out.append(row("raw, then `pure_let_traces`", f"{100 * alone:.1f}", f"{100 * alone_bias:+.1f}", "", ""))
    return [*out, "", f"{len(place)} molecules, {n_frames} frames."]


def real_table(quick: bool) -> list[str]:
    """Prediction of the odd frames by the denoised even frames on either side: less is better, raw = 1."""
    import tifffile

    out = header("movie", "temporal median of 3", "source recipe", "`pure-let`", "`pure-let-movie`")
    measured = {
        "smfret_ixon_emccd.tif": CAMERA.model_copy(
            update={"em_gain": 300.0, "electrons_per_adu": 15.5, "baseline_adu": 105.0}
        ),
        "yeast_slimfield_emccd.tif": CAMERA.model_copy(
            update={"em_gain": 50.0, "electrons_per_adu": 4.5, "baseline_adu": 195.0, "read_noise_e": 185.0}
        ),
    }
    for name, camera in measured.items():
        path = REAL_DATA / name
        if not path.exists():
            continue
        movie = tifffile.imread(path)
        movie = movie[30:90] if "yeast" in name else movie[: 60 if quick else 200]
        even, target = movie[::2], photoelectrons(movie[1::2], camera)
        n = min(len(even) - 1, len(target))

        def error(electrons: Array, n: int = n, target: Array = target) -> float:
            prediction = 0.5 * (electrons[:n] + electrons[1 : n + 1])
            # The target's own noise adds the same to every method; what is left is compared.
            return float(np.mean((prediction - target[:n]) ** 2))

        raw = photoelectrons(even, camera)
        q, c = camera.quantum_efficiency, camera.clock_induced_charge_e
        results = [median_filter(raw, (3, 1, 1)), source_recipe(even, camera)]
        results += [nm.denoise(even, camera, method=m) * q + c for m in ("pure-let", "pure-let-movie")]
        base = error(raw)
        out.append(row(name, *(f"{error(r) / base:.4f}" for r in results)))
    return [*out, "", "Mean square error of the prediction relative to that of the raw frames."]


def time_table(quick: bool) -> list[str]:
    """Time per 512 x 512 frame in movies, as ratios within this run."""
    rng = np.random.default_rng(0)
    n = 16 if quick else 100
    few = np.tile(emccd(np.tile(spots(rng, 20, 128), (1, 4, 4)) * 5, rng), (5, 1, 1))
    movie = few[:n]
    frame = photoelectrons(movie[0], CAMERA)
    nm.denoise(movie[:4], CAMERA)  # compiled before it is timed
    preview = Preview(movie, CAMERA)

    def per_frame(method: Method, frames: int) -> Array:
        wall, busy = time.perf_counter(), time.process_time()
        nm.denoise(movie[:frames], CAMERA, method=method)
        return np.array([time.perf_counter() - wall, time.process_time() - busy]) / frames

    seconds: dict[str, Array] = {}
    # Other work on the machine comes and goes: the recipe is timed again after each method, and its median counts.
    recipe = [per_frame("source", 8)]

    for name, measure in {
        "`pure-let-movie` (default)": lambda: per_frame("pure-let-movie", n),
        "`pure-let`, movie": lambda: per_frame("pure-let", n),
        "`pure-let-patches`, movie": lambda: per_frame("pure-let-patches", min(n, 16)),
        "`pure_let`, one frame": lambda: timed(lambda: pure_let(frame, 2.0, 50 / 300, multiplied=True), 3),
        '`pure_let(method="undecimated")`, one frame': lambda: timed(
            lambda: pure_let(frame, 2.0, 50 / 300, method="undecimated", multiplied=True), 3
        ),
        "preview, one frame, once learnt": lambda: timed(lambda: preview.look(len(movie) // 2), 5),
    }.items():
        seconds[name] = measure()
        recipe.append(per_frame("source", 8))
    seconds["source recipe, movie"] = base = np.median(recipe, axis=0)
    if wanted("bm3d"):
        seconds["GAT+BM3D"] = timed_once(lambda: gat_bm3d(frame, 2.0, 50 / 300))
    bm3d = seconds.get("GAT+BM3D", np.full(2, np.nan))
    out = header("method", "ms per frame", "/ source recipe, movie", "/ GAT+BM3D", "processor ms", "/ source recipe",
                 "/ GAT+BM3D")  # fmt: skip
    for name, (wall, busy) in seconds.items():
        out.append(row(name, f"{1e3 * wall:.0f}", f"{wall / base[0]:.2f}", f"{wall / bm3d[0]:.4f}",
                       f"{1e3 * busy:.0f}", f"{busy / base[1]:.2f}", f"{busy / bm3d[1]:.4f}"))  # fmt: skip
    sizes = f"Frames of 512 x 512, movies of {n} frames ({min(n, 16)} for the slow methods), learning included."
    kinds = (
        f"ms: by the clock; processor ms: summed over the {os.cpu_count()} processors, of which the recipe uses one."
    )
    return [*out, "", f"{sizes} {kinds}"]


def timed_once(run: Callable[[], object]) -> Array:
    wall, busy = time.perf_counter(), time.process_time()
    run()
    return np.array([time.perf_counter() - wall, time.process_time() - busy])


def multi_poisson(quick: bool) -> list[str]:
    """`pure_let_movie` on Poisson movies of a photograph that shifts by ``speed`` pixels per frame."""
    out = header("pixels per frame", "single frame", "multi-frame")
    image = photograph(192)
    for speed in (0.0, 0.25, 1.0, 4.0):
        rng = np.random.default_rng(1)
        steps = (speed * np.arange(8 if quick else 12)).round().astype(int)
        x = np.stack([np.roll(image, s, axis=1) for s in steps]) * 10
        y = rng.poisson(x)
        out.append(row(f"{speed:g}", psnr(pure_let_movie(y, neighbours=0), x, 10), psnr(pure_let_movie(y), x, 10)))
    return out


SECTIONS: dict[str, Callable[[bool], list[str]]] = {
    "Pure Poisson, pictures 256 x 256 (PSNR, dB)": poisson_table,
    "Estimated risk over true risk": risk_table,
    "Poisson movies at peak 10, moving photograph (PSNR, dB)": multi_poisson,
    "Simulated EMCCD movies (PSNR, dB)": emccd_table,
    "Bleaching steps": step_table,
    "Real movies, odd frames predicted from even ones": real_table,
    "Second pass of single images (PSNR, dB)": second_pass_table,
    "Single pass": single_pass_table,
    "Time": time_table,
    "Memory": memory_table,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer repeats and frames")
    parser.add_argument("--write", action="store_true", help="put the tables into docs/denoising.md")
    parser.add_argument("--only", nargs="*", default=[], help="sections whose title holds one of these words")
    parser.add_argument("--without", nargs="*", default=[], choices=["bm3d"], help="methods to leave out")
    options = parser.parse_args()
    if options.write and options.without:
        parser.error("--write puts whole tables into the page: leave no method out")
    SKIPPED.update(options.without)
    warnings.filterwarnings("ignore", category=RuntimeWarning, module="skimage")
    for title, table in SECTIONS.items():
        if options.only and not any(word.lower() in title.lower() for word in options.only):
            continue
        section = "\n".join([f"### {title}", "", *table(options.quick), ""])
        print(section, flush=True)
        if options.write:
            write("denoising.md", title, section, SECTIONS)


if __name__ == "__main__":
    main()
