"""What parts of the denoiser are worth, against what could stand in their place; and its memory."""

from __future__ import annotations

import time
from functools import partial

import numpy as np

from benchmarks.denoise_references import gat_bm3d, gat_nlm, nlm_refined, picture, psnr, timed, wanted
from benchmarks.pages import header, row
from benchmarks.scenes import emccd, filaments, spots
from napari_mufasa.denoise import pure_let
from napari_mufasa.denoise.noise import Noise


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
import sys
import numpy as np, zarr
import napari_mufasa as nm
from benchmarks.denoise_references import CAMERA
from napari_mufasa.denoise import denoise
movie = zarr.open(sys.argv[1], mode="r")["movie"]
out = zarr.create_array(sys.argv[1] + "-out", shape=movie.shape, chunks=movie.chunks, dtype=np.float32)
def peak_mb():  # of this program: what getrusage says begins with the peak of the process that started it
    return int(next(line for line in open("/proc/self/status") if line.startswith("VmHWM")).split()[1]) / 1024
denoise(movie[:2], CAMERA)  # loads what it takes
before = peak_mb()
denoise(movie, CAMERA, out=out)
print(before, peak_mb())
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
