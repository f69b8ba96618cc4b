"""Two engines, one answer: photons per frame of many copies of one chain (docs/photophysics.md).

Both run the same jump kernel. *exact* runs the full chain and counts photons at their jumps. *fast* first
merges {S0, S1} into one bright state, whose photons are then Poisson given its time in the light; dwell
times of all slow states stay event by event. The error of the merge is O(k01/k10): molecules in so much light that it
counts run by the exact engine.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.chance.streams import Streams
from napari_mufasa.errors import MufasaError
from napari_mufasa.photophysics.chain import Chain, Transition

Engine = Literal["fast", "exact"]
SEPARATION = 1e-2  # largest k01/k10, and lifetime per exposure, at which the bright state may be merged


@dataclass(frozen=True)
class Exposure:
    """The light in time: exposure and dead time of a frame in s, relative light per frame, and what each molecule gets
    of it where that changes (molecule, frame)."""

    exposure_s: float
    dead_time_s: float
    light: NDArray[np.float64]
    of_each: NDArray[np.float32] | None = None


def simulate_photons(
    chain: Chain, drive: NDArray[np.float64], exposure: Exposure, streams: Streams, engine: Engine,
    population: str = "", workers: int = 1, with_expected: bool = False,
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:  # fmt: skip
    """Photons emitted by each molecule in each frame; if asked for, how many were expected of its time in the light.

    Parameters
    ----------
    chain : the molecule's states and rates at relative light 1
    drive : (molecule,) relative light at each molecule
    exposure : frame timing and relative light per frame
    streams : every molecule draws from a stream of its own
    population : names the molecules' streams where another population has those without a name
    workers : threads that share the molecules; the result does not hang on them
    with_expected : return what was expected, too (8 bytes of a molecule and frame)
    engine : "fast" or "exact"; "fast" falls back to "exact", with a warning, for each molecule where k01/k10 > 10⁻²,
        and for all where a frame is shorter than 100 lifetimes or the chain has no single emitting transition

    Returns
    -------
    (molecule, frame) int64 and (molecule, frame) float64, the second without rows unless asked for `with_expected`. A
    photon belongs to the frame its relaxation falls in. The exact engine expects what it counts.
    """
    if engine not in ("fast", "exact"):
        raise MufasaError(f"engine {engine!r} is unknown: choose 'fast' or 'exact'")
    # Zeros that are never written take no memory.
    photons = np.zeros((drive.size, exposure.light.size), np.int64)
    expected = np.zeros((drive.size if with_expected else 0, exposure.light.size))
    emit = partial(
        _emit, drive=drive, exposure=exposure, streams=streams, population=population, workers=workers, photons=photons
    )
    exactly = np.ones(drive.size, dtype=bool)
    if engine == "fast":
        merged = merge_bright_states(chain, exposure.exposure_s)
        # Words that stay the same are told once, however many movies a diagnosis simulates.
        if isinstance(merged, str):
            warnings.warn(f"fast engine: {merged}; running the exact engine instead", stacklevel=2)
        else:
            most = drive if exposure.of_each is None else drive * np.max(exposure.of_each, axis=1, initial=0.0)
            exactly = most * np.max(exposure.light, initial=0.0) > merged.brightest_light
            if exactly.any():
                bright = f"k01/k10 exceeds {SEPARATION}; running the exact engine for the molecules where it does"
                warnings.warn(f"fast engine: {bright}", stacklevel=2)
            emit(merged.chain, merged.photon_rates, ~exactly, expected)
    if exactly.any():
        emit(chain, np.zeros(len(chain.states)), exactly, np.zeros((0, exposure.light.size)))
        if with_expected:
            kept = "all noise of emission is kept (optics.emission_noise is 1 there)"
            warnings.warn(f"exact engine: {kept}", stacklevel=2)
            expected[exactly] = photons[exactly]
    return photons, expected


@dataclass(frozen=True)
class Merged:
    """A chain with every {S0, S1} pair merged: each state's photon rate at full light, and the relative light up to
    which that is near enough."""

    chain: Chain
    photon_rates: NDArray[np.float64]
    brightest_light: float


def merge_bright_states(chain: Chain, exposure_s: float = np.inf) -> Merged | str:
    """The chain with its bright states merged, or why it cannot be.

    A merged state leaves with rate k01·p, p = k1x/Σk1, and emits with rate k01·k10/(k01+Σk1) (docs/photophysics.md).
    """
    pairs = chain.emitting_pairs()
    if not pairs:
        return "the chain has no emitting transition"
    merged, brightest = chain, np.inf
    photon_rate: dict[str, float] = {}
    for pair in pairs:
        ground, excited = pair
        up = sum(t.rate_per_s for t in chain.transitions if (t.source, t.target) == pair)
        out = [t for t in chain.transitions if t.source == excited]
        leave = sum(t.rate_per_s for t in out)
        if exposure_s * leave * SEPARATION < 1:  # photons come late by a lifetime: too late for so short a frame
            return f"a frame holds fewer than {1 / SEPARATION:.0f} lifetimes"
        into = [t for t in chain.transitions if t.target == excited]
        if any(t.driven for t in out) or any(t.source != ground or not t.driven for t in into):
            return "an emitting state is entered or left otherwise than by excitation and spontaneous decay"
        brightest = min(brightest, SEPARATION * leave / up) if up > 0 else brightest
        cycle = up * leave / (up + leave)  # cycles per second of full light
        photon_rate[ground] = sum(cycle * t.rate_per_s / leave * t.photon_probability for t in out)
        kept = [t for t in merged.transitions if excited not in (t.source, t.target)]
        kept += [
            Transition(ground, t.target, cycle * t.rate_per_s / leave, driven=True) for t in out if t.target != ground
        ]
        start = {s: p for s, p in merged.start.items() if s != excited}
        start[ground] = start.get(ground, 0.0) + merged.start.get(excited, 0.0)
        states = tuple(s for s in merged.states if s != excited)
        merged = replace(merged, states=states, transitions=tuple(kept), start=start)
    return Merged(merged, np.array([photon_rate.get(state, 0.0) for state in merged.states]), brightest)


def _emit(
    chain: Chain,
    photon_rates: NDArray[np.float64],
    whose: NDArray[np.bool_],
    expected: NDArray[np.float64],
    *,
    drive: NDArray[np.float64],
    exposure: Exposure,
    streams: Streams,
    population: str,
    workers: int,
    photons: NDArray[np.int64],
) -> None:
    """Photons of some of the molecules, `whose` (molecule,), into their rows of `photons`: counted at jumps, and of the
    time spent in emitting states; what was expected of that into those of `expected`, where it has rows."""
    from napari_mufasa.photophysics.kernels import emit

    drive = np.ascontiguousarray(drive, dtype=np.float64)
    light = np.ascontiguousarray(exposure.light, dtype=np.float64)
    each = np.empty((0, 0), np.float32) if exposure.of_each is None else np.ascontiguousarray(exposure.of_each)
    rates = chain.matrix(driven=True), chain.matrix(driven=False), chain.photon_matrix(), photon_rates
    start = np.cumsum(chain.start_vector())
    keys = streams.key(population + "photophysics"), streams.key(population + "emission")
    times = float(exposure.exposure_s), float(exposure.dead_time_s)
    which = np.flatnonzero(whose)

    def part(rows: slice) -> None:
        emit(rates, start, drive, light, each, *times, keys, which[rows], expected, photons)

    _in_parts(part, which.size, workers)


def _in_parts(work: Callable[[slice], None], n_molecules: int, workers: int) -> None:
    """Do the work on equal parts of the molecules, one thread for each; every molecule has its own streams."""
    edges = [n_molecules * i // workers for i in range(workers + 1)]
    parts = [slice(a, b) for a, b in pairwise(edges) if b > a]
    if len(parts) < 2:
        for rows in parts:
            work(rows)
        return
    with ThreadPoolExecutor(len(parts)) as pool:
        list(pool.map(work, parts))
