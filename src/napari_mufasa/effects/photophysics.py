"""Photophysics effects: further states, missing transitions, unequal molecules (docs/effects.md)."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.model.effect import Effect, parameter
from napari_mufasa.model.setup import Setup
from napari_mufasa.photophysics.chain import Chain, Transition
from napari_mufasa.simulate.scene import Scene

STAGE = "photophysics"


def bright_exits(
    chain: Chain, target: str, rate_per_s: float, pairs: list[tuple[str, str]] | None = None
) -> tuple[Transition, ...]:
    """Transitions from the excited state(s) that leave brightness for `target` at `rate_per_s` in full light.

    The rate out of the excited state is larger by the inverse of the time spent there; without any light
    there are none. `pairs` limits them to some (ground, excited) pairs.
    """
    exits = []
    for ground, excited in chain.emitting_pairs() if pairs is None else pairs:
        up = sum(t.rate_per_s for t in chain.transitions if (t.source, t.target) == (ground, excited))
        down = sum(t.rate_per_s for t in chain.transitions if t.source == excited)
        if up > 0:
            exits.append(Transition(excited, target, rate_per_s * (up + down) / up))
    return tuple(exits)


def with_dark_states(
    chain: Chain, prefix: str, off_rate_per_s: float, dark_times_s: list[float], weights: list[float],
    starting_dark: float = 0.0,
) -> Chain:  # fmt: skip
    """Dark states reached from the excited state; several of them make any mixture of dwell times.

    Every bright pair has dark states of its own, so that kinds of molecules never mix. `starting_dark` of
    those that would start bright start dark; who starts elsewhere (not activated, in T1) still does.
    """
    occupied = np.array(dark_times_s) * np.array(weights)  # in the steady state: how often × how long
    occupied = starting_dark * occupied / occupied.sum()
    start = dict(chain.start)
    for ground, excited in chain.emitting_pairs():
        bright = start.get(ground, 0.0)
        for i, (dwell, weight) in enumerate(zip(dark_times_s, weights, strict=True)):
            name = chain.free_name(f"{prefix}{i + 1}")
            chain = replace(chain, states=(*chain.states, name))
            back = Transition(name, ground, 1.0 / dwell)
            exits = bright_exits(chain, name, off_rate_per_s * weight, [(ground, excited)])
            chain = chain.with_transitions(back, *exits)
            start[name] = bright * float(occupied[i])
        start[ground] = bright * (1 - starting_dark)
    return chain.starting(start)


def dwell_mixture(form: str, mean_s: float) -> tuple[list[float], list[float]]:
    """Mean dwell times and weights of a dark-time law with the given mean.

    exponential: one state. two_exponential: a short and a ten times longer one. power_law: six states whose
    mixture falls as t^-1.5 over two decades.
    """
    if form == "exponential":
        return [mean_s], [1.0]
    if form == "two_exponential":
        relative, weights = np.array([0.4, 4.0]), np.array([5.0, 1.0])
    else:
        relative = np.logspace(-1, 1, 6)
        weights = relative**-0.5
    weights = weights / weights.sum()
    dwell = relative * mean_s / np.sum(relative * weights)
    return [float(d) for d in dwell], [float(w) for w in weights]


class _DarkState(Effect):
    stage = STAGE
    strength = "off_rate_per_s"
    _prefix = "D"

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        values: Any = self
        if values.off_rate_per_s == 0:
            return
        dwell, weights = dwell_mixture(values.form, values.dark_time_s)
        dark = values.off_rate_per_s * values.dark_time_s
        share = dark / (1 + dark) if values.start == "equilibrium" else 0.0
        scene.chain = with_dark_states(scene.chain, self._prefix, values.off_rate_per_s, dwell, weights, share)


class TripletBlinking(_DarkState):
    kind = "triplet_blinking"
    title = "Fast dark-state blinking"
    what_it_is = "From the excited state the molecule sometimes falls into a dark triplet or radical state."
    what_it_does = "Traces show short gaps of a few frames or less and return to the same level."
    how_to_check = (
        "Change the laser power or remove oxygen: gaps get more frequent or longer; neighbours blink independently."
    )
    observables = ("autocorrelation", "gap", "count")
    rivals = ("long_dark_state", "em_excess_noise", "molecule_diffusion")
    separated_by = "the trace autocorrelation at short lags, at another frame length"
    _prefix = "T"

    off_rate_per_s: float = parameter(
        5.0,
        ge=0,
        plausible=(0.5, 50),
        follows="/frame_s",
        unit="1/s",
        log=True,
        description="rate into the dark at full light",
    )
    dark_time_s: float = parameter(
        0.04, gt=0, plausible=(0.006, 0.08), follows="frame_s", unit="s", log=True, description="mean time in the dark"
    )
    form: Literal["exponential", "two_exponential"] = "exponential"
    start: Literal["bright", "equilibrium"] = "equilibrium"


class LongDarkState(_DarkState):
    kind = "long_dark_state"
    title = "Long dark state"
    what_it_is = "A radical, cation or cis form that holds the molecule dark for many frames."
    what_it_does = "Traces show long gaps with full return to the same level; some molecules appear lost and come back."
    how_to_check = "Record longer; a pulse of 405 nm light or a reducer brings the molecules back."
    observables = ("gap", "autocorrelation", "first_seen", "survival")
    rivals = ("triplet_blinking", "delayed_activation", "photobleaching")
    separated_by = "a longer movie: long gaps end, bleaching does not"
    _prefix = "R"

    off_rate_per_s: float = parameter(
        0.5,
        ge=0,
        plausible=(0.05, 5),
        follows="/movie_s",
        unit="1/s",
        log=True,
        description="rate into the dark at full light",
    )
    dark_time_s: float = parameter(
        0.8, gt=0, plausible=(0.09, 3), follows="frame_s", unit="s", log=True, description="mean time in the dark"
    )
    form: Literal["exponential", "power_law"] = "exponential"
    start: Literal["bright", "equilibrium"] = "bright"


class Photobleaching(Effect):
    kind = "photobleaching"
    stage = STAGE
    strength = "rate_per_s"
    title = "Photobleaching"
    what_it_is = "The excited molecule is destroyed after some number of cycles."
    what_it_does = "Spots vanish for good, each in one step; survivors keep their level."
    how_to_check = "Halve the laser power: the molecules live twice as long and give as many photons."
    observables = ("survival", "ensemble", "count")
    rivals = ("laser_drift", "focus_drift", "long_dark_state")
    separated_by = "the level of the survivors, and whether lost molecules ever return"

    rate_per_s: float = parameter(
        0.2,
        ge=0,
        plausible=(0.02, 2),
        follows="/movie_s",
        unit="1/s",
        log=True,
        description="bleaching rate at full light",
    )
    fast_fraction: float = parameter(
        0.5,
        ge=0,
        le=1,
        plausible=(0.2, 0.6),
        unit="",
        description="share of fast bleachers",
        forms=("two_populations",),
    )
    rate_ratio: float = parameter(
        5.0, ge=1, plausible=(3, 20), unit="", log=True, description="fast over slow rate", forms=("two_populations",)
    )
    form: Literal["exponential", "two_populations"] = "exponential"

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        if self.rate_per_s == 0:
            return
        if self.form == "exponential":
            populations = [(1.0, self.rate_per_s)]
        else:  # the mean rate stays rate_per_s
            slow = self.rate_per_s / (1 + self.fast_fraction * (self.rate_ratio - 1))
            populations = [(self.fast_fraction, slow * self.rate_ratio), (1 - self.fast_fraction, slow)]
        scene.chain = _bleaching(scene.chain, populations)


def _bleaching(chain: Chain, populations: list[tuple[float, float]]) -> Chain:
    """Add bleaching. Two populations are two bright copies of the chain that never mix."""
    bleached = "B" if "B" in chain.states else "bleached"
    if bleached not in chain.states:
        chain = replace(chain, states=(*chain.states, bleached))
    kinds = [chain.with_transitions(*bright_exits(chain, bleached, rate)) for _, rate in populations]
    return kinds[0] if len(kinds) == 1 else _two_kinds(kinds[0], kinds[1], bleached, populations[0][0])


def _two_kinds(one: Chain, two: Chain, shared: str, share: float) -> Chain:
    """One chain for two kinds of molecules: states of the second are primed, `shared` is common."""

    def primed(state: str) -> str:
        return state if state == shared else state + "'"

    states = (*one.states, *(primed(s) for s in two.states if s != shared))
    transitions = one.transitions + tuple(
        Transition(primed(t.source), primed(t.target), t.rate_per_s, t.driven, t.photon_probability)
        for t in two.transitions
    )
    start = {s: p * share for s, p in one.start.items()}
    start |= {primed(s): p * (1 - share) for s, p in two.start.items()}
    return Chain(states, transitions, start)


class DelayedActivation(Effect):
    kind = "delayed_activation"
    stage = STAGE
    strength = "fraction"
    order = 1  # after all that says how molecules start
    title = "Delayed activation"
    what_it_is = "Some molecules start in a dark form and turn bright later (photoactivation, binding, thawing)."
    what_it_does = "Spots appear during the movie; the number of bright molecules rises."
    how_to_check = "Record before and after a 405 nm pulse; the late spots come at once."
    observables = ("first_seen", "ensemble", "survival")
    rivals = ("molecule_diffusion", "stage_drift", "long_dark_state")
    separated_by = "the first appearance in an aperture that follows the spot"

    fraction: float = parameter(
        0.4, ge=0, le=1, plausible=(0.05, 0.9), unit="", description="share of molecules that start dark"
    )
    activation_rate_per_s: float = parameter(
        0.4,
        gt=0,
        plausible=(0.05, 3),
        follows="/movie_s",
        unit="1/s",
        log=True,
        description="rate at which they turn bright",
    )
    form: Literal["exponential", "two_step", "steady"] = "exponential"

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        if self.fraction == 0:
            return
        chain = scene.chain
        bright = ACTIVATED_AT_STAGE[self.form]
        stages = [chain.free_name(f"inactive {i}") for i in range(len(bright))]
        rate = self.activation_rate_per_s * mean_stages(bright)
        steps = [
            Transition(here, there, rate * (1 - share))
            for here, there, share in zip(stages, stages[1:], bright, strict=False)
        ]
        # Activated, a molecule is what it would have been at the start.
        steps += [
            Transition(stage, state, rate * share * p)
            for stage, share in zip(stages, bright, strict=True)
            for state, p in chain.start.items()
            if share * p > 0
        ]
        start = {state: p * (1 - self.fraction) for state, p in chain.start.items()}
        chain = replace(chain, states=(*chain.states, *stages))
        scene.chain = chain.with_transitions(*steps).starting(start | {stages[0]: self.fraction})


# Stages that an inactive molecule goes through, all at one rate, and how many of those that come to the end of each are
# activated there. Two steps: few at the very start. Steady: as many at the end of each stage, until none is left, as
# where the activating light is turned up while molecules become fewer.
STAGES = 32
ACTIVATED_AT_STAGE = {
    "exponential": (1.0,),
    "two_step": (0.0, 1.0),
    "steady": tuple(1 / (STAGES - i) for i in range(STAGES)),
}


def mean_stages(activated: Sequence[float]) -> float:
    """How many stages a molecule goes through until it is activated."""
    still_inactive = np.cumprod([1.0, *(1 - share for share in activated[:-1])])
    return float(still_inactive.sum())


class BrightnessHeterogeneity(Effect):
    kind = "brightness_heterogeneity"
    stage = STAGE
    strength = "spread"
    hides_molecules = True
    title = "Unequal brightness"
    what_it_is = (
        "Molecules differ in orientation and surroundings, so that more light is collected of some than of others."
    )
    what_it_does = "Levels differ from spot to spot; each spot keeps its own, and bleaches in one step."
    how_to_check = "Rotate the polarisation: fixed molecules change their level; count the bleaching steps: one each."
    observables = ("level_spread", "level_quantile")
    rivals = ("multiple_emitters", "illumination_profile")
    separated_by = "the number and height of bleaching steps; the level against position"

    spread: float = parameter(
        0.3, ge=0, le=3, plausible=(0.05, 0.7), unit="", description="relative spread of brightness (sd/mean)"
    )
    form: Literal["lognormal", "gamma", "two_levels", "orientations"] = "lognormal"

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        n = len(scene.brightness)
        if self.spread == 0:
            return
        if self.form == "lognormal":
            s = np.sqrt(np.log1p(self.spread**2))
            factor = rng.lognormal(-(s**2) / 2, s, n)
        elif self.form == "gamma":
            factor = rng.gamma(1 / self.spread**2, self.spread**2, n)
        elif self.form == "two_levels":  # a dim and a bright half
            factor = 1 + min(self.spread, 1.0) * rng.choice([-1.0, 1.0], n)
        else:
            factor = absorption_of_dipoles(self.spread, n, rng)
        scene.brightness = scene.brightness * factor


def absorption_of_dipoles(spread: float, n: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Relative absorption (n,) of dipoles in random directions, of mean 1 and sd `spread`.

    A fixed dipole absorbs with the square of its component along the field: in unpolarised or circularly polarised
    light sin² of its angle to the optical axis (sd 1/√5 of the mean), in linearly polarised light cos² of its angle to
    the field (sd 2/√5). A smaller spread is one of molecules that tumble for a part of the time, one in between is of
    partly polarised light; there is none beyond (means of powers of direction cosines: Fourkas, Opt. Lett. 26, 211,
    2001). Only the light that is collected follows it here, not how fast a molecule bleaches.
    """
    fixed = min(spread * 5**0.5, 1.0)
    polarised = min(max(spread**2 - 1 / 5, 0.0) / (3 / 5), 1.0) ** 0.5
    sin2 = 1 - np.square(rng.uniform(-1, 1, n))
    azimuth = rng.uniform(0, 2 * np.pi, n)
    absorbed: NDArray[np.float64] = 1.5 * sin2 * (1 + polarised * np.cos(2 * azimuth))
    return 1 - fixed + fixed * absorbed


