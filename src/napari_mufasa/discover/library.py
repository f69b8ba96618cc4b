"""Simulated neighbourhoods: where a model stands, what its free values do, what each effect would do.

An effect enters as rays: simulations at a few strengths, shapes and forms, each minus the base simulation
of the same seed. Along a ray the shift grows with strength. A ray that explains the residual is a lead;
simulations (`start`, `joint`) decide.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.discover import nuisance
from napari_mufasa.discover.bench import Bench
from napari_mufasa.discover.coordinates import Coordinate, changed, model_at
from napari_mufasa.discover.derivatives import derivatives, free_steps
from napari_mufasa.discover.metric import shrunk_correlation, whitener
from napari_mufasa.discover.rules import (
    BASE_SIMULATIONS,
    CHECK_SIMULATIONS,
    NEARLY_ALL,
    PARAMETER_PRIOR,
    RAYS,
    RENEWED,
    SLOPE_SEEDS,
    UNREAD,
)
from napari_mufasa.discover.state import HALVES, Ray, State, two_sided
from napari_mufasa.effects import Effect, catalogue
from napari_mufasa.model.model import Model
from napari_mufasa.observe import PARTS

Array = NDArray[np.float64]
CHECK_SEED = 5_000


@dataclass(frozen=True)
class Library:
    """The base state, its paired simulations (simulation, part, observable) and rays.

    without : what is known of the base state without some of its effects · shown : what a few simulations say that one
    is worth (see `joint.shown_worth`) · formed : and with one in another form ·
    earlier : kinds of effects whose rays are those beside an earlier base state, until a look has renewed some
    """

    bench: Bench[Any]
    base: State
    rows: Array
    rays: dict[str, list[Ray]]
    without: dict[tuple[str, ...], State] = field(default_factory=dict)
    shown: dict[str, float] = field(default_factory=dict)
    formed: dict[str, State | None] = field(default_factory=dict)
    earlier: frozenset[str] = frozenset()

    def simulated(self, jobs: Sequence[tuple[Model, int]]) -> Array:
        """Rows (job, part, observable) of models beside the base model.

        What such a simulation does not show (no spot is left in half of the field) is that of its twin, the base
        simulation of the same number: as evidence it counts neither for nor against.
        """
        rows = self.bench.rows(jobs)
        for row, (_, number) in zip(rows, jobs, strict=True):
            if (gap := ~np.isfinite(row)).any():
                row[gap] = self._twin(number)[gap]
                missing = gap.any(axis=0) & self.base.measurable
                self.bench.gaps |= {self.bench.names[i] for i in np.flatnonzero(missing)}
        return rows

    def beside(self, state: State, effect: Effect) -> Model:
        """The model of a state with an effect; where that is cheap, its values matched again beside it, in reach of
        where they started."""
        model = state.model.with_effects(effect)
        return nuisance.kept(self.bench.matched(model), state.values) if self.bench.is_cheap else model

    def most_promising(self, x: Array) -> list[str]:
        """Of the effects whose rays are earlier ones, those that by these promise most of the measurement x (part,
        observable)."""
        leads = self.base.screen(x, {kind: self.rays[kind] for kind in self.rays if kind in self.earlier})
        return sorted(leads, key=lambda kind: -leads[kind][0].gain)[:RENEWED]

    def _twin(self, number: int) -> Array:
        twin: Array = self.base.check[number - CHECK_SEED] if number >= CHECK_SEED else self.rows[number]
        return twin

    def null_distribution(self, folds: int = 4) -> tuple[dict[str, Array], Array]:
        """Evidence of each effect, and misfit, of base simulations taken as measurements.

        None of them is judged by a mean, spread or correlation that it helped to make: each fold by those of
        the other folds, the check simulations by those of all.
        """
        evidence, misfit = {kind: list[float]() for kind in self.rays}, []
        fold_of = np.arange(len(self.rows)) % folds
        trials = [(with_noise_of(self.base, self.rows[fold_of != f]), self.rows[fold_of == f]) for f in range(folds)]
        for state, unseen in [*trials, (self.base, self.base.check)]:
            for x in unseen:
                misfit.append(state.misfit(x))
                for kind, forms in state.screen(x, self.rays).items():
                    evidence[kind].append(forms[0].gain)
        return {kind: np.array(found) for kind, found in evidence.items()}, np.array(misfit)


def with_noise_of(state: State, rows: Array) -> State:
    """The state with mean, spread and correlation of these simulations (simulation, part, observable)."""
    mean = rows.mean(axis=0)
    spread = np.maximum(rows.std(axis=0, ddof=1), state.least_spread)
    parts = range(rows.shape[1])
    whiten = np.stack([whitener(shrunk_correlation((rows[:, p] - mean[p]) / spread[p])) for p in parts])
    return replace(state, mean=mean, spread=spread, whiten=whiten)


def build(
    bench: Bench[Any],
    model: Model,
    kinds: Sequence[str],
    added: Sequence[str] = (),
    before: Library | None = None,
) -> Library:
    """Simulate the neighbourhood of `model` (already matched) and a few settings of each effect that it lacks, but for
    those whose rays at a stand `before` are known: these are taken over (see `renewed`).

    Free are its nuisance values (which know where they started at first) and the parameters of the effects that were
    `added`, but for those that are read off the movie; effects of the model believed stay as they are believed.
    """
    values = bench.free_values(model) if before is None else before.base.values
    free = [n.path for n in values]
    for effect in model.effects:
        seen = bench.read_off(effect.kind) if effect.kind in added else {}
        coordinates = Coordinate.of(effect, model) if effect.kind in added else ()
        free += [f"{effect.kind}.{c.name}" for c in coordinates if c.name not in seen]
    prior = np.array([n.prior for n in values] + [PARAMETER_PRIOR] * (len(free) - len(values)))
    steps = free_steps(model, values, free)
    rows = bench.rows([(model, k) for k in range(BASE_SIMULATIONS)])
    check = bench.rows([(model, CHECK_SEED + k) for k in range(CHECK_SIMULATIONS)])
    every, known = _without_gaps(bench, np.concatenate([rows, check]))
    rows, check = every[: len(rows)], every[len(rows) :]
    least = np.where(known, bench.least_spread(), np.inf)
    blank = np.zeros(rows.shape[1:])
    bare = State(model, blank, blank, blank[..., None], prior, blank, check, tuple(free), least, tuple(values))
    simulated = Library(bench, bare, rows, {}).simulated
    slopes = derivatives(simulated, lambda by: model_at(model, values, free, by), steps, rows)
    base = with_noise_of(replace(bare, slopes=slopes), rows)
    library = with_halves(Library(bench, base, rows, {}), added)
    earlier = {kind: before.rays[kind] for kind in kinds if before and kind in before.rays}
    library = replace(library, rays=earlier, earlier=frozenset(earlier))
    return with_rays(library, [kind for kind in kinds if kind not in earlier])


def _without_gaps(bench: Bench[Any], rows: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Simulations of a model (simulation, part, observable) with a number for all that is known, 0 for the rest; and
    which observables these are: those that the measurement shows in every part, and nearly all simulations, too. A
    simulation that shows none of one has that of the next which does: a freak takes no observable from all others, here
    and not at the next stand."""
    shown = np.isfinite(rows)
    known = np.isfinite(bench.measured.values).all(axis=0) & (shown.mean(axis=0) >= NEARLY_ALL).all(axis=0)
    for part, i in zip(*np.nonzero(known & ~shown.all(axis=0)), strict=True):
        gaps, others = np.flatnonzero(~shown[:, part, i]), np.flatnonzero(shown[:, part, i])
        next_one = others[np.searchsorted(others, gaps) % len(others)]
        rows[gaps, part, i] = rows[next_one, part, i]
        bench.gaps.add(bench.names[i])
    return np.where(known, rows, 0.0), known


