"""Hidden effects of the camera; those that exist without light are in the dark frames too.

Offsets are scaled to the read noise in ADU (4.2 for the EMCCD base), to mean the same on any camera.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .laws import COURSES, Rng, course
from .world import World

Found = dict[str, Any]


def _noise_adu(world: World) -> float:
    return world.camera.read_noise_e / world.camera.electrons_per_adu


def em_excess_noise(world: World, s: float, form: int, rng: Rng) -> Found:
    """The register multiplies with less noise than the ideal factor 2. Forms: Gamma, partly noiseless."""
    if world.camera.kind != "EMCCD":
        raise ValueError(f"em_excess_noise needs an EMCCD, not {world.camera.kind}; use suitable_base")
    world.camera.excess_factor = 2.0 - s**1.5
    world.camera.excess_form = form
    return {"excess_noise_factor": 2.0 - s**1.5}


def clock_induced_charge(world: World, s: float, form: int, rng: Rng) -> Found:
    """More spurious electrons than believed. Forms: before the register, in it, growing with y."""
    extra_e = 0.4 * s**2.5
    if form == 1 and world.camera.kind == "EMCCD":
        world.camera.serial_charge_e = 3.0 * extra_e
        return {"serial_events_per_px": 3.0 * extra_e, "believed_e_per_px": world.camera.spurious_e}
    total_e = world.camera.spurious_e + extra_e
    if form == 2:
        ny, nx = world.shape_px
        world.camera.spurious_map = np.repeat(np.linspace(0.3, 1.7, ny)[:, None], nx, axis=1)
    found = {
        "extra_e_per_px": extra_e,
        "total_e_per_px": total_e,
        "believed_e_per_px": world.camera.spurious_e,
    }
    world.camera.spurious_e = total_e
    return found


def pixel_gain_variation(world: World, s: float, form: int, rng: Rng) -> Found:
    """Every pixel has its own gain. Forms: independent pixels, columns and pixels, a tail of dull pixels."""
    sd = 0.15 * s
    ny, nx = world.shape_px
    if form == 0:
        gain = 1.0 + sd * rng.standard_normal((ny, nx))
    elif form == 1:
        gain = 1.0 + sd * np.sqrt(0.5) * (rng.standard_normal((1, nx)) + rng.standard_normal((ny, nx)))
    else:
        gain = 1.0 + sd * (1.0 - rng.standard_exponential((ny, nx)))
    world.camera.gain_map = np.maximum(gain, 0.1)
    return {"gain_sd": sd}


def column_offset(world: World, s: float, form: int, rng: Rng) -> Found:
    """A fixed pattern of offsets. Forms: independent columns, odd and even columns, columns and pixels."""
    rms_adu = _noise_adu(world) * s**1.5
    ny, nx = world.shape_px
    columns = rng.standard_normal(nx)
    pattern = np.repeat(columns[None], ny, axis=0)
    if form == 1:
        pattern = np.sqrt(0.7) * np.where(np.arange(nx) % 2, 1.0, -1.0) + np.sqrt(0.3) * pattern
    elif form == 2:
        pattern = np.sqrt(0.6) * pattern + np.sqrt(0.4) * rng.standard_normal((ny, nx))
    world.camera.offset_map_adu = rms_adu * pattern
    return {"rms_adu": rms_adu}


def row_noise(world: World, s: float, form: int, rng: Rng) -> Found:
    """Each read-out row has its own offset in each frame. Forms: independent, banded, a few rows hit hard."""
    rms_adu = _noise_adu(world) * s**1.3

    def independent(frames: int, rows: int, r: Rng) -> np.ndarray:
        return rms_adu * r.standard_normal((frames, rows))

    def banded(frames: int, rows: int, r: Rng) -> np.ndarray:
        noise = r.standard_normal((frames, rows + 1))
        return rms_adu * (noise[:, 1:] + 0.8 * noise[:, :-1]) / np.hypot(1.0, 0.8)

    def rare(frames: int, rows: int, r: Rng) -> np.ndarray:
        hit = r.random((frames, rows)) < 0.1
        return rms_adu / np.sqrt(0.1) * hit * r.standard_normal((frames, rows))

    world.camera.row_offset_adu = (independent, banded, rare)[form]
    return {"rms_adu": rms_adu}


def hot_pixels(world: World, s: float, form: int, rng: Rng) -> Found:
    """A few pixels leak charge, light or no light. Forms: steady, exponential spread, switching."""
    fraction = 0.01 * s**1.5
    hot = rng.random(world.shape_px) < fraction
    if fraction > 0 and not hot.any():
        hot[rng.integers(world.shape_px[0]), rng.integers(world.shape_px[1])] = True
    if form == 1:
        charge = 2.0 + 15.0 * rng.standard_exponential(world.shape_px)
    else:
        charge = 3.0 * (40.0 / 3.0) ** rng.random(world.shape_px)
    world.camera.hot_map_e = np.where(hot, charge, 0.0)
    found: Found = {}
    if form == 2:
        world.camera.hot_switching = (0.05, 0.05)
        found = {"switching_per_frame": 0.05}
    mean_e = float(charge[hot].mean()) if hot.any() else 0.0
    return {
        "fraction": fraction,
        "fraction_in_this_movie": float(hot.mean()),
        "n_pixels": int(hot.sum()),
        "mean_e_per_frame": mean_e,
        **found,
    }


def detector_saturation(world: World, s: float, form: int, rng: Rng) -> Found:
    """Bright pixels give less than they should. Forms: soft x/(1+x/W), hard well, rounded."""
    peak = world.peak_e * (world.camera.em_gain if world.camera.kind == "EMCCD" else 1.0)
    if form == 0:
        loss = 0.45 * s**1.5
        well = peak * (1.0 - loss) / max(loss, 1e-6)
        world.camera.response = lambda q: q / (1.0 + np.maximum(q, 0.0) / np.float32(well))
        at_peak = 1.0 / (1.0 + peak / well)
    else:
        well = peak * (0.6 + 2.0 * (1.0 - s) ** 2) if s > 0 else 1e9
        if form == 1:
            world.camera.response = lambda q: np.minimum(q, np.float32(well))
            at_peak = min(1.0, well / peak)
        else:
            world.camera.response = lambda q: np.float32(well) * np.tanh(q / np.float32(well))
            at_peak = well / peak * np.tanh(peak / well)
    return {
        "full_well_e": float(well),
        "loss_at_nominal_peak": float(1.0 - at_peak),
        "nominal_peak_e": float(peak),
    }


def image_lag(world: World, s: float, form: int, rng: Rng) -> Found:
    """A share of the amplified signal appears later. Forms: all in the next frame, over several frames."""
    share = 0.15 * s**1.5
    kept = 0.0 if form == 0 else rng.uniform(0.4, 0.7)
    world.camera.lag = (share, float(kept))
    return {"lag_fraction": share, "kept_per_frame": float(kept)}


def baseline_drift(world: World, s: float, form: int, rng: Rng) -> Found:
    """The converter's offset moves, before the movie (dark frames) as during it; the variance stays."""
    change_adu = 2.4 * _noise_adu(world) * s * (1.0 if rng.random() < 0.5 else -1.0)
    world.camera.drift_adu = change_adu * course(form, world.n_frames, rng, n_before=world.n_dark)
    return {"change_adu": float(change_adu)}


