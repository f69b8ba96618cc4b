"""The jump process of many molecules, and the photons of the fast engine.

Import this module only where photons are simulated: it needs numba.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from napari_mufasa.chance.variates import (
    INVERTED,
    exponential,
    poisson_by_inversion,
    poisson_by_rejection,
    rejection_of,
    stream,
    uniform,
)

compiled: Any = njit(cache=True, nogil=True)


@compiled
def run(  # type: ignore[no-untyped-def]
    driven, undriven, photon_probability, photon_rate, start, drive, light, of_each, exposure_s, dead_s, key, first,
    expected, photons,
):  # fmt: skip
    """Follow molecules `first`, `first` + 1 …, one for each value of `drive`, into rows of `expected` and `photons`
    (molecule, frame) that are zero."""
    n_states = driven.shape[0]
    n_molecules, n_frames = drive.size, light.size
    spans = (exposure_s, dead_s)
    for m in range(n_molecules):
        random = stream(key, first + m, 0)
        u, random = uniform(random)
        state = 0
        while state < n_states - 1 and u >= start[state]:
            state += 1
        absorbed = False
        of_state, of_light = -1, 0.0  # what `total`, `brightness` and `stays` were worked out for
        total = brightness = 0.0
        stays = (0.0, 0.0)
        for f in range(n_frames):
            if absorbed:
                break
            relative = drive[m] * light[f]
            if of_each.size > 0:
                relative *= of_each[m, f]
            # Rates are constant within a segment and exponential waits have no memory, so a wait
            # that crosses the segment's end is simply drawn anew from there.
            for segment in range(2):
                left = spans[segment]
                while left > 0.0:
                    if state != of_state or relative != of_light:
                        total = 0.0
                        for s in range(n_states):
                            total += relative * driven[state, s] + undriven[state, s]
                        brightness = photon_rate[state] * relative
                        # 1 − x < e^−x: below it, a uniform's wait is certainly longer. Most frames end here.
                        stays = (1.0 - total * exposure_s - 1e-12, 1.0 - total * dead_s - 1e-12)
                        of_state, of_light = state, relative
                    if left == spans[segment]:
                        u, after = uniform(random)
                        if u < stays[segment]:
                            random = after
                            if segment == 0 and brightness > 0.0:
                                expected[m, f] += brightness * left
                            break
                    wait, random = exponential(random)
                    wait = wait / total if total > 0.0 else np.inf
                    stay = min(wait, left)
                    if segment == 0 and brightness > 0.0:
                        expected[m, f] += brightness * stay
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


@compiled
def draw(expected, key, first, photons):  # type: ignore[no-untyped-def]
    """Poisson counts of `expected` (molecule, frame) into `photons`, which are zero; rows are `first`, `first` + 1 …"""
    mean, none, shape = 0.0, 1.0, (0.0, 0.0, 0.0)
    for m in range(expected.shape[0]):
        for f in range(expected.shape[1]):
            if expected[m, f] <= 0.0:
                continue
            # A molecule in the light all along has the same mean in every frame.
            changed, mean = expected[m, f] != mean, expected[m, f]
            if mean < INVERTED:
                if changed:
                    none = math.exp(-mean)
                photons[m, f], _ = poisson_by_inversion(mean, none, stream(key, first + m, f))
            else:
                if changed:
                    shape = rejection_of(mean)
                photons[m, f], _ = poisson_by_rejection(mean, shape, stream(key, first + m, f))
