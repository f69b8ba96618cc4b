"""Simulated neighbourhoods: where a model stands, what its free values do, what each effect would do.

An effect enters as rays: simulations at a few strengths, shapes and forms, each minus the base simulation
of the same seed. Along a ray the shift grows with strength. A ray that explains the residual is a lead; the
fit (`fit.refine`) decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, get_args, get_origin

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.discover import nuisance
from napari_mufasa.discover.bench import Bench
from napari_mufasa.discover.coordinates import Coordinate, changed, moved, room
from napari_mufasa.discover.metric import (
    SOFT,
    Profile,
    at_the_end,
    profile,
    shrunk_correlation,
    spread_floor,
    stretch,
    whitener,
)
from napari_mufasa.discover.nearing import MATCHING_ROUNDS, SLOPE_SEEDS, derivatives, free_steps
from napari_mufasa.effects import Effect, catalogue
from napari_mufasa.model import Model
from napari_mufasa.observe import PARTS

Array = NDArray[np.float64]
BASE_SIMULATIONS = 60
CHECK_SIMULATIONS = 12  # fresh seeds that no mean, spread or correlation has seen
CHECK_SEED = 5_000
PARAMETER_PRIOR = 0.5  # of effects in the model, in log units or quarters of the range
RAYS = 4  # settings of each effect, plus one for each shape parameter
AT_FLOOR = 1.15  # a held-out error within this factor of its floor is at the floor
FAR_OFF = 2.5  # an error of more floors than this is far off
SCALES = (0.12, 0.25, 0.45, 0.7, 1.0, 1.4)


@dataclass(frozen=True)
class Ray:
    """One effect at one setting, and the shift of the observables it makes (part, observable)."""

    effect: Effect
    shift: Array


@dataclass(frozen=True)
class Lead:
    """The best ray of an effect: the fall of chi² it promises, and how far along."""

    gain: float
    ray: Ray
    scale: float

    @property
    def may_be_stronger(self) -> bool:
        """Whether the ray ends there: a stronger effect may promise more."""
        return abs(self.scale) == max(SCALES)

    def start(self) -> Effect:
        """The ray's effect at the strength the lead stands at, within hard limits."""
        return scaled(self.ray.effect, self.scale)


