"""How far apart a measurement and a model are: whitened residuals, nuisance profiled out.

Residuals are measured in the model's own spread, r = (x − m)/s, correlations are those of the base model
(shrunk), and 8·asinh(r/8) keeps single wild observables from ruling. Moves of nuisance values and effect
parameters act linearly, x ≈ m + s·(J θ), and are profiled out by a few Gauss–Newton steps under their priors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from napari_mufasa.discover.rules import SOFT
from napari_mufasa.one_thread import one_thread

Array = NDArray[np.float64]
# The least spread an observable is credited with: counts that are usually zero have none in a few simulations.
FLOORS = {
    "first_seen": 0.01, "survival": 0.03, "ensemble": 0.004, "gap": 0.08, "last_level": 0.05, "steps": 0.012,
    "steps_brighter_bleach": 0.05, "left_after": 0.015,
    "narrow_bright": 0.6, "dark_narrow_bright": 0.6, "single_frame_outliers": 0.6, "repeated": 0.004,
    "dark_single_frame_outliers": 0.6, "common_shift": 0.03, "common_shift_jitter": 0.25, "background_time": 0.0004,
    "background_time_noise": 0.001,
    "dark_mean": 0.02,
    "common_mode_alternate": 0.0003, "pixel_lag": 0.0008, "neighbour": 0.0008, "dark_trend": 0.02, "dark_tail": 0.01,
    "photon_transfer": 0.003, "background_variance": 0.003, "background_skewness": 0.004, "level": 0.008,
    "background_map_bow": 0.002, "background_map_tilt": 0.002, "count_dark": 0.002,
}  # fmt: skip


def soften(r: Array) -> Array:
    result: Array = SOFT * np.arcsinh(r / SOFT)
    return result


def stretch(soft: Array) -> Array:
    """The residual that `soften` made soft."""
    result: Array = SOFT * np.sinh(np.clip(soft / SOFT, -20, 20))
    return result


def spread_floor(names: tuple[str, ...]) -> Array:
    """The least standard deviation of each observable; the longest matching prefix counts."""
    floors = []
    for name in names:
        match = max((p for p in FLOORS if name.startswith(p)), key=len, default=None)
        floors.append(FLOORS[match] if match else 1e-3)
    return np.array(floors)


@one_thread
def shrunk_correlation(z: Array, weight: float | None = None) -> Array:
    """Correlation of rows z (sample, observable), shrunk towards independence (Ledoit–Wolf weight by default)."""
    n, p = z.shape
    z = z - z.mean(axis=0)
    z = z / np.maximum(z.std(axis=0), 0.3)
    correlation = z.T @ z / n
    if weight is None:
        scatter = ((z**2).T @ (z**2) / n - correlation**2).sum() - np.trace((z**2).T @ (z**2) / n - correlation**2)
        off = (correlation**2).sum() - np.trace(correlation**2)
        weight = float(np.clip(scatter / n / max(off, 1e-9), 0.15, 0.9))
    result: Array = (1 - weight) * correlation + weight * np.eye(p)
    np.fill_diagonal(result, 1.0)
    return result


@one_thread
def whitener(correlation: Array) -> Array:
    """W with W C Wᵀ = 1."""
    values, vectors = np.linalg.eigh(correlation)
    values = np.maximum(values, 0.05)
    result: Array = (vectors / np.sqrt(values)) @ vectors.T
    return result


def _within(room: Array, slope: Array, residual: Array) -> Array:
    """The step within room (2, value) that leaves least of a linear residual: cut short value by value, a step may
    lead uphill. (Bounded-variable least squares: Stark and Parker, Comput. Stat. 10, 129, 1995.)"""
    low, high = np.minimum(room[0], -1e-12), np.maximum(room[1], 1e-12)  # where there is none, next to none
    step: Array = optimize.lsq_linear(slope, residual, (low, high), method="bvls").x
    return step


@dataclass(frozen=True)
class Adjusted:
    """A measurement seen from a model after its free values moved: chi², the moves, the whitened residual."""

    chi2: float
    moves: Array
    residual: Array
    soft: Array  # residuals before whitening


def at_the_end(moves: Array, room: Array, towards: Array) -> NDArray[np.bool_]:
    """Which free values cannot move any farther that way."""
    result: NDArray[np.bool_] = np.where(towards > 0, moves >= room[1] - 1e-9, moves <= room[0] + 1e-9)
    return result


@one_thread
def adjust(
    x: Array, mean: Array, spread: Array, jacobian: Array, prior: Array, room: Array, whiten: Array, steps: int = 6,
) -> Adjusted:  # fmt: skip
    """Move the free values (jacobian: observable × value, in units of x) to bring x and mean together.

    `prior` is the width of each value's prior around 0; its penalty counts in chi². `room` (2, value): how far each
    may move down and up.
    """
    moves = np.zeros(jacobian.shape[1])
    scaled = jacobian / spread[:, None]

    def at(moves: Array) -> tuple[float, Array, Array]:
        r = (x - mean - jacobian @ moves) / spread
        soft = soften(r)
        white = whiten @ soft
        return float(white @ white + ((moves / prior) ** 2).sum()), white, r

    best, white, r = at(moves)
    for _ in range(steps):
        slope = whiten @ (scaled / np.sqrt(1 + (r / SOFT) ** 2)[:, None])
        gram = slope.T @ slope + np.diag(1 / prior**2)
        downhill = slope.T @ white - moves / prior**2
        stuck = at_the_end(moves, room, downhill)
        gram[stuck], gram[:, stuck] = 0.0, 0.0
        gram[stuck, stuck], downhill[stuck] = 1.0, 0.0
        step = np.linalg.solve(gram, downhill)
        if np.any(moves + step < room[0]) or np.any(moves + step > room[1]):
            step = _within(room - moves, np.vstack([slope, np.diag(1 / prior)]), np.append(white, -moves / prior))
        for shrink in (1.0, 0.5, 0.2, 0.05):
            trial = np.clip(moves + shrink * step, *room)
            chi2, w, rr = at(trial)
            if chi2 < best:
                gain = best - chi2
                best, white, r, moves = chi2, w, rr, trial
                break
        else:
            break
        if gain < 0.01:
            break
    return Adjusted(best, moves, white, soften(r))
