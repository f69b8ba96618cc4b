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
    limit,
    poisson_by_inversion,
    poissons_by_rejection,
    skipped,
    stream,
    surely_below,
    uniform,
)

compiled: Any = njit(cache=True, nogil=True)
GROUP = 64  # molecules whose expected photons stay in the processor's cache until their counts are drawn


@compiled
def run(  # type: ignore[no-untyped-def]
    driven, undriven, photon_probability, photon_rate, start, drive, light, of_each, exposure_s, dead_s, key, first,
    expected, photons,
):  # fmt: skip
    """Follow molecules `first`, `first` + 1 …, one for each value of `drive`, into rows of `expected` and `photons`
    (molecule, frame) that are zero."""
    n_states = driven.shape[0]
    n_frames = light.size
    course = np.empty(n_frames)
    draws = 2 if dead_s > 0.0 else 1
    # Of each state: whether it is left at all, how often in the light that is `known`, and below which uniforms it
    # outlasts an exposure and a dead time.
    ends, leaving = np.empty(n_states, np.bool_), np.empty(n_states)
    in_light, in_dead = np.empty(n_states, np.uint64), np.empty(n_states, np.uint64)
    known = -1.0
    for source in range(n_states):
        total = 0.0
        for s in range(n_states):
            total += driven[source, s] + undriven[source, s]
        ends[source] = total == 0.0 and photon_rate[source] == 0.0
    for m in range(drive.size):
        random = stream(key, first + m, 0)
        u, random = uniform(random)
        state = 0
        while state < n_states - 1 and u >= start[state]:
            state += 1
        for f in range(n_frames):
            course[f] = drive[m] * light[f]
        if of_each.size > 0:
            for f in range(n_frames):
                course[f] *= of_each[m, f]
        absorbed = False
        f = 0
        while f < n_frames and not absorbed:
            relative = course[f]
            if relative != known:
                known = relative
                for source in range(n_states):
                    total = 0.0
                    for s in range(n_states):
                        total += relative * driven[source, s] + undriven[source, s]
                    leaving[source] = total
                    # 1 − x < e^−x: a uniform below it makes a wait that outlasts the segment. So most frames end.
                    in_light[source], in_dead[source] = limit(1.0 - total * exposure_s), limit(1.0 - total * dead_s)
            calm = f
            while calm < n_frames and course[calm] == relative and surely_below(random, 1, in_light[state]):
                if draws == 2 and not surely_below(random, 2, in_dead[state]):
                    break
                random = skipped(random, draws)
                calm += 1
            if photon_rate[state] * relative > 0.0:
                expected[m, f:calm] = photon_rate[state] * relative * exposure_s
            f = calm
            if f == n_frames or course[f] != relative:
                continue
            # Rates are constant within a segment and exponential waits have no memory, so a wait
            # that crosses the segment's end is simply drawn anew from there.
            for segment in range(2):
                left = exposure_s if segment == 0 else dead_s
                while left > 0.0:
                    total = leaving[state]
                    wait, random = exponential(random)
                    wait = wait / total if total > 0.0 else np.inf
                    stay = min(wait, left)
                    if segment == 0 and photon_rate[state] > 0.0:
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
                    absorbed = ends[state]
                    if absorbed:
                        break
                if absorbed:
                    break
            f += 1


@compiled
def draw(expected, key, first, photons):  # type: ignore[no-untyped-def]
    """Poisson counts of `expected` (molecule, frame) into `photons`, which are zero; rows are `first`, `first` + 1 …"""
    n_frames = expected.shape[1]
    bright, state = np.empty(n_frames, np.int64), np.empty(n_frames, np.uint64)
    large, u, v, counts = np.empty(n_frames), np.empty(n_frames), np.empty(n_frames), np.empty(n_frames)
    mean, none = 0.0, 1.0
    for m in range(expected.shape[0]):
        n = 0
        for f in range(n_frames):
            if expected[m, f] <= 0.0:
                continue
            if expected[m, f] >= INVERTED:
                bright[n], state[n], large[n] = f, stream(key, first + m, f), expected[m, f]
                n += 1
                continue
            # A molecule in the light all along has the same mean in every frame.
            if expected[m, f] != mean:
                mean = expected[m, f]
                none = math.exp(-mean)
            photons[m, f], _ = poisson_by_inversion(mean, none, stream(key, first + m, f))
        poissons_by_rejection(large[:n], state[:n], u, v, counts)
        for x in range(n):
            photons[m, bright[x]] = np.int64(counts[x])


@compiled
def emit(rates, start, drive, light, of_each, exposure_s, dead_s, keys, first, expected, photons):  # type: ignore[no-untyped-def]
    """`run`, by `rates` and the first of `keys`, then `draw` by the second, of a group of molecules after the other;
    what was expected is kept where `expected` has rows."""
    driven, undriven, photon_probability, photon_rate = rates
    scratch = np.empty((GROUP, light.size))
    for a in range(0, drive.size, GROUP):
        b = min(a + GROUP, drive.size)
        group = expected[a:b] if expected.size else scratch[: b - a]
        group[:] = 0.0
        own = of_each[a:b] if of_each.size else of_each
        run(
            driven, undriven, photon_probability, photon_rate, start, drive[a:b], light, own, exposure_s, dead_s,
            keys[0], first + a, group, photons[a:b],
        )  # fmt: skip
        draw(group, keys[1], first + a, photons[a:b])