def with_halves(library: Library, kinds: Sequence[str]) -> Library:
    """The neighbourhood that knows what effects of these kinds would have read off each half alone."""
    base = library.base
    found = {kind: read_by_halves(library, base.model, kind, library.rows) for kind in kinds}
    unread = {kind: change for kind, change in found.items() if change}
    return replace(library, base=replace(base, unread=unread).with_floor())


def read_by_halves(library: Library, model: Model, kind: str, rows: Array) -> dict[int, Array]:
    """`State.unread` of one effect of a model whose simulations are `rows` (simulation, part, observable)."""
    effect = next(e for e in model.effects if e.kind == kind)
    change = {}
    for half, _ in HALVES:
        seen = library.bench.read_off(kind, _without(model, kind), PARTS[half])
        told = {name: value for name, value in seen.items() if effect.matters(name)}
        if any(value == () != getattr(effect, name) for name, value in told.items()):
            continue  # too little for this half to show it; a course at random in its place would be another effect
        other = changed(effect, told)
        if other != effect:
            effects = tuple(other if e.kind == kind else e for e in model.effects)
            there = model.model_copy(update={"effects": effects})
            change[half] = (library.simulated([(there, k) for k in range(UNREAD)]) - rows[:UNREAD]).mean(axis=0)
    return change