@dataclass(frozen=True)
class State:
    """A model with its effects, and what simulations of it show.

    mean, spread (part, observable) · slopes (part, observable, free value), free values with prior widths: the
    nuisance values (`values`) first, then effect parameters · whiten (part, observable, observable) · check
    (simulation, part, observable) simulations of fresh seeds · least_spread (observable,) · floor: the held-out error
    that the model itself scores, its own simulations taken as measurements, none judged by a mean it helped to make
    """

    model: Model
    mean: Array
    spread: Array
    slopes: Array
    prior: Array
    whiten: Array
    check: Array
    free: tuple[str, ...]
    least_spread: Array
    values: tuple[nuisance.Nuisance, ...] = ()
    floor: float = 1.0

    def moved(self, moves: Array) -> Model:
        """The model with its free values moved."""
        return moved(self.model, self.values, self.free, moves)

    def profiled(self, x: Array, part: int = 0) -> Profile:
        """The measurement x (part, observable) against this model, free values moved."""
        return profile(
            x[part], self.mean[part], self.spread[part], self.slopes[part], self.prior, self.room, self.whiten[part]
        )

    @cached_property
    def room(self) -> Array:
        """How far the free values may move (2, value)."""
        return room(self.model, self.values, self.free)

    def held_out_error(self, x: Array) -> float:
        """rms whitened residual of each half of the field, free values fitted on the other half."""
        white, black = PARTS.index("white"), PARTS.index("black")
        squares = [self._held_out(x, fit, held) for fit, held in ((white, black), (black, white))]
        return float(np.sqrt(np.mean(squares)))

    def _held_out(self, x: Array, fit: int, held: int) -> Array:
        """Squares of the whitened residuals of one half, free values fitted on the other."""
        moves = self.profiled(x, fit).moves
        still = profile(
            x[held], self.mean[held] + self.slopes[held] @ moves, self.spread[held],
            np.zeros((x.shape[1], 0)), np.zeros(0), np.zeros((2, 0)), self.whiten[held], steps=0,
        )  # fmt: skip
        return np.square(still.residual)

    def at_floor(self, x: Array) -> bool:
        return self.held_out_error(x) <= AT_FLOOR * self.floor

    def far_off(self, x: Array) -> bool:
        """Is so much wrong that several things must be missing?"""
        return self.held_out_error(x) > FAR_OFF * self.floor

    def misfit(self, x: Array) -> float:
        return self.profiled(x).chi2

    def score(self, x: Array) -> float:
        """−2 log likelihood, up to a constant all models share."""
        return self.misfit(x) + 2 * float(np.log(self.spread[0]).sum() - np.linalg.slogdet(self.whiten[0])[1])

    def screen(self, x: Array, rays: dict[str, list[Ray]]) -> dict[str, list[Lead]]:
        """Per effect: the largest fall of chi² along any ray of each of its forms, best form first."""
        w = self.whiten[0]
        start = self.profiled(x)
        spread = self.spread[0]
        # Locally linear: directions of free values are projected out of residual and rays alike.
        local = 1 / np.sqrt(1 + np.sinh(np.clip(start.soft / SOFT, -20, 20)) ** 2)
        slope = np.vstack([w @ (self.slopes[0] / spread[:, None] * local[:, None]), np.diag(1 / self.prior)])
        full = np.concatenate([start.residual, -start.moves / self.prior])
        q, _ = np.linalg.qr(slope[:, ~at_the_end(start.moves, self.room, slope.T @ full)])
        raw = stretch(start.soft)
        found: dict[str, list[Lead]] = {}
        for kind, candidates in rays.items():
            best: dict[str, Lead] = {}
            scales = (*SCALES, *(-s for s in SCALES)) if candidates and two_sided(candidates[0].effect) else SCALES
            for ray in candidates:
                shifts = np.outer(scales, ray.shift[0] / spread)
                taken = start.soft - SOFT * np.arcsinh((raw - shifts) / SOFT)
                rest = full - np.pad(taken @ w.T, ((0, 0), (0, len(self.prior))))
                rest -= (rest @ q) @ q.T
                gains = start.chi2 - (rest**2).sum(axis=1)
                i = int(np.argmax(gains))
                form = ray.effect.form_name
                if form not in best or gains[i] > best[form].gain:
                    best[form] = Lead(float(gains[i]), ray, scales[i])
            found[kind] = sorted(best.values(), key=lambda lead: -lead.gain)
        return found


@dataclass(frozen=True)
class Library:
    """The base state, its paired simulations (simulation, part, observable) and rays."""

    bench: Bench
    base: State
    rows: Array
    rays: dict[str, list[Ray]]

    def null_distribution(self, folds: int = 4) -> tuple[Array, Array]:
        """Largest evidence and misfit of base simulations taken as measurements.

        None of them is judged by a mean, spread or correlation that it helped to make: each fold by those of
        the other folds, the check simulations by those of all.
        """
        evidence, misfit = [], []
        fold_of = np.arange(len(self.rows)) % folds
        trials = [(_with_noise_of(self.base, self.rows[fold_of != f]), self.rows[fold_of == f]) for f in range(folds)]
        for state, unseen in [*trials, (self.base, self.base.check)]:
            for x in unseen:
                misfit.append(state.misfit(x))
                evidence.append(max((forms[0].gain for forms in state.screen(x, self.rays).values()), default=0.0))
        return np.array(evidence), np.array(misfit)


def _with_noise_of(state: State, rows: Array) -> State:
    """The state with mean, spread and correlation of these simulations (simulation, part, observable)."""
    mean = rows.mean(axis=0)
    spread = np.maximum(rows.std(axis=0, ddof=1), state.least_spread)
    parts = range(rows.shape[1])
    whiten = np.stack([whitener(shrunk_correlation((rows[:, p] - mean[p]) / spread[p])) for p in parts])
    return replace(state, mean=mean, spread=spread, whiten=whiten)


