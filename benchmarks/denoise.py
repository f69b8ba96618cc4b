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
from functools import lru_cache, partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

import napari_mufasa as nm
from benchmarks.denoise_risk import honest_ratio
from benchmarks.pages import header, row, write
from benchmarks.scenes import PSF_SIGMA_PX, REAL_DATA, emccd, filaments, photograph, spots
from napari_mufasa.camera.detector import photoelectrons
from napari_mufasa.denoise import pure_let, pure_let_movie, pure_let_traces
from napari_mufasa.denoise.noise import Noise
from napari_mufasa.denoise.pipeline import Method, source_recipe
from napari_mufasa.denoise.preview import Preview
from napari_mufasa.denoise.purelet import Method as PureLet
from napari_mufasa.denoise.wavelet import anscombe
from napari_mufasa.model.setup import Camera

Array = NDArray[np.float64]
CAMERA = Camera(
    type="EMCCD", quantum_efficiency=0.9, read_noise_e=50, clock_induced_charge_e=0.002, electrons_per_adu=12,
    baseline_adu=200, em_gain=300,
)  # fmt: skip


def psnr(estimate: Array, truth: Array, peak: float) -> float:
    return float(10 * np.log10(peak**2 / np.mean((np.asarray(estimate) - truth) ** 2)))


@lru_cache
def _exact_inverse(sigma: float) -> tuple[Array, Array]:
    """Mean of the stabilised value against the mean count, by summation: the exact unbiased inverse of the GAT."""
    from scipy.stats import poisson

    means = np.concatenate([[0.0], np.geomspace(1e-3, 400, 600)])
    counts = np.arange(0, 700)
    nodes, weights = np.polynomial.hermite_e.hermegauss(31)
    values = anscombe(counts[:, None] + sigma * nodes[None, :], sigma) @ (weights / weights.sum())
    return np.array([poisson.pmf(counts, m) @ values for m in means]), means


def gat_bm3d(image: Array, alpha: float = 1.0, sigma: float = 0.0) -> Array:
    """Generalised Anscombe transform, BM3D, exact unbiased inverse."""
    import bm3d

    stable = bm3d.bm3d(anscombe(image / alpha, sigma / alpha), 1.0)
    table, means = _exact_inverse(round(sigma / alpha, 6))
    inverse = np.interp(stable, table, means)
    above = stable > table[-1]
    inverse[above] = stable[above] ** 2 / 4 - 0.125 - (sigma / alpha) ** 2
    return alpha * inverse


def gat_nlm(image: Array, alpha: float = 1.0, sigma: float = 0.0) -> Array:
    from skimage.restoration import denoise_nl_means

    stable = anscombe(image / alpha, sigma / alpha)
    smooth = denoise_nl_means(stable, patch_size=5, patch_distance=7, h=0.8, sigma=1.0, fast_mode=True)
    table, means = _exact_inverse(round(sigma / alpha, 6))
    return alpha * np.interp(smooth, table, means)


SKIPPED: set[str] = set()


def wanted(method: str) -> bool:
    return method not in SKIPPED


def picture(name: str, side: int = 256) -> Array:
    """One of scikit-image's pictures in grey, resized, maximum 1."""
    if name == "camera":
        return photograph(side)
    from skimage import color, data, transform

    image = np.asarray(getattr(data, name)(), dtype=float)
    grey = color.rgb2gray(image) if image.ndim == 3 else image
    small = transform.resize(grey, (side, side), anti_aliasing=True)
    return np.asarray(small / small.max())


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


def timed(run: Callable[[], object], repeats: int) -> Array:
    """Median wall and processor seconds."""
    run()
    times = []
    for _ in range(repeats):
        wall, busy = time.perf_counter(), time.process_time()
        run()
        times.append((time.perf_counter() - wall, time.process_time() - busy))
    return np.median(times, axis=0)


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


def nlm_refined(data: Array, pilot: Array, noise: Noise) -> Array:
    """scikit-image's non-local means in the place of `patches.refined`: white by the tangent at the pilot."""
    from skimage.restoration import denoise_nl_means

    level = np.sqrt(noise.alpha * np.maximum(pilot, 0.1 * noise.alpha) + noise.variance)
    known = 2 / noise.alpha * level
    white = known + (data - pilot) / level
    smooth = denoise_nl_means(white, patch_size=5, patch_distance=7, h=0.8, sigma=1.0, fast_mode=True)
    return np.asarray(pilot + level * (smooth - known), np.float32)


