"""Fit one effect by direct simulation: the emulator proposes, the simulator disposes.

A few shapes are tried, then a ladder of strengths finds the right decade. Around it a handful of paired simulations
give the local mean and slopes; free values of model and effect move together, again while they still move far; then
fresh simulations at the end point judge it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.discover.coordinates import Coordinate, changed
from napari_mufasa.discover.derivatives import SLOPE_SEEDS, derivatives, free_steps, trusted
from napari_mufasa.discover.library import (
    CHECK_SEED,
    CHECK_SIMULATIONS,
    Library,
)
from napari_mufasa.discover.metric import shrunk_correlation, whitener
from napari_mufasa.discover.nearing import nearer, nearing_simulations
from napari_mufasa.discover.state import Ray, State, scaled
from napari_mufasa.effects import Effect
from napari_mufasa.model.model import Model

Array = NDArray[np.float64]
LADDER = 2.2  # factor between the strengths tried first
SHAPES = (1 / 6, 1 / 2, 5 / 6)  # of the plausible range, tried for each shape parameter
ROUND_SIMULATIONS = 9
WIDE, NARROW = 0.45, 0.2  # spread of the parameters in a round (log units or quarters of the range)
WIDEST = 1.1  # of parameters that are as uncertain as that, around an effect that enters the model
LOOSE = 2.5  # prior width of an effect's parameters in spreads of the simulations around it
MOST_ROUNDS = 3
HOPELESS = 0.5  # a start with less than this share of the evidence to beat is not fitted further
FINITE = 0.03  # relative uncertainty of a parameter from the finite number of simulations it is fitted with
SHARPENING_SIMULATIONS = 24  # around an effect that enters the model …
FAR = 2.5  # … so many standard deviations of each parameter away
SURELY_SOME = 2.0  # standard deviations that a strength must be away from none
FOLDS, LEAST_FOLLOWED = 6, 0.1  # of the simulations around a fit, and how little of the truth it may follow
PRIOR_SIMULATIONS = 6.0  # the base model's spread counts as so many simulations


@dataclass(frozen=True)
class Fit:
    """An effect fitted into a state: the state with it, the effect, its parameters' standard deviations, and how much
    wider these are for misfit that is left (Birge's ratio: the model is not quite what made the measurement)."""

    state: State
    effect: Effect
    sd: dict[str, float]
    score: float
    misfit: float
    birge: float = 1.0

    @property
    def is_some(self) -> bool:
        """Whether there is any of the effect: its strength stands out from its uncertainty by noise (what else is
        missing does not make it none) or, where only its size in proportion is sure (a logarithmic scale), reaches the
        plausible range."""
        name = self.effect.strength
        low, _, log = self.effect.plausible(self.state.model)[name]
        strength = abs(float(getattr(self.effect, name)) - self.effect.none_at(self.state.model))
        return strength > SURELY_SOME * self.sd.get(name, 0.0) / self.birge or (log and strength > low)


def planned_simulations() -> int:
    return 6 + 2 * ROUND_SIMULATIONS + CHECK_SIMULATIONS


def sharpening_simulations(library: Library, n_free: int = 0) -> int:
    """Of a fit that is sharpened; `n_free` values' derivatives and their matching with it, where it is done anew."""
    anew = SLOPE_SEEDS * n_free + nearing_simulations(library.bench) if n_free else 0
    return CHECK_SIMULATIONS + SHARPENING_SIMULATIONS + anew


def fit_effect(library: Library, state: State, starts: Effect | Sequence[Effect], x: Array) -> Fit:
    """Fit an effect into `state` so that it explains the measurement x (part, observable), from the best of `starts`:
    the same effect in different forms."""
    found = fit_if_promising(library, state, starts, x, 0.0)
    assert found is not None  # nothing to beat
    return found


def fit_if_promising(
    library: Library, state: State, starts: Effect | Sequence[Effect], x: Array, to_beat: float, promised: float = 0.0
) -> Fit | None:
    """As `fit_effect`; None where the best start gives, and the lead `promised`, far less evidence than `to_beat`.

    One simulation of an effect that is chance itself (flicker) explains less than its law does: hence the lead's word.
    """
    starts = [starts] if isinstance(starts, Effect) else starts
    seen = library.bench.read_off(starts[0].kind)
    starts = [changed(start, seen) for start in starts]
    climbed, gain = _climbed(library, state, _best_shape(library, state, starts, set(seen), x), x)
    if to_beat > 0 and max(gain, promised) < HOPELESS * to_beat:
        return None
    coordinates = [c for c in Coordinate.of(climbed, state.model) if c.name not in seen]
    n = len(coordinates)
    local = replace(
        state,
        model=library.beside(state, climbed),
        free=(*state.free, *(f"{climbed.kind}.{c.name}" for c in coordinates)),
    )
    width = WIDE
    for turn in range(MOST_ROUNDS):
        local = _linearised(library, state, local, coordinates, width, turn)
        moves = local.adjusted(x).moves
        local = replace(local, model=local.model_at(moves))
        if width == NARROW:
            break
        far = turn + 2 < MOST_ROUNDS and n > 0 and np.abs(moves[-n:]).max() > 1.5 * width
        width = WIDE if far else NARROW
    return check(library, local, x, n)


def _best_shape(library: Library, state: State, starts: Sequence[Effect], known: set[str], x: Array) -> Effect:
    """What explains most: one of `starts`, or one of them in a few shapes across the plausible range of each shape
    parameter that is not `known`; each parameter is varied once."""
    trials, start = list(starts), starts[0]
    plausible, known = type(start).plausible(state.model), known | {start.strength}
    for trial in starts:
        new = [c.name for c in Coordinate.of(trial, state.model) if c.name not in known]
        known = known.union(new)
        for name in new:
            low, high, log = plausible[name]
            for u in SHAPES:
                value = low * (high / low) ** u if log else low + (high - low) * u
                trials.append(changed(trial, {name: value}))
    if len(trials) == 1:
        return start
    rows = library.simulated([(library.beside(state, trial), k) for k, trial in enumerate(trials)])
    shift = rows - library.rows[: len(trials)]
    reached = state.mean - library.base.mean  # by the effects that are in the model already
    none = start.none_at(state.model)
    rays = [Ray(trial, change - reached, none) for trial, change in zip(trials, shift, strict=True)]
    return state.screen(x, {start.kind: rays})[start.kind][0].start()


def _climbed(library: Library, state: State, start: Effect, x: Array) -> tuple[Effect, float]:
    """`start` at the best of a ladder of strengths, each simulated once, and the fall of chi² there; the ladder
    grows while its end is best."""

    none = start.none_at(state.model)

    def misfits(factors: list[float]) -> dict[float, float]:
        rows = library.simulated([(library.beside(state, scaled(start, f, none)), k) for k, f in enumerate(factors)])
        shift = rows - library.rows[: len(factors)]
        return {f: replace(state, mean=library.base.mean + s).misfit(x) for f, s in zip(factors, shift, strict=True)}

    found = misfits([1 / LADDER, 1.0, LADDER])
    for _ in range(2):
        best = min(found, key=lambda f: found[f])
        if min(found) < best < max(found):
            break
        found |= misfits([best * LADDER if best > 1 else best / LADDER])
    best = min(found, key=lambda f: found[f])
    return scaled(start, best, none), state.misfit(x) - found[best]


def _linearised(
    library: Library, state: State, local: State, coordinates: list[Coordinate], width: float, turn: int
) -> State:
    """The neighbourhood of `local.model`: mean, slopes and spread from paired simulations around it."""
    effect, n = local.model.effects[-1], len(coordinates)
    offsets = _design(ROUND_SIMULATIONS, n, width, np.random.default_rng([library.bench.seed, turn]))
    settings = [{c.name: c.value_at(effect, b) for c, b in zip(coordinates, by, strict=True)} for by in offsets]
    jobs = [(local.model.with_effects(changed(effect, setting)), k) for k, setting in enumerate(settings)]
    shift = library.simulated(jobs) - library.rows[:ROUND_SIMULATIONS]
    centre, slopes = _regress(offsets, shift)
    wild = shift - centre - np.einsum("kd,pod->kpo", offsets, slopes)
    return replace(
        local,
        mean=library.base.mean + centre,
        spread=np.sqrt(library.base.spread**2 + (wild**2).sum(axis=0) / (ROUND_SIMULATIONS + PRIOR_SIMULATIONS)),
        slopes=np.concatenate([state.slopes, slopes], axis=2),
        prior=np.concatenate([state.prior, np.full(n, LOOSE * width)]),
    )


def check(library: Library, local: State, x: Array, n_effect: int) -> Fit:
    """Fresh simulations of the fitted model: its mean, its spread, its score."""
    n = len(local.prior) - n_effect
    local = replace(local, prior=np.concatenate([local.prior[:n], np.full(n_effect, 0.3)]))
    rows = library.simulated([(local.model, CHECK_SEED + k) for k in range(CHECK_SIMULATIONS)])
    return _checked_by(library, local, rows, x, n_effect)


def without(library: Library, state: State, kind: str, n_effect: int, x: Array) -> Fit:
    """A state without one of its effects; its last one, with `n_effect` free parameters, judged in its place."""
    keep = np.array([not path.startswith(f"{kind}.") for path in state.free])
    model = state.model.model_copy(update={"effects": tuple(e for e in state.model.effects if e.kind != kind)})
    free = tuple(path for path, stays in zip(state.free, keep, strict=True) if stays)
    local = replace(state, model=model, free=free, slopes=state.slopes[:, :, keep], prior=state.prior[keep])
    return check(library, local, x, n_effect)


def sharpen(library: Library, found: Fit, x: Array, anew: bool = False) -> Fit:
    """The fit judged by more simulations, as suits one that enters the model or has a close rival.

    Its effect is moved to its best, and simulated with parameters as far to either side as they are uncertain: few
    simulations close by cannot tell a small change from their noise. `anew`: all free values are moved, or matched
    again where that is nearer, and the derivatives of the others taken again there; where an effect changes what
    brightness or background do, the base model's derivatives lead astray.
    """
    if len(found.state.check) > CHECK_SIMULATIONS and not anew:
        return found
    local, n = found.state, n_effect(found)
    others = len(local.free) - n
    best = local.adjusted(x).moves
    if not anew:
        best[:others] = 0.0
    model = local.model_at(best)
    if anew:
        model = nearer(library, local, model, x)
    local = replace(local, model=model)

    def around(by: Array) -> Model:
        return local.model_at(by)

    uncertain = [c.steps(found.effect, found.sd[c.name] / found.birge) for c in _own_coordinates(found)]
    widths = np.clip(FAR * np.array(uncertain), NARROW, WIDEST)
    rng = np.random.default_rng([library.bench.seed, SHARPENING_SIMULATIONS])
    offsets = np.zeros((CHECK_SIMULATIONS + SHARPENING_SIMULATIONS, len(local.free)))
    offsets[CHECK_SIMULATIONS:, others:] = _design(SHARPENING_SIMULATIONS, n, widths, rng)
    numbers = [CHECK_SEED + k for k in range(CHECK_SIMULATIONS)] + list(range(SHARPENING_SIMULATIONS))
    made = library.simulated([(around(by), k) for by, k in zip(offsets, numbers, strict=True)])
    offsets = offsets[:, others:]
    _, slopes = _regress(offsets, made - _base_rows(library, len(made)))
    rows = made - np.einsum("kd,pod->kpo", offsets, slopes)  # as if all were made at the best
    fixed = local.slopes[:, :, :others]
    if anew and others:
        steps = free_steps(model, local.values, local.free)[:others]
        fixed = derivatives(library.simulated, lambda by: around(np.pad(by, (0, n))), steps, rows[CHECK_SIMULATIONS:])
    prior = np.concatenate([local.prior[:others], LOOSE * widths])
    local = replace(local, slopes=np.concatenate([fixed, slopes], axis=2), prior=prior)
    return _checked_by(library, local, rows, x, n, (made, offsets))


def lies_beyond(found: Fit, x: Array) -> bool:
    """Whether the effect's best for the measurement x lies beyond the simulations that it was judged by."""
    n = n_effect(found)
    moves, widths = found.state.adjusted(x).moves, found.state.prior / LOOSE
    return bool(np.any(np.abs(moves) > widths, where=np.arange(len(moves)) >= len(moves) - n))


def n_effect(found: Fit) -> int:
    """How many of the free values are parameters of the effect fitted last."""
    return len(_own_coordinates(found))


def _own_coordinates(found: Fit) -> list[Coordinate]:
    """The free parameters of the effect fitted last."""
    prefix = f"{found.effect.kind}."
    return [c for c in Coordinate.of(found.effect, found.state.model) if prefix + c.name in found.state.free]


def _base_rows(library: Library, n: int) -> Array:
    """The base model's first n simulations, its check simulations first: what fits are paired with."""
    return np.concatenate([library.base.check, library.rows])[:n]


def _checked_by(
    library: Library, local: State, rows: Array, x: Array, n_effect: int, around: tuple[Array, Array] | None = None
) -> Fit:
    """The fit by simulations of its model, numbered as the base model's check simulations and then as its others.

    `around`: simulations of the same numbers around it, and how far their parameters lie from it.
    """
    local = replace(local, check=rows)
    state = _of_simulations(library, local, None)
    errors, misfits = [], []
    for i in range(len(rows)):
        unaware = _of_simulations(library, state, i)
        errors.append(unaware.held_out_error(rows[i]))
        misfits.append(unaware.misfit(rows[i]))
    state = replace(state, floor=float(np.median(errors)))
    effect = state.model_at(state.adjusted(x).moves).effects[-1]
    misfit = state.misfit(x)
    birge = max(1.0, misfit / float(np.median(misfits))) ** 0.5
    # The same fit of simulations whose truth is known: what the linear theory leaves out shows in their scatter.
    if around is None:
        scatter = np.std([state.adjusted(row).moves[len(state.prior) - n_effect :] for row in rows], axis=0, ddof=1)
    else:
        scatter = _calibrated(library, state, *around)
    return Fit(state, effect, _uncertainty(state, scatter, birge, effect), state.score(x), misfit, birge)


def _of_simulations(library: Library, local: State, without: int | None) -> State:
    """The state with the mean, spread and, of many simulations, correlation that its simulations show.

    Paired with the base model's of the same numbers, so that the mean is as precise as the base's. `without` one of
    them, its twin in the base model is left out as well: it has the same chance.
    """
    rows, base_rows = local.check, library.rows
    pooled = len(rows) > CHECK_SIMULATIONS
    use, base_use = np.ones(len(rows), dtype=bool), np.ones(len(base_rows), dtype=bool)
    if without is not None:
        use[without] = False
        if without >= CHECK_SIMULATIONS:
            base_use[without - CHECK_SIMULATIONS] = False
    base_mean = base_rows[base_use].mean(axis=0)
    base_spread = np.maximum(base_rows[base_use].std(axis=0, ddof=1), local.least_spread)
    wild = rows[use] - rows[use].mean(axis=0)
    freedom = PRIOR_SIMULATIONS + len(wild) - 1
    variance = (PRIOR_SIMULATIONS * base_spread**2 + (wild**2).sum(axis=0)) / freedom
    spread = np.maximum(np.sqrt(variance), local.least_spread)
    whiten = local.whiten
    if pooled:
        scores = np.concatenate([(base_rows[base_use] - base_mean) / base_spread, wild / spread])
        whiten = np.stack([whitener(shrunk_correlation(scores[:, p])) for p in range(rows.shape[1])])
    change = (rows - _base_rows(library, len(rows)))[use].mean(axis=0)
    return replace(local, mean=base_mean + change, spread=spread, whiten=whiten)


def _calibrated(library: Library, state: State, rows: Array, offsets: Array) -> Array:
    """Standard deviations of the effect's parameters (d,) from simulations (k, part, observable) whose parameters lie
    `offsets` (k, d) from the best: how much fits scatter whose slopes have not seen them, over how much they follow.

    Slopes of noise follow nothing, however little they scatter.
    """
    others, numbers = len(state.free) - offsets.shape[1], np.arange(len(rows))
    found, change = np.empty(offsets.shape), rows - _base_rows(library, len(rows))
    for fold in range(FOLDS):
        unseen = numbers % FOLDS == fold
        _, slopes = _regress(offsets[~unseen], change[~unseen])
        unaware = replace(state, slopes=np.concatenate([state.slopes[:, :, :others], slopes], axis=2))
        found[unseen] = [unaware.adjusted(row).moves[others:] for row in rows[unseen]]
    follow = (found * offsets).sum(axis=0) / (offsets**2).sum(axis=0)
    scatter: Array = (found - follow * offsets).std(axis=0, ddof=1) / np.clip(follow, LEAST_FOLLOWED, 1.0)
    return scatter


def _uncertainty(state: State, scatter: Array, birge: float, effect: Effect) -> dict[str, float]:
    """Standard deviations of the effect's parameters: noise of the measurement and of the simulations."""
    n = len(state.prior) - len(scatter)
    slope = state.whiten[0] @ (state.slopes[0] / state.spread[0][:, None])
    loose = np.concatenate([state.prior[:n], np.full(len(scatter), 3.0)])
    covariance = np.linalg.inv(slope.T @ slope + np.diag(1 / loose**2))
    widths = np.maximum(np.sqrt(np.diag(covariance)[n:]), scatter) * birge
    named = {}
    for path, sd in zip(state.free[n:], widths, strict=True):
        coordinate = next(c for c in Coordinate.of(effect, state.model) if f"{effect.kind}.{c.name}" == path)
        by_noise, by_simulation = (
            coordinate.sd(effect, float(sd)),
            FINITE * abs(float(getattr(effect, coordinate.name))),
        )
        named[coordinate.name] = float(np.hypot(by_noise, by_simulation))
    return named


def _design(n: int, dimensions: int, width: float | Array, rng: np.random.Generator) -> Array:
    """Settings around the centre (n, dimensions): balanced, uncorrelated signs, first one at the centre."""
    if dimensions == 0:
        return np.zeros((n, 0))
    signs = np.array([[(-1) ** (k >> d & 1) for d in range(dimensions)] for k in range(n)], dtype=float)
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
