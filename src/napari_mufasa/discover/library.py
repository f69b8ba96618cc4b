"""The base model's neighbourhood, simulated: its mean and spread, what nuisance values do, what effects do.

An effect enters as rays: simulations at a few strengths, shapes and forms, each minus the base simulation
of the same seed. Along a ray the shift grows with strength. A ray that explains the residual is a lead; the
fit (`fit.refine`) decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.discover import nuisance
from napari_mufasa.discover.bench import Bench, as_table
from napari_mufasa.discover.metric import Profile, profile, shrunk_correlation, spread_floor, whitener
from napari_mufasa.effects import Effect, catalogue
from napari_mufasa.model import Model
from napari_mufasa.observe import PARTS

Array = NDArray[np.float64]
BASE_SIMULATIONS = 60
MATCHING_ROUNDS = 4
SLOPE_SEEDS = 3
RAYS = 5  # strengths of each effect, plus one for each shape parameter
SCALES = (0.12, 0.25, 0.45, 0.7, 1.0, 1.4)


@dataclass(frozen=True)
class Ray:
    """One effect at one setting, and the shift of the observables it makes (part, observable)."""

    effect: Effect
    shift: Array


@dataclass
class Library:
    """Simulations of a model near a measurement.

    base (simulation, part, observable) · slopes (part, observable, nuisance) · rays by kind
    """

    bench: Bench
    model: Model
    free: list[nuisance.Nuisance]
    base: Array
    slopes: Array
    rays: dict[str, list[Ray]]

    def __post_init__(self) -> None:
        floor = spread_floor(self.bench.names)
        self.mean = self.base.mean(axis=0)
        self.spread = np.maximum(self.base.std(axis=0, ddof=1), floor)
        self.spread[1:] = np.maximum(self.spread[1:], 1.2 * floor)
        self.whiten = [
            whitener(shrunk_correlation((self.base[:, p] - self.mean[p]) / self.spread[p])) for p in range(len(PARTS))
        ]
        self.prior = np.array([n.prior for n in self.free])

    def profiled(self, x: Array, part: int = 0, whiten: Array | None = None) -> Profile:
        """The measurement x (part, observable) against the base model, nuisance values moved."""
        return profile(
            x[part], self.mean[part], self.spread[part], self.slopes[part], self.prior,
            self.whiten[part] if whiten is None else whiten,
        )  # fmt: skip

    def screen(
        self, x: Array, whiten: Array | None = None, kinds: Sequence[str] | None = None
    ) -> dict[str, tuple[float, Ray, float]]:
        """Per effect: the largest fall of chi² along any of its rays, that ray, and its scale."""
        w = self.whiten[0] if whiten is None else whiten
        start = self.profiled(x, 0, w)
        spread = self.spread[0]
        residual = start.residual
        # Locally linear: nuisance directions are projected out of residual and rays alike.
        weight = 1 / np.sqrt(1 + (np.sinh(np.clip(start.soft / 8.0, -20, 20))) ** 2)
        slope = np.vstack([w @ (self.slopes[0] / spread[:, None] * weight[:, None]), np.diag(1 / self.prior)])
        q, _ = np.linalg.qr(slope)
        full = np.concatenate([residual, -start.moves / self.prior])
        found: dict[str, tuple[float, Ray, float]] = {}
        for kind in self.rays if kinds is None else kinds:
            best: tuple[float, Ray, float] | None = None
            for ray in self.rays[kind]:
                for scale in SCALES:
                    bent = self._bent(start, ray.shift[0] * scale / spread)
                    step = np.concatenate([w @ bent, np.zeros(len(self.prior))])
                    rest = full - step
                    rest = rest - q @ (q.T @ rest)
                    gain = start.chi2 - float(rest @ rest)
                    if best is None or gain > best[0]:
                        best = (gain, ray, scale)
            if best is not None:
                found[kind] = best
        return found

    @staticmethod
    def _bent(start: Profile, shift: Array) -> Array:
        """What a shift (in spreads) takes from the softened residual."""
        raw = 8.0 * np.sinh(np.clip(start.soft / 8.0, -20, 20))
        result: Array = start.soft - 8.0 * np.arcsinh((raw - shift) / 8.0)
        return result

    def calibrate(self, folds: int = 4) -> tuple[Array, Array]:
        """Null values of the largest evidence and of the misfit: each base simulation taken as a measurement,
        whitened without its own fold."""
        evidence, misfit = [], []
        index = np.arange(len(self.base))
        for fold in range(folds):
            out = index % folds == fold
            z = (self.base[~out, 0] - self.mean[0]) / self.spread[0]
            w = whitener(shrunk_correlation(z))
            for x in self.base[out]:
                misfit.append(self.profiled(x, 0, w).chi2)
                screened = self.screen(x, w)
                evidence.append(max((v[0] for v in screened.values()), default=0.0))
        return np.array(evidence), np.array(misfit)


def matched(bench: Bench, model: Model) -> Model:
    """The model with its nuisance values brought near the measurement, by moments."""
    measured = as_table(bench.names, bench.measured.part("all"))
    guess = max(1, round(measured["spots"] ** 2 * 1.15))
    model = model.with_values({"sample.n_molecules": guess})
    for round_ in range(MATCHING_ROUNDS):
        rows = bench.rows([(model, 10_000 + 10 * round_ + k) for k in range(2)])
        model = nuisance.match(model, measured, as_table(bench.names, rows[:, 0].mean(axis=0)))
    return model


def build(bench: Bench, model: Model, kinds: Sequence[str]) -> Library:
    """Simulate the neighbourhood of `model` (already matched) and a few settings of each effect."""
    free = nuisance.nuisances(model)
    base = bench.rows([(model, k) for k in range(BASE_SIMULATIONS)])
    slopes = slopes_at(bench, model, free, base)
    jobs: list[tuple[Effect, int]] = []
    for kind in kinds:
        effect = catalogue()[kind]
        settings = ray_settings(effect, np.random.default_rng([bench.seed, sum(kind.encode())]))
        jobs += [(setting, i % 8) for i, setting in enumerate(settings)]
    rows = bench.rows([(model.with_effects(*model.effects, effect), number) for effect, number in jobs])
    rays: dict[str, list[Ray]] = {kind: [] for kind in kinds}
    for (effect, number), row in zip(jobs, rows, strict=True):
        rays[effect.kind].append(Ray(effect, row - base[number]))
    return Library(bench, model, free, base, slopes, rays)


def slopes_at(bench: Bench, model: Model, free: list[nuisance.Nuisance], base: Array) -> Array:
    """Derivatives of the observables (part, observable, nuisance), by differences of paired simulations."""
    jobs, steps = [], []
    for j, value in enumerate(free):
        sign = 1.0 if j % 2 else -1.0
        by = np.zeros(len(free))
        by[j] = sign * value.step
        moved = nuisance.apply(model, free, by)
        jobs += [(moved, k) for k in range(SLOPE_SEEDS)]
        steps.append(sign * value.step)
    rows = bench.rows(jobs).reshape(len(free), SLOPE_SEEDS, *base.shape[1:])
    change = (rows - base[:SLOPE_SEEDS]).mean(axis=1)
    return np.moveaxis(change / np.array(steps)[:, None, None], 0, -1)


def ray_settings(effect: type[Effect], rng: np.random.Generator) -> list[Effect]:
    """Settings that span an effect's plausible range: strengths spread evenly, shapes at random, forms in turn."""
    ranges = effect.plausible()
    choices = choice_fields(effect)
    n = RAYS + len(ranges) - 1
    strengths = (np.arange(n) + 0.5) / n
    found = []
    for i, u in enumerate(rng.permutation(strengths)):
        values: dict[str, Any] = {}
        for name, (low, high, log) in ranges.items():
            share = u if name == effect.strength else rng.random()
            values[name] = float(low * (high / low) ** share if log else low + (high - low) * share)
        for name, options in choices.items():
            values[name] = options[i % len(options)]
        found.append(effect(**values))
    return found


def choice_fields(effect: type[Effect]) -> dict[str, tuple[str, ...]]:
    """Fields with named options: the form, and others like it."""
    return {
        name: tuple(getattr(field.annotation, "__args__", ()))
        for name, field in effect.model_fields.items()
        if getattr(field.annotation, "__args__", ())
    }


def expected_simulations(kinds: Sequence[str], n_free: int) -> int:
    """How many simulations `matched` and `build` make."""
    rays = sum(RAYS + len(catalogue()[k].plausible()) - 1 for k in kinds)
    return 2 * MATCHING_ROUNDS + BASE_SIMULATIONS + SLOPE_SEEDS * n_free + rays