class MultipleEmitters(Effect):
    kind = "multiple_emitters"
    stage = STAGE
    strength = "fraction"
    title = "Several emitters in a spot"
    what_it_is = "Some spots hold two or more fluorophores (oligomers, aggregates, double labelling)."
    what_it_does = "Levels are multiples of one molecule's and fall in several equal steps."
    how_to_check = "Count bleaching steps; dilute the label."
    observables = ("steps", "last_level", "level_spread", "level_quantile")
    rivals = ("brightness_heterogeneity",)
    separated_by = "the number and height of bleaching steps; more molecules"

    fraction: float = parameter(
        0.4, ge=0, le=1, plausible=(0.05, 0.9), unit="", description="share of spots with several emitters"
    )
    form: Literal["dimers", "oligomers"] = "dimers"

    @classmethod
    def same_as(cls, setup: Setup, beside: Collection[str]) -> tuple[str, ...]:
        # Where nothing turns emitters off one by one, several in a spot are one law of a spread of brightness.
        one_by_one = {"photobleaching", "long_dark_state", "triplet_blinking", "delayed_activation"}
        bleaches = setup.fluorophore.cycles_before_bleaching is not None
        return () if bleaches or one_by_one & set(beside) else ("brightness_heterogeneity",)

    def apply(self, scene: Scene, rng: np.random.Generator) -> None:
        n = len(scene.positions_px)
        several = rng.random(n) < self.fraction
        extra = several.astype(int)
        if self.form == "oligomers":
            extra = several * rng.integers(1, 4, n)
        copies = 1 + extra
        scene.positions_px = np.repeat(scene.positions_px, copies, axis=0)
        scene.brightness = np.repeat(scene.brightness, copies)
        if scene.walk_px is not None:
            scene.walk_px = np.repeat(scene.walk_px, copies, axis=1)
        if scene.light_of_each is not None:
            scene.light_of_each = np.repeat(scene.light_of_each, copies, axis=0)
        if scene.arrival is not None:
            scene.arrival = np.repeat(scene.arrival, copies)


EFFECTS = (
    TripletBlinking,
    LongDarkState,
    Photobleaching,
    DelayedActivation,
    BrightnessHeterogeneity,
    MultipleEmitters,
)
