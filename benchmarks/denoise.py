"""Denoising against the recipe of the source note, GAT + BM3D, non-local means and the temporal median.

    python -m benchmarks.denoise [--quick] [--write]

Prints tables in Markdown; ``--write`` puts them into docs/denoising.md between its two marks. Every number comes from
this one run; times are ratios within it.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

import napari_mufasa as nm
from benchmarks.scenes import PSF_SIGMA_PX, REAL_DATA, emccd, filaments, photograph, spots
from napari_mufasa.camera import photoelectrons
from napari_mufasa.denoise import pure_let, pure_let_movie, pure_let_traces
from napari_mufasa.denoise.pipeline import source_recipe
from napari_mufasa.denoise.wavelet import anscombe, anscombe_wavelet, bayes_shrink
from napari_mufasa.model import Camera

Array = NDArray[np.float64]
DOCS = Path(__file__).resolve().parents[1] / "docs" / "denoising.md"
BEGIN, END = "<!-- benchmark begins -->", "<!-- benchmark ends -->"
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


def row(*cells: object) -> str:
    return "| " + " | ".join(f"{c:.2f}" if isinstance(c, float) else str(c) for c in cells) + " |"


def header(*cells: str) -> list[str]:
    return [row(*cells), "|" + "---|" * len(cells)]


def poisson_table(quick: bool) -> list[str]:
    """Pure Poisson photograph at 256 x 256."""
    out = header(
        "peak", "noisy", "GAT+BM3D", "NLM", "cycle spinning", "PURE-LET", "minus BM3D", "estimated risk / true"
    )
    image = photograph()
    repeats = 5 if quick else 25
    for peak in (1, 10, 30, 120):
        rng = np.random.default_rng(peak)
        x = image * peak
        y = rng.poisson(x).astype(float)
        runs = [pure_let(rng.poisson(x), return_risk=True) for _ in range(repeats)]
        true = np.array([np.mean((estimate - x) ** 2) for estimate, _ in runs])
        error = np.array([risk for _, risk in runs]) - true
        ratio, doubt = 1 + error.mean() / true.mean(), error.std() / np.sqrt(repeats) / true.mean()
        bm3d, ours = psnr(gat_bm3d(y), x, peak), psnr(pure_let(y), x, peak)
        spun = psnr(pure_let(y, method="cycle-spinning"), x, peak)
        out.append(row(peak, psnr(y, x, peak), bm3d, psnr(gat_nlm(y), x, peak), spun, ours, ours - bm3d,
                       f"{ratio:.3f} ± {doubt:.3f}"))  # fmt: skip
    return out


def emccd_table(quick: bool) -> list[str]:
    """Simulated EMCCD movies; BM3D and NLM on a few frames of them, ours judged on the same frames."""
    out = header("scene", "photons", "raw", "source recipe", "NLM", "GAT+BM3D", "median of 5 frames", "`pure-let`",
                 "`pure-let-movie`", "bias %")  # fmt: skip
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
                "bm3d": back([gat_bm3d(electrons[t], 2.0, sigma) for t in frames]),
                "median": back(median_filter(electrons, (5, 1, 1))[frames]),
                "single": nm.denoise(movie, CAMERA, method="pure-let")[frames],
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
    """Bleaching steps of isolated molecules, 5 photoelectrons at the peak pixel, read off the brightest pixel."""
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

    raw = at(photoelectrons(movie, CAMERA))
    found = {"raw": (raw - 0.002) / 0.9}
    for method in ("source", "pure-let", "pure-let-movie"):
        found[f"`{method}`"] = at(nm.denoise(movie, CAMERA, method=method))
    found["raw, then `pure_let_traces`"] = (pure_let_traces(raw, 2.0, 50 / 300, multiplied=True) - 0.002) / 0.9
    out = header("traces from", "steps within ±1 frame %", "amplitude bias %")
    for name, traces in found.items():
        hit = np.mean([abs(best_step(t) - b) <= 1 for t, b in zip(traces, bleach, strict=True)])
        bias = drops(traces).mean() / drops(at(truth)).mean() - 1
        out.append(row(name, f"{100 * hit:.1f}", f"{100 * bias:+.1f}"))
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


def timed(run: Callable[[], object], repeats: int) -> float:
    run()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def time_table(quick: bool) -> list[str]:
    """Seconds per 512 x 512 frame in movies, as ratios within this run."""
    rng = np.random.default_rng(0)
    n = 16 if quick else 48
    truth = np.tile(spots(rng, n, 128), (1, 4, 4)) * 5
    movie = emccd(truth, rng)
    frame = photoelectrons(movie[0], CAMERA)
    literal = timed(lambda: anscombe_wavelet(bayes_shrink(frame, 50 / 300)), 5)
    seconds = {
        "source recipe, one frame": literal,
        "source recipe, movie": timed(lambda: nm.denoise(movie, CAMERA, method="source"), 1) / n,
        "`pure_let`, one frame with its own weights": timed(lambda: pure_let(frame, 2.0, 50 / 300), 3),
        "`pure-let`, movie": timed(lambda: nm.denoise(movie, CAMERA, method="pure-let"), 1) / n,
        "`pure-let-movie`": timed(lambda: nm.denoise(movie, CAMERA), 1) / n,
    }
    start = time.perf_counter()
    gat_bm3d(frame, 2.0, 50 / 300)
    seconds["GAT+BM3D"] = time.perf_counter() - start
    out = header("method", "ms per frame", "/ source recipe, movie", "/ GAT+BM3D")
    base, bm3d = seconds["source recipe, movie"], seconds["GAT+BM3D"]
    out += [row(k, f"{1e3 * s:.0f}", f"{s / base:.2f}", f"{s / bm3d:.4f}") for k, s in seconds.items()]
    return [*out, "", f"Movies of {n} frames, weights learnt in the time given."]


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
    "Pure Poisson, photograph 256 x 256 (PSNR, dB)": poisson_table,
    "Poisson movies at peak 10, moving photograph (PSNR, dB)": multi_poisson,
    "Simulated EMCCD movies (PSNR, dB)": emccd_table,
    "Bleaching steps": step_table,
    "Real movies, odd frames predicted from even ones": real_table,
    "Time": time_table,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer repeats and frames")
    parser.add_argument("--write", action="store_true", help="put the tables into docs/denoising.md")
    options = parser.parse_args()
    warnings.filterwarnings("ignore", category=RuntimeWarning, module="skimage")
    lines: list[str] = []
    for title, table in SECTIONS.items():
        section = [f"### {title}", "", *table(options.quick), ""]
        print("\n".join(section), flush=True)
        lines += section
    if options.write:
        text = DOCS.read_text()
        head, rest = text.split(BEGIN)
        DOCS.write_text(head + BEGIN + "\n" + "\n".join(lines) + END + rest.split(END)[1])


if __name__ == "__main__":
    main()
