"""All free values of a model fitted together, every step simulated.

Far from a measurement a model is not linear in its values, and what they promise there is not to be had: derivatives
are taken anew at every step, a step is shortened until simulations of where it leads confirm it, and at the end the
neighbourhood is simulated anew. Prior widths of the values, which are about where they stand, are the region of trust.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.discover import library as neighbourhood
from napari_mufasa.discover import nuisance
from napari_mufasa.discover.coordinates import is_next_to_none
from napari_mufasa.discover.derivatives import derivatives, free_steps
from napari_mufasa.discover.library import Library
from napari_mufasa.discover.rules import (
    CHECK_SIMULATIONS,
    DEEPER,
    DESCENTS,
    LINEAR,
    NEARER,
    PROMISED,
    REMOVALS,
    SHARES,
    SLOPE_SEEDS,
    STEP_SIMULATIONS,
    TRIALS,
    UNSEEN,
)
from napari_mufasa.discover.state import State
from napari_mufasa.model.model import Model

Array = NDArray[np.float64]


def settled(
    library: Library, state: State, x: Array, kinds: Sequence[str], most: int, on_trial: Sequence[str] = (),
    below: float = np.inf,
) -> Library | None:  # fmt: skip
    """The neighbourhood of the state's model once all its free values are brought to the measurement x (part,
    observable) together; rays are those of `kinds` that it lacks. None where the misfit there is not `below` what it
    should be. Effects `on_trial` that come to next to none go from the model. About `most` simulations are spent, at
    least those of the neighbourhood."""
    there = brought(library, state, x, kinds, most, below)
    if not there.misfit(x) < below:
        return None
    model = there.model
    stay = [e for e in model.effects if e.kind not in on_trial or not is_next_to_none(e, model)]
    return seen_from(library, model.model_copy(update={"effects": tuple(stay)}), kinds)


def brought(library: Library, state: State, x: Array, kinds: Sequence[str], most: int, below: float = np.inf) -> State:
    """The state once all its free values are brought to the measurement x together, seen by a few simulations; of
    `most` those of a neighbourhood are left. It is given up once its misfit will not come `below` what it should be."""
    model = state.model_at(state.adjusted(x).moves)
    if state.far_off(x):
        model = nearer(library, state, model, x)
    return descended(library, state, model, x, most - _around(library, state, kinds), below)


def deepened(library: Library, x: Array, kinds: Sequence[str], most: int) -> Library | None:
    """The neighbourhood of the library's model with its free values further downhill; None where no step leads there,
    as simulations that have not shown the way confirm. Of simulations about `most` are spent, none where the slopes
    promise nothing."""
    here = library.base
    if not _promises(here, x):
        return None
    there = descended(library, here, here.model, x, most - _around(library, here, kinds))
    if there.model is here.model or not _seen(library, there, there.model, UNSEEN).misfit(x) < DEEPER * here.misfit(x):
        return None
    return seen_from(library, there.model, kinds)


def arrived(library: Library, x: Array, kinds: Sequence[str], most: int) -> Library | None:
    """The neighbourhood of where the library's free values are at their best by simulations, where its slopes put a
    parameter farther away than a model is about linear; None where they do not, or no step leads there. Of simulations
    about `most` are spent, none where it is near."""
    here = library.base
    if not np.any(np.abs(here.adjusted(x).moves[len(here.values) :]) > LINEAR):
        return None
    there = descended(library, here, here.model, x, most - _around(library, here, kinds))
    return None if there.model is here.model else seen_from(library, there.model, kinds)


def from_elsewhere(
    library: Library, state: State, model: Model, x: Array, kinds: Sequence[str], most: int, below: float
) -> Library | None:  # fmt: skip
    """The neighbourhood of where the state leads downhill from a model with other free values; None where the misfit
    there is not `below` what it should be. Of simulations about `most` are spent."""
    there = descended(library, state, model, x, most - _around(library, state, kinds), below)
    return seen_from(library, there.model, kinds) if there.misfit(x) < below else None


def seen_from(library: Library, model: Model, kinds: Sequence[str]) -> Library:
    """The neighbourhood of a model further on, its effects of `kinds` free, rays of those that it lacks (from this
    neighbourhood, where they are known)."""
    added = [effect.kind for effect in model.effects if effect.kind in kinds]
    others = [kind for kind in kinds if kind not in added]
    return neighbourhood.build(library.bench, model, others, added, library)


def _around(library: Library, state: State, kinds: Sequence[str]) -> int:
    """How many simulations the neighbourhood takes at most."""
    return neighbourhood.further_simulations(library, kinds, len(state.free), state.model)


def settling_simulations(library: Library, kinds: Sequence[str], n_free: int, model: Model) -> int:
    """How many simulations `settled` makes at most."""
    step = SLOPE_SEEDS * n_free + 2 * STEP_SIMULATIONS
    again = library.bench.matching_simulations + 2 * TRIALS
    return again + TRIALS + DESCENTS * step + neighbourhood.further_simulations(library, kinds, n_free, model)


def nearer(library: Library, state: State, model: Model, x: Array) -> Model:
    """The model, or the same with its nuisance values matched again: whichever a few simulations put nearer to the
    measurement x. Hidden effects can lead the first match astray: a pattern of the sensor passes for dim molecules.

    Either keeps within reach of the first match. Where much is wrong, matching has no end of its own: spots that equal
    molecules cannot make are looked for in ever more of them, until they merge."""
    found = [nuisance.kept(m, state.values) for m in (model, library.bench.matched(model))]
    return min(found, key=lambda candidate: _seen(library, state, candidate).misfit(x))


def descended(library: Library, state: State, model: Model, x: Array, most: int, below: float = np.inf) -> State:
    """Where the state's model gets, its free values moved downhill towards the measurement x, as far as simulations of
    where a step leads confirm it. Derivatives are taken anew where a step fails that promised much, and it ends where
    by these the misfit will not come `below` what it should be. Of simulations about `most` are spent."""
    most += library.bench.done
    here = _seen(library, state, model)
    for _ in range(DESCENTS):
        while library.bench.done + STEP_SIMULATIONS <= most and (there := _closer(library, here, x)) is not None:
            here = there
        if not _leads_far(here, x) or library.bench.done + SLOPE_SEEDS * len(here.free) + STEP_SIMULATIONS > most:
            break
        steps = free_steps(here.model, here.values, here.free)
        here = replace(here, slopes=derivatives(library.simulated, here.model_at, steps, here.check))
        if here.misfit(x) > below or (there := _closer(library, here, x)) is None:
            break
        here = there
    return here


def _closer(library: Library, here: State, x: Array) -> State | None:
    """The state one step downhill, where simulations confirm that it is nearer to x; its slopes are those that the
    step has shown (Broyden, Math. Comput. 19, 577, 1965), steps measured in prior widths."""
    moves = here.adjusted(x).moves
    for share in SHARES:
        if not _promises(here, x, share):
            break
        step = share * moves
        there = _seen(library, here, here.model_at(step))
        if _unmoved(there, x) < NEARER * _unmoved(here, x):
            direction = step / here.prior**2 / np.sum((step / here.prior) ** 2)
            surplus = there.mean - here.mean - here.slopes @ step
            return replace(there, slopes=here.slopes + surplus[..., None] * direction)
    return None


def _promises(here: State, x: Array, share: float = 1.0) -> bool:
    """Do the slopes promise that a share of the step downhill is worth its simulations?"""
    return (_unmoved(here, x) - here.misfit(x)) * share * (2 - share) > PROMISED


def _leads_far(here: State, x: Array) -> bool:
    """Do the slopes promise that the way downhill is worth derivatives of its own?"""
    return here.misfit(x) < DEEPER * _unmoved(here, x)


def removed(library: Library, *kinds: str) -> State:
    """The model that the library is about without some of its effects, its mean simulated, its free values where they
    are: how they would make up for it follows from their slopes."""
    if kinds not in library.without:
        state = _without(library.base, kinds)
        rows = library.simulated([(state.model, k) for k in range(REMOVALS)])
        mean = state.mean + (rows - library.rows[:REMOVALS]).mean(axis=0)
        library.without[kinds] = replace(state, mean=mean)
    return library.without[kinds]


def shown_worth(library: Library, kind: str, x: Array) -> float:
    """By how much likelier (−2 log likelihood) the measurement x is with an effect than without it, the others where
    slopes say that they come to: each model seen by the same few simulations, in the spread that they show. Molecules
    that bleach make a movie unlike the next; what the others leave without that is much in their own spread only."""
    if kind not in library.shown:
        bare = removed(library, kind)
        model = bare.model_at(bare.adjusted(x).moves)
        rows = library.simulated([(model, k) for k in range(CHECK_SIMULATIONS)])
        states = (library.base, library.rows[:CHECK_SIMULATIONS]), (bare, rows)
        kept, without = (_as_it_is(neighbourhood.with_noise_of(*seen)).score(x) for seen in states)
        library.shown[kind] = without - kept
    return library.shown[kind]


def left_out(library: Library, kind: str) -> Library:
    """The neighbourhood as it is, without an effect that does next to nothing there, neither beside the others nor
    without one of them: only the mean is simulated."""
    base = removed(library, kind)
    shift = base.mean - library.base.mean
    base = replace(base, check=base.check + shift).with_floor()
    without = {
        others: replace(_without(base, others), mean=state.mean + shift)
        for others, state in library.without.items()
        if kind not in others
    }
    return replace(library, base=base, rows=library.rows + shift, without=without, shown={}, formed={})


def _without(state: State, kinds: Sequence[str]) -> State:
    """The state whose model lacks some of its effects; its mean is still that of the model with them."""
    for kind in kinds:
        state = state.without(kind)
    return state


def lacking(library: Library, state: State, kind: str) -> State:
    """A state begun from the library's without one of the effects begun, the others where they are."""
    bare = state.without(kind)
    begun = bare.model.effects != library.base.model.effects
    return _seen(library, bare, bare.model) if begun else library.base


def _seen(library: Library, state: State, model: Model, seeds: range = range(TRIALS)) -> State:
    """The state with the model in its place, its mean by a few simulations."""
    rows = library.simulated([(model, k) for k in seeds])
    shift = (rows - library.rows[seeds.start : seeds.stop]).mean(axis=0)
    return replace(state, model=model, mean=library.base.mean + shift, check=rows)


def _unmoved(state: State, x: Array) -> float:
    """The misfit of the model as it is."""
    return _as_it_is(state).misfit(x)


def _as_it_is(state: State) -> State:
    """The state whose values do not move."""
    return replace(state, slopes=np.zeros_like(state.slopes))
