"""Where an investigation stands: what is known of one measurement and one model believed, and what that decides."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.discover import fit, library
from napari_mufasa.discover.bench import Bench
from napari_mufasa.discover.contest import FINALISTS, PROMISING, Contest
from napari_mufasa.discover.fit import Fit
from napari_mufasa.discover.library import Library, View
from napari_mufasa.discover.null import ALARM, MISFIT_ALARM, Null
from napari_mufasa.discover.result import Candidate
from napari_mufasa.discover.state import Lead, Ray, State
from napari_mufasa.model.model import Model

Array = NDArray[np.float64]
SECOND = 0.01  # chance level that every further effect must pass …
SECOND_SHARE = 0.03  # … with at least this share of the evidence of those before it
SURE, NOT_RISEN = 1e-3, 1.03  # chance level at which an error at its floor need not fall, and how far it may rise


class Standing:
    """One measurement (seen through its bench), one believed model, the kinds of effects considered, and the effects
    added so far.

    views : of the base model, then after each effect · fits : the effects added, in order · ranking : of the last look
    """

    def __init__(self, bench: Bench[Any], believed: Model, kinds: Sequence[str]) -> None:
        self._started = time.monotonic()
        self.bench, self.believed, self.kinds, self.seed = bench, believed, list(kinds), bench.seed
        self._null: Null | None = None
        self.views: list[View] = []
        self.fits: list[Fit] = []
        self._gained: list[float] = []  # evidence that each of them brought
        self.ranking: list[Candidate] = []
        self._contest: Contest | None = None
        self._alone: dict[str, Fit] = {}  # effects fitted into the base model

    def examine(self) -> None:
        """Fit the nuisance values, simulate the neighbourhood of the model and of every effect."""
        bench = self.bench
        expected = library.expected_simulations(self.kinds, len(bench.free_values(bench.start)), bench.start)
        bench.plan(bench.matching_simulations + expected + FINALISTS * fit.planned_simulations())
        near = library.build(bench, bench.matched(bench.start), self.kinds)
        self.views = [View(near, near.base)]

    @property
    def view(self) -> View:
        """The model as it stands, and what is seen from there."""
        return self.views[-1] if self.views else self.first_view

    @property
    def first_view(self) -> View:
        """The model believed, its nuisance values near the measurement."""
        if not self.views:
            self.examine()
        return self.views[0]

    @property
    def library(self) -> Library:
        """The simulated neighbourhood of the model as it stands."""
        return self.view.library

    @property
    def state(self) -> State:
        """The model as it stands: the base, or the last fit."""
        return self.view.state

    @property
    def null(self) -> Null:
        if self._null is None:
            self._null = Null.of(*self.first_view.library.null_distribution())
        return self._null

    @property
    def x(self) -> Array:
        return self.bench.x

    @property
    def chosen(self) -> list[str]:
        return [f.effect.kind for f in self.fits]

    @property
    def model(self) -> Model:
        """The model as it stands, its free values at their best."""
        return self.state.model_at(self.state.adjusted(self.x).moves)

    @property
    def explained(self) -> float:
        """Evidence of the effects in the model, together."""
        return sum(self._gained)

    @property
    def far_off(self) -> bool:
        """Is the model, with what was added, still so wrong that the first neighbourhood says little about it?"""
        return bool(self.fits) and self.state.far_off(self.x)

    @property
    def contest(self) -> Contest:
        """What was fitted into the model as it stands."""
        if self._contest is None or self._contest.state is not self.state:
            self._contest = Contest(self.library, self.state, self.x, lambda: self.null)
        return self._contest

    def leads(self) -> dict[str, list[Lead]]:
        """What every effect not yet in the model promises in each of its forms, by the emulator; best first."""
        return self._leads(self.state, {k: rays for k, rays in self.library.rays.items() if k not in self.chosen})

    def needed(self, lead: Lead) -> float:
        """The evidence that the effect of a lead must bring to enter the model."""
        if not self.fits:
            return self.null.evidence.at(ALARM)
        # What the first effects leave is also the error of their own form: where a further effect moves what they
        # moved, it must stand out from that, more so where the held-out error is at its floor already.
        shared, at_the_floor = self._shared(lead), self.state.at_floor(self.x)
        beyond_form = shared * SECOND_SHARE * self.explained * (3.0 if at_the_floor else 1.0)
        return max(beyond_form, self.null.evidence.at(SECOND ** (1.0 + shared) if at_the_floor else SECOND))

    def _shared(self, lead: Lead) -> float:
        """How much of what a lead moves the effects in the model have moved before it, 0 … 1."""
        moved = (self.state.mean - self.first_view.state.mean)[0] / self.first_view.state.spread[0]
        moves = np.square(lead.ray.shift[0] / self.state.spread[0])
        return float((moves * moved**2 / (1.0 + moved**2)).sum() / max(moves.sum(), 1e-9))

    def alarmed(self) -> bool:
        """Is the model inadequate beyond chance, or a further effect worth a fit?"""
        leads = [forms[0] for forms in self.leads().values()]
        if self.fits:
            return self.far_off or any(lead.gain > PROMISING * self.needed(lead) for lead in leads)
        by_effect = any(lead.gain > self.needed(lead) for lead in leads)
        return by_effect or self.null.misfit.p(self.state.misfit(self.x)) < MISFIT_ALARM

    def convincing(self, best: Candidate) -> bool:
        """Does adding it lower the held-out error, with the evidence that is needed? By the fit as it was last judged:
        what was added and taken out again has been settled."""
        found = self.contest.tried.get(best.effect)
        if found is None or not found.is_some or best.evidence <= self.needed(self.leads()[best.effect][0]):
            return False
        return self.improves(self.state, found.state, best)

    def improves(self, on: State, after: State, best: Candidate) -> bool:
        """Is the held-out error of the state `after` better than that of the state `on`?

        Where that is at its floor no effect can lower it much, and sure evidence will do if the error does not rise.
        Chance may have kept the effect from the molecules held out; then the base model's error may rise to the floor.
        """
        before, error = on.held_out_error(self.x), after.held_out_error(self.x)
        if not on.at_floor(self.x) or best.evidence <= self.null.evidence.at(SURE):
            return error < before
        return error < NOT_RISEN * before or (on is self.first_view.state and after.at_floor(self.x))

    def _leads(self, state: State, rays: dict[str, list[Ray]]) -> dict[str, list[Lead]]:
        """What effects promise beside a state, best first."""
        return dict(sorted(state.screen(self.x, rays).items(), key=lambda item: -item[1][0].gain))

    @property
    def seconds(self) -> float:
        return time.monotonic() - self._started
