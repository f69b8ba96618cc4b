"""Photons put down one by one: each detected photon lands where its own random throw says, and is binned."""

from __future__ import annotations

import numpy as np

from .laws import Rng
from .world import SUBSTEPS, World

PHOTONS_AT_ONCE = 4_000_000


def landings(world: World, molecule: int, photons_t: np.ndarray, rng: Rng) -> np.ndarray:
    """Flat pixel indices (frame, y, x) of the photons of one molecule; those outside the field are lost."""
    ny, nx = world.shape_px
    frame = np.repeat(np.arange(world.n_frames), photons_t)
    throw = rng.standard_normal((frame.size, 2))
    if world.halo[0] > 0:
        throw[rng.random(frame.size) < world.halo[0]] *= world.halo[1]
    if world.shape_of_spot is not None:
        throw = throw @ world.shape_of_spot(world.positions_px[molecule]).T
    place = world.positions_px[molecule] + throw * (world.sigma_px * world.width_t[frame])[:, None]
    if world.shift_px is not None or world.wander_px is not None:
        moment = frame * SUBSTEPS + rng.integers(SUBSTEPS, size=frame.size)
        if world.shift_px is not None:
            place += world.shift_px[moment]
        if world.wander_px is not None:
            place += world.wander_px[molecule, moment]
    pixel = np.rint(place).astype(np.int64)
    seen = (pixel[:, 0] >= 0) & (pixel[:, 0] < ny) & (pixel[:, 1] >= 0) & (pixel[:, 1] < nx)
    pixel, frame = pixel[seen], frame[seen]
    return (frame * ny + pixel[:, 0]) * nx + pixel[:, 1]


def spot_electrons(world: World, mean_photons: np.ndarray, rng: Rng) -> np.ndarray:
    """Photoelectrons from the molecules, integers (frame, y, x)."""
    shape = (world.n_frames, *world.shape_px)
    size = int(np.prod(shape))
    total = np.zeros(size, dtype=np.int32)
    waiting: list[np.ndarray] = []
    n_waiting = 0
    detected = rng.poisson(mean_photons * world.camera.quantum_efficiency)
    for i, photons_t in enumerate(detected):
        waiting.append(landings(world, i, photons_t, rng))
        n_waiting += waiting[-1].size
        if n_waiting > PHOTONS_AT_ONCE:
            total += np.bincount(np.concatenate(waiting), minlength=size).astype(np.int32)
            waiting, n_waiting = [], 0
    if waiting:
        total += np.bincount(np.concatenate(waiting), minlength=size).astype(np.int32)
    return total.reshape(shape)


def background_mean_e(world: World) -> np.ndarray:
    """Mean photoelectrons of the background (frame, y, x): excited by the same light as the molecules."""
    in_time = world.background_t * np.maximum(world.light_t, 0.0)
    in_space = world.background_map * world.light_map
    level_e = world.background_photons * world.camera.quantum_efficiency
    return (level_e * in_time[:, None, None] * in_space).astype(np.float64)
