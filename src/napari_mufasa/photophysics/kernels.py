"""The jump process of many molecules, and the photons of the fast engine.

Import this module only where photons are simulated: it needs numba.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from napari_mufasa.chance.variates import exponential, poisson, stream, uniform

compiled: Any = njit(cache=True, nogil=True)


@compiled
def run(driven, undriven, photon_probability, photon_rate, start, drive, light, of_each, exposure_s, dead_s, key):  # type: ignore[no-untyped-def]
    n_states = driven.shape[0]
    n_molecules, n_frames = drive.size, light.size
    expected = np.zeros((n_molecules, n_frames))
    photons = np.zeros((n_molecules, n_frames), dtype=np.int64)
    for m in range(n_molecules):
        random = stream(key, m, 0)
        u, random = uniform(random)
        state = 0
        while state < n_states - 1 and u >= start[state]:
            state += 1
        absorbed = False
        for f in range(n_frames):
            if absorbed:
                break
            relative = drive[m] * light[f]
            if of_each.size > 0:
                relative *= of_each[m, f]
            # Rates are constant within a segment and exponential waits have no memory, so a wait
            # that crosses the segment's end is simply drawn anew from there.
            for segment in range(2):
                left = exposure_s if segment == 0 else dead_s
                while left > 0.0:
                    total = 0.0
                    for s in range(n_states):
                        total += relative * driven[state, s] + undriven[state, s]
                    wait, random = exponential(random)
                    wait = wait / total if total > 0.0 else np.inf
                    stay = min(wait, left)
                    if segment == 0:
                        expected[m, f] += photon_rate[state] * relative * stay
                    left -= stay
                    if wait > stay or total == 0.0:
                        break
                    pick, random = uniform(random)
                    pick *= total
                    target = state
                    for s in range(n_states):
                        rate = relative * driven[state, s] + undriven[state, s]
                        if rate > 0.0:
                            target = s
                            pick -= rate
                            if pick < 0.0:
                                break
                    chance = photon_probability[state, target]
                    if segment == 0 and chance > 0.0:
                        u, random = uniform(random)
                        photons[m, f] += u < chance
                    state = target
                    leaving = 0.0
                    for s in range(n_states):
                        leaving += driven[state, s] + undriven[state, s]
                    absorbed = leaving == 0.0 and photon_rate[state] == 0.0
                    if absorbed:
                        break
                if absorbed:
                    break
    return expected, photons


@compiled
def draw(expected, key):  # type: ignore[no-untyped-def]
    photons = np.empty(expected.shape, dtype=np.int64)
    for m in range(expected.shape[0]):
        for f in range(expected.shape[1]):
            photons[m, f], _ = poisson(expected[m, f], stream(key, m, f))
    return photons
