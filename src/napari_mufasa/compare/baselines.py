"""The two models a comparison is held against: Poisson and SOFI Simulation Tools (docs/comparison.md)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.model.model import Model
from napari_mufasa.photophysics import rates
from napari_mufasa.photophysics.chain import Chain
from napari_mufasa.photophysics.engines import merge_bright_states
from napari_mufasa.photophysics.protocols import protocol_chain


def poisson_mean_photons(model: Model) -> float:
    """µ = k01·Δt·QY: photons per frame of a molecule that is never dark."""
    dye, light = model.fluorophore, model.excitation
    k01 = rates.excitation_rate(dye.extinction_coefficient_per_M_cm, light.power_density_w_per_cm2, light.wavelength_nm)
    return k01 * model.acquisition.frame_length_s * dye.quantum_yield


def poisson_emission(model: Model, n_molecules: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Homogeneous Poisson photons, (molecule, frame): no dark states, no bleaching."""
    shape = (n_molecules, model.acquisition.n_frames)
    return np.asarray(rng.poisson(poisson_mean_photons(model), shape), dtype=np.int64)


def poisson_image(model: Model, n_molecules: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """The same as images are made of it: with the share of its noise that the model's optics keep in the image."""
    mean = poisson_mean_photons(model)
    kept = float(np.sqrt(model.optics.emission_noise))
    return np.asarray(mean + kept * (poisson_emission(model, n_molecules, rng) - mean), dtype=np.float64)


@dataclass(frozen=True)
class TwoState:
    """The model of SOFI Simulation Tools. Times in s (inf: never); photons per frame while on."""

    on_s: float
    off_s: float
    bleach_s: float
    photons_per_frame: float
    start_on: float = 1.0  # probability


def two_state_of(model: Model, photons_per_frame: float, chain: Chain | None = None) -> TwoState:
    """The two-state model with the time scales of a chain (None: that of the model's protocol).

    T_on and the bleaching time are the mean times in the merged bright state until it goes dark, or for
    good; T_off is the mean time to return. `photons_per_frame` is I_on, see `largest_of_a_trace`.
    """
    chain = chain or protocol_chain(model)
    merged = merge_bright_states(chain)
    if isinstance(merged, str):
        return TwoState(np.inf, 0.0, np.inf, photons_per_frame)
    slow, photon_rate = merged.chain, merged.photon_rates
    rate = slow.matrix(driven=True) + slow.matrix(driven=False)
    bright = photon_rate > 0
    occupied = bright * slow.start_vector()
    weight = occupied / occupied.sum() if occupied.sum() > 0 else bright / bright.sum()
    returns = _mean_return_time(rate, bright)
    lost = ~np.isfinite(returns)
    into_dark = rate * (~bright & ~lost)
    to_dark = float(weight @ into_dark.sum(axis=1))
    to_loss = float(weight @ (rate * lost).sum(axis=1))
    off_s = float((weight @ into_dark)[~lost] @ returns[~lost] / to_dark) if to_dark > 0 else 0.0
    start = slow.start_vector()
    if to_dark == 0 and start[~bright & ~lost].sum() > 0:  # only a delayed start is dark (PALM)
        dark = start * (~bright & ~lost)
        off_s = float(dark[~lost] @ returns[~lost] / dark.sum())
    return TwoState(
        on_s=1 / to_dark if to_dark > 0 else np.inf,
        off_s=off_s,
        bleach_s=1 / to_loss if to_loss > 0 else np.inf,
        photons_per_frame=photons_per_frame,
        start_on=float(start[bright].sum()),
    )


def tool_defaults(photons_per_frame: float) -> TwoState:
    """The two-state model with the times SOFI Simulation Tools starts with: on 20 ms, off 40 ms, bleaching 80 s.

    In the tool a molecule starts on with the probability of the steady state.
    """
    return TwoState(0.020, 0.040, 80.0, photons_per_frame, start_on=1 / 3)


def largest_of_a_trace(emission: NDArray[np.integer]) -> float:
    """The largest value of a trace of emission (molecule, frame), on average over the molecules that emit.

    The source sets I_on to "the maximum value observed in the MUFASA-generated photon trace". The largest value
    of all traces together would grow with the number of molecules simulated.
    """
    largest = emission.max(axis=1, initial=0)
    return float(largest[largest > 0].mean()) if (largest > 0).any() else 0.0


def sofi_emission(
    two_state: TwoState, n_molecules: int, n_frames: int, frame_length_s: float, interval_s: float,
    rng: np.random.Generator,
) -> NDArray[np.float64]:  # fmt: skip
    """Photons per molecule and frame: I_on times the share of the exposure spent on (source note 4).

    On and off times are exponential; bleaching ends the light after an exponential time **spent on**.
    """
    edges = np.arange(n_frames) * interval_s
    ends = edges + frame_length_s
    total_s = n_frames * interval_s
    emission = np.zeros((n_molecules, n_frames))
    for i in range(n_molecules):
        times, lit_until = _switching(two_state, total_s, rng)
        on_time = np.interp(ends, times, lit_until) - np.interp(edges, times, lit_until)
        emission[i] = two_state.photons_per_frame * on_time / frame_length_s
    return emission


def _switching(
    two_state: TwoState, total_s: float, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Times of switching and the time spent on until each: a broken line to interpolate."""
    life_s = _exponential(two_state.bleach_s, rng)
    times, lit = [0.0], [0.0]
    on = rng.random() < two_state.start_on
    while times[-1] < total_s and lit[-1] < life_s:
        stay = _exponential(two_state.on_s if on else two_state.off_s, rng)
        if on:
            stay = min(stay, life_s - lit[-1])
        stay = min(stay, total_s - times[-1]) if not np.isfinite(stay) else stay
        times.append(times[-1] + stay)
        lit.append(lit[-1] + stay * on)
        on = not on
    times.append(max(times[-1], total_s) + 1.0)
    lit.append(lit[-1])
    return np.array(times), np.array(lit)


def _exponential(mean_s: float, rng: np.random.Generator) -> float:
    return float(mean_s) if not np.isfinite(mean_s) or mean_s <= 0 else float(rng.exponential(mean_s))


def _mean_return_time(rate: NDArray[np.float64], bright: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Mean time from each state to the bright ones; inf for states that never return, 0 for bright ones."""
    n = len(rate)
    reach = bright.copy()
    for _ in range(n):
        reach |= (rate > 0) @ reach
    result = np.where(bright, 0.0, np.inf)
    dark = np.flatnonzero(reach & ~bright)
    if len(dark):
        # Leaks from a dark state to loss are left out: T_off is the time of those that do return.
        inner = rate[np.ix_(dark, dark)]
        out = rate[dark][:, reach].sum(axis=1)
        result[dark] = np.linalg.solve(np.diag(out) - inner, np.ones(len(dark)))
    return result
