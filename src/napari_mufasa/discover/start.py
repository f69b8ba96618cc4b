"""From a lead to a start: the form, shape and strength from which an effect is fitted, by a few simulations each.

The emulator proposes: what rays promise is checked by simulations. A few shapes are tried, then a ladder of strengths
finds the right decade; a handful of paired simulations around it give the local mean and slopes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.discover.coordinates import Coordinate, changed
from napari_mufasa.discover.derivatives import trusted
from napari_mufasa.discover.library import Library, read_by_halves
from napari_mufasa.discover.rules import (
    AROUND,
    AROUND_WIDTH,
    FORM_WORTH,
    LADDER,
    PLAIN,
    PRIOR_SIMULATIONS,
    SHAPES_TRIED,
    START_PRIOR,
    UNREAD,
)
from napari_mufasa.discover.state import Lead, Ray, State, scaled
from napari_mufasa.effects import Effect

Array = NDArray[np.float64]
HADAMARD = (1, 2, 4, 7, 3, 5, 6)  # its columns, those first that are each one's own bit


def started(library: Library, state: State, leads: Sequence[Lead], x: Array) -> State:
    """The state with an effect beside the others, in the best of its promising forms, where it explains most of the
    measurement x (part, observable). `leads`: what its forms promise, the best first."""
    best, *others = leads
    worth = [best, *(lead for lead in others if lead.gain > FORM_WORTH * best.gain or lead.may_be_stronger)]
    seen = library.bench.read_off(best.ray.effect.kind, state.model)
    starts = [changed(lead.start(), seen) for lead in worth]
    plain = type(starts[0])().chosen
    found = [begun(library, state, starts, x)]
    plain_starts = [start for start in starts if start.chosen == plain]
    if plain_starts and found[0].model.effects[-1].chosen != plain:
        found.append(begun(library, state, plain_starts, x))
    return min(found, key=lambda s: s.misfit(x) - PLAIN * (s.model.effects[-1].chosen == plain))


def begun(library: Library, state: State, starts: Sequence[Effect], x: Array, apart: bool = False) -> State:
    """The state with the best of `starts` (one effect in different forms) beside its effects, at its best shape and
    strength, free in both but for what the measurement shows of it directly. The form is the one that promises most;
    where the forms are judged `apart`, or that which is nearest on its ladder of strengths, if it is nearer once begun.
    """
    seen = set(library.bench.read_off(starts[0].kind))
    shapes = _best_shapes(library, state, starts, seen, x)
    climbed = [_climbed(library, state, shape, x) for shape in (shapes if apart else shapes[:1])]
    promising, nearest = climbed[0], min(climbed, key=lambda found: found[1])
    finalists = [promising] if nearest is promising else [promising, nearest]
    found = [_linearised(library, state, effect, seen) for effect, _ in finalists]
    return min(found, key=lambda begun_here: begun_here.misfit(x))


def _best_shapes(library: Library, state: State, starts: Sequence[Effect], known: set[str], x: Array) -> list[Effect]:
    """Of each form what promises most: one of `starts`, or one of them in a few shapes across the plausible range of
    each of its shape parameters that is not `known`: forms are compared where each of them is at its best."""
    trials, start = list(starts), starts[0]
    plausible, known = type(start).plausible(state.model), known | {start.strength}
    for trial in starts:
        for name in (c.name for c in Coordinate.of(trial, state.model) if c.name not in known):
            low, high, log = plausible[name]
            for u in SHAPES_TRIED:
                value = low * (high / low) ** u if log else low + (high - low) * u
                trials.append(changed(trial, {name: value}))
    if len(trials) == 1:
        return [start]
    rows = library.simulated([(library.beside(state, trial), k) for k, trial in enumerate(trials)])
    shift = rows - library.rows[: len(trials)]
    reached = state.mean - library.base.mean  # by the effects that are in the model already
    none = start.none_at(state.model)
    rays = [Ray(trial, change - reached, none) for trial, change in zip(trials, shift, strict=True)]
    return [lead.start() for lead in state.screen(x, {start.kind: rays})[start.kind]]


def _climbed(library: Library, state: State, start: Effect, x: Array) -> tuple[Effect, float]:
    """`start` at the best of a ladder of strengths, each simulated once, and the misfit there; it grows while its end
    is best, and ends where the strength's range does."""
    none = start.none_at(state.model)
    strength = [c for c in Coordinate.of(start, state.model) if c.name == start.strength]

    def rung(factor: float) -> Effect:
        there = scaled(start, factor, none)
        return changed(there, {c.name: c.kept(getattr(there, c.name), getattr(start, c.name)) for c in strength})

    def misfits(factors: list[float]) -> dict[float, float]:
        rows = library.simulated([(library.beside(state, rung(f)), k) for k, f in enumerate(factors)])
        shift = rows - library.rows[: len(factors)]
        return {f: replace(state, mean=library.base.mean + s).misfit(x) for f, s in zip(factors, shift, strict=True)}

    found = misfits([1 / LADDER, 1.0, LADDER])
    for _ in range(2):
        best = min(found, key=lambda f: found[f])
        if min(found) < best < max(found):
            break
        found |= misfits([best * LADDER if best > 1 else best / LADDER])
    best = min(found, key=lambda f: found[f])
    return rung(best), found[best]


