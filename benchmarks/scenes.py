"""Ground truths for the denoising benchmark: a photograph, single-molecule spots, filaments."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

REAL_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
SIDE = 128
FRAMES = 24
PSF_SIGMA_PX = 1.3
Stack = NDArray[np.float64]


def photograph(side: int = 256) -> NDArray[np.float64]:
    """scikit-image's ``camera``, resized, maximum 1."""
    from skimage import data, transform

    image = transform.resize(data.camera().astype(float), (side, side), anti_aliasing=True)
    return np.asarray(image / image.max())


def blinking(rng: np.random.Generator, molecules: int, frames: int, switch: float = 0.12) -> NDArray[np.bool_]:
    """Telegraph signals (molecule, frame) that switch with probability ``switch`` per frame."""
    start = rng.random((molecules, 1)) < 0.5
    flips = np.cumsum(rng.random((molecules, frames)) < switch, axis=1) % 2 == 1
    return np.asarray(start ^ flips)


def spots(rng: np.random.Generator, frames: int = FRAMES, side: int = SIDE) -> Stack:
    """Blinking molecules on a weak background, a third of them moving; peak of a lone molecule 1."""
    molecules = side * side // 160
    position = rng.uniform(4, side - 4, (molecules, 1, 2)) + np.zeros((1, frames, 2))
    walks = np.cumsum(rng.normal(0, 0.7, (molecules, frames, 2)), axis=1)
    position[::3] += walks[::3]
    on = blinking(rng, molecules, frames)
    y, x = np.arange(side)[:, None], np.arange(side)[None, :]
    movie = np.full((frames, side, side), 0.1)
    for m in range(molecules):
        for t in np.flatnonzero(on[m]):
            py, px = position[m, t]
            movie[t] += np.exp(-((y - py) ** 2) / (2 * PSF_SIGMA_PX**2)) * np.exp(
                -((x - px) ** 2) / (2 * PSF_SIGMA_PX**2)
            )
    return movie


def filaments(rng: np.random.Generator, frames: int = FRAMES, side: int = SIDE) -> Stack:
    """Filaments whose emitters blink, 99.5th percentile 1; measured tubulin positions where they are present."""
    table = REAL_DATA / "tubulin_positions_nm.csv.gz"
    if table.exists():
        nm = np.loadtxt(table, delimiter=",")[:, :2]
        nm = nm - nm.min(axis=0)
        place = nm[(nm < side * 100.0).all(axis=1)] / 100.0
    else:
        place = np.concatenate([_curve(rng, side) for _ in range(14)])
    place = place[((place > 0) & (place < side - 1)).all(axis=1)]
    on = blinking(rng, len(place), frames)
    movie = np.zeros((frames, side, side))
    cell = np.rint(place).astype(int)
    for t in range(frames):
        np.add.at(movie[t], (cell[on[:, t], 1], cell[on[:, t], 0]), 1.0)
    movie = gaussian_filter(movie, (0, PSF_SIGMA_PX, PSF_SIGMA_PX))
    return movie / np.percentile(movie, 99.5) + 0.05


def _curve(rng: np.random.Generator, side: int) -> NDArray[np.float64]:
    steps = 4 * side
    angle = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0, 0.03, steps))
    path = np.cumsum(np.stack([np.cos(angle), np.sin(angle)], axis=1) * 0.5, axis=0)
    return rng.uniform(0, side, 2) + path


def emccd(
    photons: Stack, rng: np.random.Generator, gain: float = 300.0, read_noise_e: float = 50.0
) -> NDArray[np.uint16]:
    """Counts of an EMCCD with quantum efficiency 0.9, c 0.002, 12 electrons per ADU and baseline 200."""
    electrons = rng.poisson(0.9 * photons + 0.002)
    amplified = rng.standard_gamma(electrons) * gain + rng.normal(0, read_noise_e, photons.shape)
    return np.clip(np.floor(amplified / 12.0) + 200, 0, 65535).astype(np.uint16)