def second_pass_table(quick: bool) -> list[str]:
    """What `denoise/patches.py` is for, against libraries in its place: single images, PSNR and seconds."""
    from napari_mufasa.denoise import patches

    rng = np.random.default_rng(7)
    images = [("camera", picture("camera") * peak, 1.0, 0.0) for peak in ((10,) if quick else (3, 10, 30))]
    for name, scene in (("EMCCD spots", spots), ("EMCCD filaments", filaments)):
        images += [(name, scene(rng, 1, 256)[0] * peak, 2.0, 50 / 300) for peak in ((10,) if quick else (3, 10, 30))]
    out = header("image", "peak", "first pass (`undecimated`)", "`pure_let`", "NLM as second pass", "GAT + NLM",
                 "GAT + BM3D", "seconds: first", "`pure_let`", "NLM second", "GAT + BM3D")  # fmt: skip
    own = patches.refined
    for name, x, alpha, sigma in images:
        peak = float(x.max())
        counts = rng.poisson(x)
        y = (rng.standard_gamma(counts) if alpha == 2 else counts) + rng.normal(0, sigma, x.shape)
        found, seconds = [], []
        for method, second in (("undecimated", own), ("patches", own), ("patches", nlm_refined)):
            patches.refined = second
            run = partial(pure_let, y, alpha, sigma, method=method, multiplied=alpha == 2)
            try:
                seconds.append(float(timed(run, 1)[1]))
                found.append(psnr(run(), x, peak))
            finally:
                patches.refined = own
        found.append(psnr(gat_nlm(y, alpha, sigma), x, peak))
        begin = time.process_time()
        found.append(psnr(gat_bm3d(y, alpha, sigma), x, peak) if wanted("bm3d") else float("nan"))
        seconds.append(time.process_time() - begin if wanted("bm3d") else float("nan"))
        out.append(row(name, f"{peak:.0f}", *found, *seconds))
    return [*out, "", "256 x 256 pixels, one draw each; processor seconds."]


def single_pass_table(quick: bool) -> list[str]:
    """What `denoise/fused.py` is for: one level of a plane with known weights, against candidate by candidate."""
    from napari_mufasa.denoise import expansion
    from napari_mufasa.denoise.kernels import per_level

    rng = np.random.default_rng(0)
    out = header("frame", "guides", "single pass, ms", "candidate by candidate, ms", "ratio")
    for side in (512,) if quick else (512, 1024):
        for n_guides in (0, 2):
            planes = rng.poisson(5.0, (1 + n_guides, side, side)).astype(np.float32)
            guides = expansion.Guides(planes[1:], np.array([0.5, 0.2], np.float32)[:n_guides])
            weights = rng.normal(0, 0.2, per_level(n_guides)).astype(np.float32)
            noise = Noise(1.0, np.zeros((1, 1), np.float32))
            read = np.zeros((side, side), np.float32)
            ms = [
                1e3 * float(timed(partial(way, planes[0], read, guides, noise, weights, 1), 9)[1])
                for way in (expansion.in_one_pass, expansion.candidate_by_candidate)
            ]
            out.append(row(f"{side} x {side}", n_guides, *ms, ms[1] / ms[0]))
    return [*out, "", "One level, one thread, processor time, median of nine."]


IN_A_PROCESS_OF_ITS_OWN = """
import resource, sys
import numpy as np, zarr
import napari_mufasa as nm
from benchmarks.denoise import CAMERA
from napari_mufasa.denoise import denoise
movie = zarr.open(sys.argv[1], mode="r")["movie"]
out = zarr.create_array(sys.argv[1] + "-out", shape=movie.shape, chunks=movie.chunks, dtype=np.float32)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
denoise(movie, CAMERA, out=out)
print(before / 1024, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
"""


def memory_table(quick: bool) -> list[str]:
    """Peak memory of the default method from zarr to zarr, each movie in a process of its own."""
    import subprocess
    import sys
    import tempfile

    import zarr

    rng = np.random.default_rng(0)
    out = header("movie", "before, MB", "peak, MB", "difference in float32 frames")
    for frames, side in ((60, 256),) if quick else ((100, 256), (300, 256), (900, 256), (100, 512), (300, 512)):
        part = emccd(np.tile(spots(rng, 20, 128), (1, side // 128, side // 128)) * 5, rng)
        with tempfile.TemporaryDirectory() as folder:
            stack = zarr.open_group(f"{folder}/m.zarr", mode="w").create_array(
                "movie", shape=(frames, side, side), chunks=(20, side, side), dtype=np.uint16
            )
            for start in range(0, frames, 20):
                stack[start : start + 20] = part
            ran = subprocess.run(
                [sys.executable, "-c", IN_A_PROCESS_OF_ITS_OWN, f"{folder}/m.zarr"],
                capture_output=True, text=True, check=True,
            )  # fmt: skip
        before, peak = (float(v) for v in ran.stdout.split())
        of_a_frame = 4 * side * side / 2**20
        out.append(
            row(f"{frames} x {side} x {side}", f"{before:.0f}", f"{peak:.0f}", f"{(peak - before) / of_a_frame:.0f}")
        )
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
