"""Hidden effects on the way of the light: illumination, motion, optics and background."""

from __future__ import annotations

from typing import Any

import numpy as np

from .laws import COURSES, Rng, correlated, course, pink
from .world import SUBSTEPS, World

Found = dict[str, Any]


def _add(old: np.ndarray | None, new: np.ndarray) -> np.ndarray:
    return new if old is None else old + new


def _sign(rng: Rng) -> float:
    return 1.0 if rng.random() < 0.5 else -1.0


# ---- illumination ---------------------------------------------------------------------------------------
def illumination_profile(world: World, s: float, form: int, rng: Rng) -> Found:
    """Uneven light on molecules and background alike. Forms: centred, off-centre, tilt, dark rim."""
    y, x = world.grid()
    dimming = 0.85 * s**2
    y0 = x0 = 0.0
    found: Found = {}
    if form in (0, 1):
        if form == 1:
            angle = rng.uniform(0, 2 * np.pi)
            y0, x0 = 0.5 * np.sin(angle), 0.5 * np.cos(angle)
            found = {"centre_y": float(y0), "centre_x": float(x0)}
        r2 = (y - y0) ** 2 + (x - x0) ** 2
        light = np.exp(np.log1p(-dimming) * r2 / r2.max())
    elif form == 2:
        angle = rng.uniform(0, 2 * np.pi)
        along = y * np.sin(angle) + x * np.cos(angle)
        light = 1.0 - dimming * (along - along.min()) / np.ptp(along)
        found = {"angle_rad": float(angle)}
    else:
        light = 1.0 - dimming / (1.0 + np.exp(-(np.hypot(y, x) - 0.9) / 0.12))
        light /= light.max()
    world.light_map = world.light_map * light / light.mean()
    return {"edge_dimming": dimming, "min_over_max": float(light.min() / light.max()), **found}


def laser_drift(world: World, s: float, form: int, rng: Rng) -> Found:
    """The laser's power moves over the movie: molecules and background alike."""
    change = 0.5 * s**1.5 * _sign(rng)
    world.light_t = world.light_t * np.maximum(1.0 + change * course(form, world.n_frames, rng), 0.02)
    return {"relative_change": float(change)}


def laser_flicker(world: World, s: float, form: int, rng: Rng) -> Found:
    """Noise common to all molecules and the background. Forms: white, pink, correlated over a few frames."""
    rms = 0.10 * s**1.5
    found: Found = {}
    if form == 0:
        noise = rng.standard_normal(world.n_frames)
    elif form == 1:
        noise = pink(world.n_frames, rng)
    else:
        frames = rng.uniform(1.5, 5.0)
        noise = correlated(world.n_frames, frames, rng)
        found = {"correlation_frames": float(frames)}
    world.light_t = world.light_t * np.maximum(1.0 + rms * noise, 0.02)
    return {"rms": rms, **found}


def periodic_modulation(world: World, s: float, form: int, rng: Rng) -> Found:
    """A ripple of the light (aliased mains). Forms: sine, square wave, wandering phase."""
    amplitude = 0.2 * s**1.5
    period = 3.0 * (30.0 / 3.0) ** rng.random()
    phase = 2 * np.pi * (np.arange(world.n_frames) / period + rng.random())
    if form == 2:
        phase = phase + 0.15 * np.cumsum(rng.standard_normal(world.n_frames)) / np.sqrt(period)
    wave = np.sign(np.sin(phase)) / np.sqrt(2) if form == 1 else np.sin(phase)
    world.light_t = world.light_t * (1.0 + amplitude * wave)
    return {"amplitude": amplitude, "period_frames": float(period), "period_s": float(period * world.frame_s)}