def build(
    bench: Bench,
    model: Model,
    kinds: Sequence[str],
    added: Sequence[str] = (),
    values: Sequence[nuisance.Nuisance] | None = None,
) -> Library:
    """Simulate the neighbourhood of `model` (already matched) and a few settings of each effect that it lacks.

    Free are its nuisance values (`values`, which know where they started; None: here) and the parameters of the
    effects that were `added`, but for those that are read off the movie; effects of the model believed stay as they
    are believed.
    """
    values = nuisance.nuisances(model) if values is None else values
    free = [n.path for n in values]
    for effect in model.effects:
        seen = effect.read_off(bench.measured) if effect.kind in added else {}
        coordinates = Coordinate.of(effect, model) if effect.kind in added else ()
        free += [f"{effect.kind}.{c.name}" for c in coordinates if c.name not in seen]
    prior = np.array([n.prior for n in values] + [PARAMETER_PRIOR] * (len(free) - len(values)))
    steps = free_steps(model, values, free)
    rows = bench.rows([(model, k) for k in range(BASE_SIMULATIONS)])
    check = bench.rows([(model, CHECK_SEED + k) for k in range(CHECK_SIMULATIONS)])
    slopes = derivatives(bench, lambda by: moved(model, values, free, by), steps, rows)
    blank = np.zeros(rows.shape[1:])
    least = spread_floor(bench.names)
    bare = State(model, blank, blank, slopes, prior, blank, check, tuple(free), least, tuple(values))
    base = _with_noise_of(bare, rows)
    base = replace(base, floor=float(np.median([base.held_out_error(x) for x in check])))
    return Library(bench, base, rows, _rays(bench, model, rows, kinds))


def _rays(bench: Bench, model: Model, rows: Array, kinds: Sequence[str]) -> dict[str, list[Ray]]:
    jobs: list[tuple[Effect, int]] = []
    for kind in kinds:
        settings = ray_settings(catalogue()[kind], model, np.random.default_rng([bench.seed, *kind.encode()]))
        seen = catalogue()[kind].read_off(bench.measured)
        jobs += [(changed(setting, seen), i % 8) for i, setting in enumerate(settings)]
    found = bench.rows([(model.with_effects(effect), number) for effect, number in jobs])
    rays: dict[str, list[Ray]] = {kind: [] for kind in kinds}
    for (effect, number), row in zip(jobs, found, strict=True):
        rays[effect.kind].append(Ray(effect, row - rows[number]))
    return rays


def ray_settings(effect: type[Effect], model: Model, rng: np.random.Generator) -> list[Effect]:
    """Settings that span an effect's plausible range: strengths spread evenly, the strongest first, and the less of the
    weak ones the fewer settings each form has, for weaker ones follow from a strong one; shapes at random, forms and
    other choices in turn."""
    ranges, choices = effect.plausible(model), choice_fields(effect)
    n = RAYS + len(ranges) - 1
    weakest = max(0.0, 1 - n / (2 * len(effect.forms())))
    found = []
    for i in range(n):
        share, turn = 1 - (1 - weakest) * (i + 0.5) / n, i
        u = 0.5 + 0.5 * share * (-1) ** i if two_sided(effect) else share
        values: dict[str, Any] = {}
        for name, (low, high, log) in ranges.items():
            place = u if name == effect.strength else rng.random()
            values[name] = float(low * (high / low) ** place if log else low + (high - low) * place)
        for name, options in choices.items():
            values[name] = options[turn % len(options)]
            turn //= len(options)
        found.append(effect(**values))
    return found


def two_sided(effect: type[Effect] | Effect) -> bool:
    """Whether the effect's strength may lie on either side of none."""
    kind = effect if isinstance(effect, type) else type(effect)
    low, high, _ = kind.plausible()[kind.strength]
    return low < kind.null_value < high


def choice_fields(effect: type[Effect]) -> dict[str, tuple[str, ...]]:
    """Fields with named options: the form, and others like it."""
    fields = {name: field.annotation for name, field in effect.model_fields.items()}
    return {name: get_args(options) for name, options in fields.items() if get_origin(options) is Literal}


def scaled(effect: Effect, scale: float) -> Effect:
    """The effect with its strength moved to `scale` of the way from none."""
    name, null = effect.strength, effect.null_value
    return changed(effect, {name: null + (float(getattr(effect, name)) - null) * scale})


def expected_simulations(kinds: Sequence[str], n_free: int) -> int:
    """How many simulations `matched` and `build` make."""
    rays = sum(RAYS + len(catalogue()[k].plausible()) - 1 for k in kinds)
    return 2 * MATCHING_ROUNDS + BASE_SIMULATIONS + CHECK_SIMULATIONS + SLOPE_SEEDS * n_free + rays