def _without(model: Model, kind: str) -> Model:
    return model.model_copy(update={"effects": tuple(e for e in model.effects if e.kind != kind)})


def as_seen(settings: Sequence[Effect], seen: dict[str, Any]) -> list[Effect]:
    """Settings with what the measurement shows.

    An axis lies where chance favours it in the measurement, and elsewhere in every base simulation, which is screened
    alike: of an effect without forms, settings after the first turn from the axis seen.
    """
    found = [changed(setting, seen) for setting in settings]
    if "axis_deg" not in seen or settings[0].choices():
        return found
    axes = [(seen["axis_deg"] + 180 * i / len(found)) % 180 for i in range(len(found))]
    return [changed(effect, {"axis_deg": axis}) for effect, axis in zip(found, axes, strict=True)]


def renewed(library: Library, x: Array) -> Library:
    """The neighbourhood with the rays simulated anew that promise most of the measurement x (part, observable)."""
    return with_rays(replace(library, earlier=frozenset()), library.most_promising(x))


def with_rays(library: Library, kinds: Sequence[str]) -> Library:
    """The neighbourhood with a few settings of further effects."""
    return replace(library, rays=library.rays | _rays(library, kinds))


def _rays(library: Library, kinds: Sequence[str]) -> dict[str, list[Ray]]:
    bench, model = library.bench, library.base.model
    settings_of = {}
    for kind in kinds:
        settings = ray_settings(catalogue()[kind], model, np.random.default_rng([bench.seed, *kind.encode()]))
        # What a law shows in the place of another, too, is all that was measured.
        seen = bench.read_off(kind, model if catalogue()[kind].describes_only else None)
        settings_of[kind] = as_seen(settings, seen)
    return simulated_rays(library, settings_of)


def simulated_rays(library: Library, settings_of: Mapping[str, Sequence[Effect]]) -> dict[str, list[Ray]]:
    """The rays of each kind's settings."""
    model, rows = library.base.model, library.rows
    jobs = [(effect, i % 8) for settings in settings_of.values() for i, effect in enumerate(settings)]
    found = library.simulated([(library.beside(library.base, effect), number) for effect, number in jobs])
    rays: dict[str, list[Ray]] = {kind: [] for kind in settings_of}
    for (effect, number), row in zip(jobs, found, strict=True):
        rays[effect.kind].append(Ray(effect, row - rows[number], effect.none_at(model)))
    return rays


def ray_settings(effect: type[Effect], model: Model, rng: np.random.Generator) -> list[Effect]:
    """Settings that span an effect's plausible range: strengths spread evenly, the strongest first, and the less of the
    weak ones the fewer settings each form has, for weaker ones follow from a strong one; shapes at random, forms and
    other choices in turn."""
    ranges, choices = effect.plausible(model), effect.choices()
    n = RAYS + len(ranges) - 1
    weakest = max(0.0, 1 - n / (2 * len(effect.forms())))
    found = []
    for i in range(n):
        share, turn = 1 - (1 - weakest) * (i + 0.5) / n, i
        u = 0.5 + 0.5 * share * (-1) ** i if two_sided(effect, effect.none_at(model)) else share
        values: dict[str, Any] = {}
        for name, (low, high, log) in ranges.items():
            place = u if name == effect.strength else rng.random()
            values[name] = float(low * (high / low) ** place if log else low + (high - low) * place)
        for name, options in choices.items():
            values[name] = options[turn % len(options)]
            turn //= len(options)
        found.append(effect(**values))
    return found


def expected_simulations(kinds: Sequence[str], n_free: int, model: Model, read: int = 0) -> int:
    """How many simulations `build` makes at most, of a model that has so many effects `read` off the movie."""
    around = BASE_SIMULATIONS + CHECK_SIMULATIONS + len(HALVES) * UNREAD * read
    return around + SLOPE_SEEDS * n_free + ray_simulations(kinds, model)


def further_simulations(library: Library, kinds: Sequence[str], n_free: int, model: Model) -> int:
    """How many simulations `build` and a look from there (`renewed`) make at most at a further stand, `kinds` being
    those that are considered."""
    lacking = set(kinds) - {effect.kind for effect in model.effects}
    known = sorted(ray_simulations([kind], model) for kind in lacking if kind in library.rays)
    rays = sum(known[-RENEWED:]) + ray_simulations([kind for kind in lacking if kind not in library.rays], model)
    return expected_simulations([], n_free, model, read=len(library.base.unread) + 1) + rays


def ray_simulations(kinds: Sequence[str], model: Model) -> int:
    """How many of them are settings of effects."""
    return sum(RAYS + len(catalogue()[k].plausible(model)) - 1 for k in kinds)