# ---- motion ---------------------------------------------------------------------------------------------
def stage_drift(world: World, s: float, form: int, rng: Rng) -> Found:
    """All molecules move together. Forms: straight, curved, a jump, random walk."""
    total_px = 4.0 * s
    n = world.n_frames * SUBSTEPS
    angle = rng.uniform(0, 2 * np.pi)
    if form == 1:
        u = course(0, n, rng)
        turn = angle + _sign(rng) * 0.5 * np.pi * u
        step = np.stack([np.sin(turn), np.cos(turn)], axis=1)
        path = np.cumsum(step, axis=0)
        path /= np.hypot(*path[-1])
    elif form == 3:
        path = np.cumsum(rng.standard_normal((n, 2)), axis=0)
        path /= np.hypot(*np.ptp(path, axis=0))
    else:
        path = course(form, n, rng)[:, None] * [np.sin(angle), np.cos(angle)]
    world.shift_px = _add(world.shift_px, total_px * path)
    end = total_px * (path[-1] - path[0])
    return {
        "total_px": total_px,
        "total_nm": total_px * world.pixel_nm,
        "speed_nm_per_s": total_px * world.pixel_nm / world.movie_s,
        "end_y_px": float(end[0]),
        "end_x_px": float(end[1]),
    }


def focus_drift(world: World, s: float, form: int, rng: Rng) -> Found:
    """Spots get wider, their light stays. Forms: linear, hyperbola of a beam, breathing, walk."""
    widening = 0.6 * s
    u = course(0, world.n_frames, rng)
    if form == 0:
        width = 1.0 + widening * u
    elif form == 1:
        width = np.sqrt(1.0 + ((1.0 + widening) ** 2 - 1.0) * u**2)
    elif form == 2:
        width = 1.0 + widening * np.sin(np.pi * u * rng.uniform(1.0, 3.0)) ** 2
    else:
        width = np.sqrt(1.0 + ((1.0 + widening) ** 2 - 1.0) * course(3, world.n_frames, rng) ** 2)
    world.width_t = world.width_t * width
    return {"relative_widening": widening, "largest_width_factor": float(width.max())}


def molecule_diffusion(world: World, s: float, form: int, rng: Rng) -> Found:
    """Every molecule moves for itself. Forms: free, confined, a mobile half."""
    rms_px = 3.5 * s  # per axis, at the end of the movie, of a free molecule
    n, m = world.n_frames * SUBSTEPS, len(world.positions_px)
    found: Found = {}
    mobile = np.ones(m, bool)
    if form == 2:
        mobile = rng.random(m) < 0.5
        rms_px *= np.sqrt(2.0)
        found = {"mobile_fraction": 0.5}
    diffusion_px2_per_s = rms_px**2 / (2.0 * world.movie_s)
    step = np.sqrt(2.0 * diffusion_px2_per_s * world.frame_s / SUBSTEPS)
    kicks = step * rng.standard_normal((m, n, 2))
    if form == 1:
        radius_px = 0.5 * rms_px
        pull = step**2 / (2 * radius_px**2) if radius_px > 0 else 0.0
        walk = np.zeros((m, n, 2))
        for t in range(1, n):
            walk[:, t] = walk[:, t - 1] * (1.0 - pull) + kicks[:, t]
        found = {"confinement_rms_px": radius_px, "confinement_rms_nm": radius_px * world.pixel_nm}
    else:
        walk = np.cumsum(kicks, axis=1)
    world.wander_px = _add(world.wander_px, walk * mobile[:, None, None])
    return {
        "diffusion_px2_per_s": float(diffusion_px2_per_s),
        "diffusion_um2_per_s": float(diffusion_px2_per_s * (world.pixel_nm * 1e-3) ** 2),
        **found,
    }


# ---- optics and background ------------------------------------------------------------------------------
def _stretch(log_ratio: float, angle: float) -> np.ndarray:
    """Area-preserving stretch of a throw (y, x) along ``angle`` by exp(log_ratio)."""
    c, q = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -q], [q, c]])
    return turn @ np.diag([np.exp(0.5 * log_ratio), np.exp(-0.5 * log_ratio)]) @ turn.T