def _linearised(library: Library, state: State, effect: Effect, known: set[str]) -> State:
    """The state with an effect beside the others, free but for what is `known` of it: mean, slopes and spread from
    paired simulations around it."""
    coordinates = [c for c in Coordinate.of(effect, state.model) if c.name not in known]
    free = (*state.free, *(f"{effect.kind}.{c.name}" for c in coordinates))
    local, n = replace(state, model=library.beside(state, effect), free=free), len(coordinates)
    offsets = _design(AROUND, n, AROUND_WIDTH, np.random.default_rng([library.bench.seed, AROUND]))
    settings = [{c.name: c.value_at(effect, b) for c, b in zip(coordinates, by, strict=True)} for by in offsets]
    jobs = [(local.model.with_effects(changed(effect, setting)), k) for k, setting in enumerate(settings)]
    shift = library.simulated(jobs) - library.rows[:AROUND]
    centre, slopes = _regress(offsets, shift)
    unread = dict(state.unread)
    if any(effect.matters(name) for name in known):
        rows = library.simulated([(local.model, k) for k in range(UNREAD)])
        unread[effect.kind] = read_by_halves(library, local.model, effect.kind, rows)
    wild = shift - centre - np.einsum("kd,pod->kpo", offsets, slopes)
    return replace(
        local,
        mean=library.base.mean + centre,
        spread=np.sqrt(library.base.spread**2 + (wild**2).sum(axis=0) / (AROUND + PRIOR_SIMULATIONS)),
        slopes=np.concatenate([state.slopes, slopes], axis=2),
        prior=np.concatenate([state.prior, np.full(n, START_PRIOR * AROUND_WIDTH)]),
        unread=unread,
    )


def _design(n: int, dimensions: int, width: float, rng: np.random.Generator) -> Array:
    """Settings around the centre (n, dimensions): first one at the centre, then balanced, uncorrelated signs (of up to
    seven dimensions in each eight, columns of a Hadamard matrix)."""
    if dimensions == 0:
        return np.zeros((n, 0))
    columns = [HADAMARD[d % len(HADAMARD)] for d in range(dimensions)]
    signs = np.array([[(-1) ** (k & column).bit_count() for column in columns] for k in range(n)], dtype=float)
    jitter = rng.uniform(0.6, 1.2, signs.shape)
    signs[0] = 0.0
    return signs * jitter * width


def _regress(offsets: Array, shift: Array) -> tuple[Array, Array]:
    """Linear fit of shift (k, part, observable) on offsets (k, d): value at the centre, slopes (…, d)."""
    k, d = offsets.shape
    design = np.concatenate([np.ones((k, 1)), offsets], axis=1)
    inverse = np.linalg.inv(design.T @ design + np.diag([0.0, *np.full(d, 1e-3)]))
    solution = np.einsum("de,ke,kpo->dpo", inverse, design, shift)
    rest = shift - np.einsum("kd,dpo->kpo", design, solution)
    error = (rest**2).sum(axis=0) / max(k - d - 1, 1) * np.diag(inverse)[1:, None, None]
    # What is no larger than its own error is noise, which would pass for information about the parameter.
    slopes = solution[1:] * trusted(solution[1:], error)
    return solution[0], np.moveaxis(slopes, 0, -1)