def cosmic_rays(world: World, s: float, form: int, rng: Rng) -> Found:
    """Particles hit single pixels in single frames. Forms: one pixel, a track, a cross-shaped blob."""
    rate = 0.3 * s**1.5
    world.camera.cosmic_per_frame = rate
    world.camera.cosmic_form = form
    return {"hits_per_frame": rate, "hits_per_s": rate / world.frame_s, "median_charge_e": 600.0}


CAMERA = {
    "em_excess_noise": (em_excess_noise, ("gamma", "partly_noiseless")),
    "clock_induced_charge": (clock_induced_charge, ("parallel", "serial", "along_rows")),
    "pixel_gain_variation": (pixel_gain_variation, ("pixels", "columns_and_pixels", "dull_tail")),
    "column_offset": (column_offset, ("columns", "odd_even", "columns_and_pixels")),
    "row_noise": (row_noise, ("independent", "banded", "rare_rows")),
    "hot_pixels": (hot_pixels, ("steady", "spread", "switching")),
    "detector_saturation": (detector_saturation, ("soft", "hard", "rounded")),
    "image_lag": (image_lag, ("next_frame", "several_frames")),
    "baseline_drift": (baseline_drift, COURSES),
    "cosmic_rays": (cosmic_rays, ("single", "track", "blob")),
}