def astigmatism(world: World, s: float, form: int, rng: Rng) -> Found:
    """Elliptic spots of the same area. Forms: along an axis, at an angle, growing across the field."""
    ratio = 1.0 + 0.5 * s
    log_ratio = np.log(ratio)
    angle = (0.0 if rng.random() < 0.5 else 0.5 * np.pi) if form == 0 else rng.uniform(0, np.pi)
    matrix = _stretch(log_ratio, angle)
    if form == 2:
        nx = world.shape_px[1]

        def local(position: np.ndarray) -> np.ndarray:
            return _stretch(log_ratio * 2.0 * np.clip((position[1] + 0.5) / nx, 0.0, 1.0), angle)

        world.shape_of_spot = local
    else:
        world.shape_of_spot = lambda _position: matrix
    return {"width_ratio": ratio, "angle_from_y_rad": float(angle)}


def background_gradient(world: World, s: float, form: int, rng: Rng) -> Found:
    """Out-of-focus light that varies over the field. Forms: linear, one haze, several blobs (cells)."""
    y, x = world.grid()
    span = 1.2 * s**2
    if form == 0:
        angle = rng.uniform(0, 2 * np.pi)
        shape = y * np.sin(angle) + x * np.cos(angle)
    else:
        shape = np.zeros(world.shape_px)
        for _ in range(1 if form == 1 else int(rng.integers(3, 7))):
            y0, x0 = rng.uniform(-0.8, 0.8, 2)
            size = rng.uniform(0.5, 0.9) if form == 1 else rng.uniform(0.25, 0.45)
            shape += np.exp(-((y - y0) ** 2 + (x - x0) ** 2) / (2 * size**2))
    shape = (shape - shape.min()) / np.ptp(shape)
    haze = 1.0 + span * (shape - shape.mean())
    haze = np.maximum(haze, 0.05)
    world.background_map = world.background_map * haze / haze.mean()
    return {"peak_to_peak": float(np.ptp(haze / haze.mean()))}


def background_decay(world: World, s: float, form: int, rng: Rng) -> Found:
    """The background alone fades. Forms: exponential, two exponentials, linear."""
    lost = 0.6 * s**1.5
    u = course(0, world.n_frames, rng)
    if form == 0:
        tau = rng.uniform(0.2, 0.7)
        fade = (1 - np.exp(-u / tau)) / (1 - np.exp(-1 / tau))
    elif form == 1:
        tau = 0.08
        fade = 0.5 * (1 - np.exp(-u / tau)) + 0.5 * (1 - np.exp(-u / 0.8)) / (1 - np.exp(-1 / 0.8))
    else:
        tau, fade = float("nan"), u
    world.background_t = world.background_t * (1.0 - lost * fade)
    found = {} if form == 2 else {"time_constant_s": float(tau * world.movie_s)}
    if form == 0:
        found["decaying_share"] = float(lost / (1 - np.exp(-1 / tau)))  # what would be lost in a movie without end
    return {"relative_loss": lost, **found}


LIGHT = {
    "illumination_profile": (illumination_profile, ("centred", "off_centre", "tilt", "dark_rim")),
    "laser_drift": (laser_drift, COURSES),
    "laser_flicker": (laser_flicker, ("white", "pink", "correlated")),
    "periodic_modulation": (periodic_modulation, ("sine", "square", "wandering_phase")),
    "stage_drift": (stage_drift, ("linear", "curved", "step", "random_walk")),
    "focus_drift": (focus_drift, ("linear", "hyperbola", "breathing", "random_walk")),
    "molecule_diffusion": (molecule_diffusion, ("free", "confined", "mobile_half")),
    "astigmatism": (astigmatism, ("axis", "rotated", "across_field")),
    "background_gradient": (background_gradient, ("linear", "haze", "blobs")),
    "background_decay": (background_decay, ("exponential", "two_exponentials", "linear")),
}
