"""Light and dark periods of every emitter, kept as event lists.

A molecule is followed through its visits. Time in the bright state is counted as *dose* (seconds of nominal
light at its place), because every way out of it is driven by light; time in a dark state is counted by the
clock. Bleaching is a fatal dose drawn once. So a laser that drifts, flickers or is dim in a corner changes
blinking and bleaching as it must, with no time step.
"""

from __future__ import annotations

import numpy as np

from .laws import Rng
from .world import World

MAX_VISITS = 200_000


def bright_periods(world: World, local_light: float, rng: Rng) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One emitter: starts and ends of its bright periods as doses, and the dose at the frame edges."""
    edges_s = np.arange(world.n_frames + 1) * world.frame_s
    edges_dose = np.concatenate([[0.0], np.cumsum(np.maximum(world.light_t, 0.0))]) * world.frame_s * local_light
    budget = world.fatal_dose(rng) if world.fatal_dose else np.inf
    now_s = world.start_delay(rng) if world.start_delay else 0.0
    end_s, full_dose = edges_s[-1], edges_dose[-1]
    starts, ends = [], []
    while now_s < end_s:
        dose = float(np.interp(now_s, edges_s, edges_dose))
        wait, state = np.inf, None
        for candidate in world.dark_states:
            if candidate.rate_per_s > 0:
                drawn = -np.log1p(-rng.random()) / candidate.rate_per_s
                if drawn < wait:
                    wait, state = drawn, candidate
        lasts = min(wait, budget)
        starts.append(dose)
        ends.append(min(dose + lasts, full_dose))
        budget -= lasts
        if budget <= 0 or dose + lasts >= full_dose or state is None:
            break
        now_s = float(np.interp(dose + lasts, edges_dose, edges_s)) + state.dwell(rng)
        if len(starts) > MAX_VISITS:
            raise ValueError(f"more than {MAX_VISITS} dark visits of one molecule; lower the rates of its dark states")
    return np.array(starts), np.array(ends), edges_dose


def dose_per_frame(starts: np.ndarray, ends: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Bright dose inside each frame: how much of the disjoint, ordered periods lies between its edges."""
    if len(starts) == 0:
        return np.zeros(len(edges) - 1)
    done = np.concatenate([[0.0], np.cumsum(ends - starts)])
    k = np.searchsorted(starts, edges, side="right") - 1
    inside = np.clip(edges - starts[k], 0.0, (ends - starts)[k])
    return np.diff(np.where(k >= 0, done[k] + inside, 0.0))


def expected_photons(world: World, rng: Rng) -> np.ndarray:
    """Mean photons at the detector, (molecule, frame), given every emitter's history."""
    light = world.light_at(world.positions_px)
    mean = np.zeros((len(world.positions_px), world.n_frames))
    for i, n in enumerate(world.emitters):
        for _ in range(int(n)):
            mean[i] += dose_per_frame(*bright_periods(world, float(light[i]), rng))
    mean *= world.photons_per_s * world.brightness[:, None]
    return mean if world.level is None else mean * world.level
