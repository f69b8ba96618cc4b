"""Hidden effects of the molecules: photophysics and the number of fluorophores in a spot."""

from __future__ import annotations

from typing import Any

import numpy as np

from . import laws
from .laws import Rng
from .world import DarkState, World

Found = dict[str, Any]


def _log_uniform(low: float, high: float, rng: Rng) -> float:
    return float(low * (high / low) ** rng.random())


def _leave_rate(dark_fraction: float, mean_dark_s: float) -> float:
    return dark_fraction / (1.0 - dark_fraction) / mean_dark_s


def triplet_blinking(world: World, s: float, form: int, rng: Rng) -> Found:
    """Short dark visits (half a frame to three frames). Forms: exponential, two-component, two-step."""
    mean_s = world.frame_s * _log_uniform(0.5, 3.0, rng)
    fraction = 0.7 * s
    dwell = (laws.exponential, laws.two_component, laws.two_step)[form](mean_s)
    rate = _leave_rate(fraction, mean_s)
    world.dark_states.append(DarkState(rate, dwell))
    return {"dark_fraction": fraction, "mean_dark_s": mean_s, "to_dark_rate_per_s": rate}


def long_dark_state(world: World, s: float, form: int, rng: Rng) -> Found:
    """Dark visits of many frames. Forms: exponential, power law (exponent 1.5), log-normal."""
    mean_s = world.movie_s * _log_uniform(0.03, 0.2, rng)
    fraction = 0.7 * s**1.3
    found: Found = {}
    if form == 0:
        dwell = laws.exponential(mean_s)
    elif form == 1:
        limits = (2.0 * world.frame_s, world.movie_s)
        mean_s = laws.power_law_mean_s(*limits)
        dwell = laws.power_law(*limits)
        found = {"exponent": 1.5, "shortest_s": limits[0], "longest_s": limits[1]}
    else:
        dwell = laws.log_normal(mean_s, 1.0)
        found = {"log_sigma": 1.0}
    rate = _leave_rate(fraction, mean_s)
    world.dark_states.append(DarkState(rate, dwell))
    return {"dark_fraction": fraction, "mean_dark_s": mean_s, "to_dark_rate_per_s": rate, **found}


def photobleaching(world: World, s: float, form: int, rng: Rng) -> Found:
    """A fatal dose of light. Forms: one rate, two populations of rates, two steps to the end."""
    lost = 0.8 * s
    mean_s = world.movie_s / max(-np.log1p(-lost), 1e-9)
    found: Found = {}
    if form == 0:
        dwell = laws.exponential(mean_s)
    elif form == 1:
        fast_share, ratio = 0.4, 8.0
        dwell = laws.two_component(mean_s, ratio=ratio, slow_share=1.0 - fast_share)
        found = {"fast_fraction": fast_share, "rate_ratio": ratio}
    else:
        dwell = laws.two_step(mean_s)
    earlier = world.fatal_dose
    world.fatal_dose = dwell if earlier is None else lambda r: min(earlier(r), dwell(r))
    return {"mean_life_s": mean_s, "bleaching_rate_per_s": 1.0 / mean_s, **found}


def delayed_activation(world: World, s: float, form: int, rng: Rng) -> Found:
    """A share of the molecules starts dark. Forms: one step, two steps (a lag), uniform over the movie."""
    fraction = 0.9 * s
    mean_s = world.movie_s * rng.uniform(0.2, 0.4)
    if form == 2:
        length_s, mean_s = world.movie_s, 0.5 * world.movie_s
        wait = lambda r: length_s * r.random()  # noqa: E731
    else:
        wait = (laws.exponential, laws.two_step)[form](mean_s)
    earlier = world.start_delay

    def delay(r: Rng) -> float:
        first = earlier(r) if earlier else 0.0
        return first + (wait(r) if r.random() < fraction else 0.0)

    world.start_delay = delay
    return {"inactive_fraction": fraction, "mean_activation_s": mean_s, "activation_rate_per_s": 1.0 / mean_s}


def brightness_heterogeneity(world: World, s: float, form: int, rng: Rng) -> Found:
    """Molecules differ in brightness, mean kept. Forms: log-normal, bright and dim, fixed dipoles."""
    n = len(world.brightness)
    cv = 0.6 * s
    if form == 0:
        sigma = np.sqrt(np.log1p(cv**2))
        factor = np.exp(sigma * rng.standard_normal(n) - 0.5 * sigma**2)
        found: Found = {"log_sigma": float(sigma)}
    elif form == 1:
        factor = 1.0 + cv * np.where(rng.random(n) < 0.5, 1.0, -1.0)
        found = {"bright_to_dim": (1 + cv) / (1 - cv)}
    else:
        # sin^2 of the polar angle of a random direction has mean 2/3 and sd 2/sqrt(45).
        mix = min(cv / (1.5 * 2 / np.sqrt(45)), 1.0)
        cv = mix * 1.5 * 2 / np.sqrt(45)
        factor = 1.0 + mix * (1.5 * (1.0 - rng.uniform(-1, 1, n) ** 2) - 1.0)
        found = {"fixed_share": float(mix)}
    world.brightness = world.brightness * factor
    return {"cv": float(cv), "cv_in_this_movie": float(factor.std() / factor.mean()), **found}


def multiple_emitters(world: World, s: float, form: int, rng: Rng) -> Found:
    """A share of the spots holds several fluorophores, each with its fate. Forms: dimers, 2-4, geometric."""
    n = len(world.emitters)
    fraction = 0.9 * s
    more = (
        np.full(n, 2),
        rng.integers(2, 5, n),
        np.minimum(1 + rng.geometric(0.5, n), 6),
    )[form]
    world.emitters = np.where(rng.random(n) < fraction, more, world.emitters)
    return {
        "multiple_fraction": fraction,
        "mean_emitters_per_spot": float(world.emitters.mean()),
        "emitters_per_spot": world.emitters.tolist(),
    }


SAMPLE = {
    "triplet_blinking": (triplet_blinking, ("exponential", "two_component", "two_step")),
    "long_dark_state": (long_dark_state, ("exponential", "power_law", "log_normal")),
    "photobleaching": (photobleaching, ("exponential", "two_populations", "two_step")),
    "delayed_activation": (delayed_activation, ("exponential", "two_step", "uniform")),
    "brightness_heterogeneity": (brightness_heterogeneity, ("log_normal", "two_levels", "fixed_dipoles")),
    "multiple_emitters": (multiple_emitters, ("dimers", "two_to_four", "geometric")),
}
