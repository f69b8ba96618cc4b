"""The jump process of many molecules, and the photons of the fast engine.

A state lasts until its rate of being left, added up over the time in it, has come to a number that is drawn once, with
the exponential law of mean 1, whatever light comes meanwhile (the time change of a point process: Daley and
Vere-Jones, An Introduction to the Theory of Point Processes I, 2nd ed., section 7.4). So frames in which nothing
happens cost no chance.

Import this module only where photons are simulated: it needs numba.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from napari_mufasa.chance.variates import (
    SMOOTH,
    exponential,
    first_tail,
    poisson_by_inversion,
    poisson_quantiles,
    stream,
    uniform,
)

compiled: Any = njit(cache=True, nogil=True)


@compiled
def alike(light, until):  # type: ignore[no-untyped-def]
    """Of each frame the first one after it in which the light is another, into `until` (frame,)."""
    last = light.size
    for f in range(light.size - 1, -1, -1):
        if f + 1 < light.size and light[f + 1] != light[f]:
            last = f + 1
        until[f] = last


@compiled
def follow(rates, left_by, start, light, until, exposure_s, dead_s, random, lit, means, photons):  # type: ignore[no-untyped-def]
    """Follow one molecule by its stream: photons counted at jumps into `photons` (frame,), zeros, and of its time in
    emitting states the frames and the photons expected there into the beginnings of `lit` and `means` (frame,); returns
    how many they are. `left_by` (state, 2): the rates at which states are left in the light and without."""
    driven, undriven, photon_probability, photon_rate = rates
    u, random = uniform(random)
    state, n = 0, 0
    while state < start.size - 1 and u >= start[state]:
        state += 1
    life, random = exponential(random)  # that is left of the state, in its own mean lives
    f = 0
    while f < light.size and (left_by[state, 0] > 0.0 or left_by[state, 1] > 0.0 or photon_rate[state] > 0.0):
        relative = light[f]
        leaving = relative * left_by[state, 0] + left_by[state, 1]
        each = leaving * (exposure_s + dead_s)
        calm = until[f] if life >= each * (until[f] - f) else f + int(life / each)
        if calm > f:
            mean = photon_rate[state] * relative * exposure_s
            if mean > 0.0:
                for k in range(calm - f):
                    lit[n + k], means[n + k] = f + k, mean
                n += calm - f
            life = max(life - each * (calm - f), 0.0)
            f = calm
            continue
        mean = 0.0
        for segment in range(2):
            left = exposure_s if segment == 0 else dead_s
            while left > 0.0:
                leaving = relative * left_by[state, 0] + left_by[state, 1]
                stays = life >= leaving * left
                stay = left if stays else life / leaving
                if segment == 0:
                    mean += photon_rate[state] * relative * stay
                if stays:
                    life -= leaving * left
                    break
                left -= stay
                pick, random = uniform(random)
                pick *= leaving
                target = state
                for s in range(start.size):
                    rate = relative * driven[state, s] + undriven[state, s]
                    if rate > 0.0:
                        target = s
                        pick -= rate
                        if pick < 0.0:
                            break
                chance = photon_probability[state, target]
                if segment == 0 and chance > 0.0:
                    u, random = uniform(random)
                    photons[f] += u < chance
                state = target
                life, random = exponential(random)
        if mean > 0.0:
            lit[n], means[n] = f, mean
            n += 1
        f += 1
    return n


@compiled
def draw(lit, means, key, molecule, large, tail, counts, photons):  # type: ignore[no-untyped-def]
    """Poisson counts of `means` in the frames `lit` into `photons` (frame,); the three before it are scratch (frame,),
    and so is `lit` then."""
    mean, none, n = 0.0, 1.0, 0
    for x in range(lit.size):
        named = stream(key, molecule, lit[x])
        if means[x] >= SMOOTH:
            lit[n], large[n], tail[n] = lit[x], means[x], first_tail(named)
            n += 1
            continue
        # A molecule in the light all along has the same mean in every frame.
        if means[x] != mean:
            mean = means[x]
            none = math.exp(-mean)
        photons[lit[x]], _ = poisson_by_inversion(mean, none, named)
    poisson_quantiles(large[:n], tail[:n], counts)
    for x in range(n):
        photons[lit[x]] = np.int64(counts[x])


@compiled
def emit(rates, start, drive, light, of_each, exposure_s, dead_s, keys, which, expected, photons):  # type: ignore[no-untyped-def]
    """Follow the molecules `which` by the first of `keys`, and draw their photons by the second into `photons`
    (molecule, frame), zeros; what was expected is kept where `expected` has rows, zeros too. A molecule's row is its
    number."""
    n_frames = light.size
    own, until, lit = np.empty(n_frames), np.empty(n_frames, np.int64), np.empty(n_frames, np.int64)
    means, large, tail, counts = (
        np.empty(n_frames),
        np.empty(n_frames),
        np.empty(n_frames, np.float32),
        np.empty(n_frames),
    )
    left_by = np.stack((rates[0].sum(axis=1), rates[1].sum(axis=1)), axis=1)
    alike(light, until)
    for m in which:
        for f in range(n_frames):
            own[f] = drive[m] * light[f]
        if of_each.size > 0:
            for f in range(n_frames):
                own[f] *= of_each[m, f]
            alike(own, until)
        named = stream(keys[0], m, 0)
        n = follow(rates, left_by, start, own, until, exposure_s, dead_s, named, lit, means, photons[m])
        if expected.size > 0:
            for x in range(n):
                expected[m, lit[x]] = means[x]
        draw(lit[:n], means[:n], keys[1], m, large, tail, counts, photons[m])
