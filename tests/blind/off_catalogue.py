"""Disturbances that are in no catalogue: an honest diagnosis calls them unexplained."""

from __future__ import annotations

from typing import Any

import numpy as np

from .effects_light import _add
from .laws import Rng
from .world import SUBSTEPS, World

Found = dict[str, Any]


def even_odd_frames(world: World, s: float, rng: Rng) -> Found:
    """Interleaved exposures: every second frame brighter."""
    half = 0.12 * s
    world.light_t = world.light_t * np.where(np.arange(world.n_frames) % 2, 1.0 - half, 1.0 + half)
    return {"relative_difference": 2 * half}


def shutter_event(world: World, s: float, rng: Rng) -> Found:
    """The shutter closes for one to three frames, a few times."""
    events = 1 + round(4 * s)
    start = rng.choice(np.arange(10, world.n_frames - 10), events, replace=False)
    length = rng.integers(1, 4, events)
    light = np.ones(world.n_frames)
    for a, n in zip(start, length, strict=True):
        light[a : a + n] = rng.uniform(0.0, 0.4)
    world.light_t = world.light_t * light
    return {"start_frames": start.tolist(), "length_frames": length.tolist()}


def on_camera_smoothing(world: World, s: float, rng: Rng) -> Found:
    """A vendor's 3 x 3 filter on the recorded numbers, dark frames included."""
    side = 0.25 * s
    kernel = np.array([side / (1 + 2 * side), 1 / (1 + 2 * side), side / (1 + 2 * side)])

    def smooth(stack: np.ndarray, _rng: Rng) -> np.ndarray:
        wide = np.pad(stack.astype(np.float32), ((0, 0), (1, 1), (1, 1)), mode="reflect")
        rows = kernel[0] * wide[:, :-2] + kernel[1] * wide[:, 1:-1] + kernel[2] * wide[:, 2:]
        both = kernel[0] * rows[..., :-2] + kernel[1] * rows[..., 1:-1] + kernel[2] * rows[..., 2:]
        return np.rint(both).astype(np.uint16)

    world.after.append(smooth)
    return {"neighbour_weight": float(kernel[0])}


def quantisation(world: World, s: float, rng: Rng) -> Found:
    """Low bits lost on export, dark frames included."""
    step = int(2 ** round(1 + 6 * s))
    world.after.append(lambda stack, _rng: ((stack // step) * step).astype(np.uint16))
    return {"step_adu": step}


def level_switching(world: World, s: float, rng: Rng) -> Found:
    """Molecules jump between full and partial brightness, never to zero."""
    ratio = 1.0 - 0.7 * s
    mean_frames = rng.uniform(8, 40)
    m, n = len(world.positions_px), world.n_frames
    flips = rng.random((m, n)) < 1.0 / mean_frames
    low = (np.cumsum(flips, axis=1) + (rng.random(m) < 0.5)[:, None]) % 2 == 1
    world.level = np.where(low, ratio, 1.0)
    return {"level_ratio": ratio, "mean_dwell_s": float(mean_frames * world.frame_s)}


def thermal_expansion(world: World, s: float, rng: Rng) -> Found:
    """The sample grows: displacement proportional to the distance from a fixed point."""
    ny, nx = world.shape_px
    total = 0.10 * s * (1.0 if rng.random() < 0.5 else -1.0)
    centre = np.array([ny / 2, nx / 2]) + rng.normal(0, 0.05, 2) * [ny, nx]
    u = (np.arange(world.n_frames * SUBSTEPS) + 0.5) / (world.n_frames * SUBSTEPS)
    world.wander_px = _add(world.wander_px, total * u[None, :, None] * (world.positions_px - centre)[:, None, :])
    return {"relative_expansion": float(total)}


def vibration(world: World, s: float, rng: Rng) -> Found:
    """The stage swings along one direction, near or above the frame rate."""
    amplitude_px = 1.2 * s
    frequency_hz = rng.uniform(0.08, 1.2) / world.frame_s
    angle = rng.uniform(0, np.pi)
    t_s = (np.arange(world.n_frames * SUBSTEPS) + 0.5) * world.frame_s / SUBSTEPS
    swing = amplitude_px * np.sin(2 * np.pi * (frequency_hz * t_s + rng.random()))
    world.shift_px = _add(world.shift_px, swing[:, None] * [np.sin(angle), np.cos(angle)])
    return {"amplitude_px": amplitude_px, "frequency_hz": float(frequency_hz), "angle_rad": float(angle)}


def duplicated_frames(world: World, s: float, rng: Rng) -> Found:
    """The transfer drops frames and repeats the one before, in the dark stack too."""
    share = 0.15 * s

    def repeat(stack: np.ndarray, r: Rng) -> np.ndarray:
        source = np.arange(len(stack))
        lost = r.random(len(stack)) < share
        lost[0] = False
        for t in np.flatnonzero(lost):
            source[t] = source[t - 1]
        return stack[source]

    world.after.append(repeat)
    return {"duplicated_fraction": share}


OFF_CATALOGUE = {
    f.__name__: f
    for f in (
        even_odd_frames,
        shutter_event,
        on_camera_smoothing,
        quantisation,
        level_switching,
        thermal_expansion,
        vibration,
        duplicated_frames,
    )
}
