"""What the denoiser is compared with, and what every table needs: other methods, pictures, PSNR, clocks."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from benchmarks.scenes import photograph
from napari_mufasa.denoise.noise import Noise
from napari_mufasa.denoise.wavelet import anscombe
from napari_mufasa.model.setup import Camera

Array = NDArray[np.float64]
CAMERA = Camera(
    type="EMCCD", quantum_efficiency=0.9, read_noise_e=50, clock_induced_charge_e=0.002, electrons_per_adu=12,
    baseline_adu=200, em_gain=300,
)  # fmt: skip


SKIPPED: set[str] = set()


def wanted(method: str) -> bool:
    return method not in SKIPPED


def psnr(estimate: Array, truth: Array, peak: float) -> float:
    return float(10 * np.log10(peak**2 / np.mean((np.asarray(estimate) - truth) ** 2)))


def timed(run: Callable[[], object], repeats: int) -> Array:
    """Median wall and processor seconds."""
    run()
    times = []
    for _ in range(repeats):
        wall, busy = time.perf_counter(), time.process_time()
        run()
        times.append((time.perf_counter() - wall, time.process_time() - busy))
    return np.median(times, axis=0)


def picture(name: str, side: int = 256) -> Array:
    """One of scikit-image's pictures in grey, resized, maximum 1."""
    if name == "camera":
        return photograph(side)
    from skimage import color, data, transform

    image = np.asarray(getattr(data, name)(), dtype=float)
    grey = color.rgb2gray(image) if image.ndim == 3 else image
    small = transform.resize(grey, (side, side), anti_aliasing=True)
    return np.asarray(small / small.max())


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


def nlm_refined(data: Array, pilot: Array, noise: Noise) -> Array:
    """scikit-image's non-local means in the place of `patches.refined`: white by the tangent at the pilot."""
    from skimage.restoration import denoise_nl_means

    level = np.sqrt(noise.alpha * np.maximum(pilot, 0.1 * noise.alpha) + noise.variance)
    known = 2 / noise.alpha * level
    white = known + (data - pilot) / level
    smooth = denoise_nl_means(white, patch_size=5, patch_distance=7, h=0.8, sigma=1.0, fast_mode=True)
    return np.asarray(pilot + level * (smooth - known), np.float32)
