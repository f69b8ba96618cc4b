"""The conversation: look where the model fails, ask what is missing, add it, see the error fall.

`diagnose` plays it alone; the viewer and `refine` let a user play it by hand. The measurement is seen only through
`Bench`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.chance.streams import Streams
from napari_mufasa.discover import fit, library, nearing
from napari_mufasa.discover.bench import Bench
from napari_mufasa.discover.contest import FINALISTS, PROMISING, Contest
from napari_mufasa.discover.fit import Fit
from napari_mufasa.discover.library import Library, View
from napari_mufasa.discover.measurement import prepare
from napari_mufasa.discover.nuisance import nuisances
from napari_mufasa.discover.null import ALARM, MISFIT_ALARM, Null
from napari_mufasa.discover.reporting import compile_report
from napari_mufasa.discover.result import Candidate, Report, Verdict
from napari_mufasa.discover.state import Lead, Ray, State
from napari_mufasa.effects import Effect, catalogue, effect_class
from napari_mufasa.errors import MufasaError, need
from napari_mufasa.model.model import Model

Array = NDArray[np.float64]
SECOND = 0.01  # chance level that every further effect must pass …
SECOND_SHARE = 0.03  # … with at least this share of the evidence of those before it
SURE, NOT_RISEN = 1e-3, 1.03  # chance level at which an error at its floor need not fall, and how far it may rise
RIVAL = 0.4  # of the first effect's evidence: a rival that is looked at again beside the second one
NEAR = 6.0  # −2 log likelihood within which two effects cannot be told apart


class Investigation:
    """One measurement, one believed model, and the steps taken so far.

    Parameters
    ----------
    movie : (frame, y, x) counts (ADU), array or lazy array
    model : the model believed; its shape and length are taken from the movie
    dark : (frame, y, x) dark frames or None
    seed : the same seed gives the same answer
    effects : kinds to consider; None: the whole catalogue that suits the camera
    progress, cancel : see `simulate`

    Memory: the (cropped) movie and one simulated movie per core. Raises `MufasaError` on unusable input.
    """

    def __init__(
        self,
        movie: Any,
        model: Model,
        dark: Any = None,
        *,
        seed: int = 1,
        effects: Sequence[str] | None = None,
        progress: Callable[[int, int], None] | None = None,
        cancel: Callable[[], bool] | None = None,
    ) -> None:
        self._started = time.monotonic()
        need(model, Model, "model", "give nm.preset(…) or nm.Model.from_json(…)")
        Streams(seed)  # raises on a bad seed
        effects = [effects] if isinstance(effects, str) else effects
        self.seed = seed
        self.believed = model
        self.measurement = prepare(movie, model, dark)
        known = {effect.kind for effect in model.effects}
        wanted = catalogue() if effects is None else {kind: _known(kind) for kind in effects}
        self.kinds = [k for k, effect in wanted.items() if effect.suits(model) and k not in known]
        self.bench = Bench(self.measurement, seed, progress, cancel)
        if self.bench.measured.spots.inside.sum() < 3:
            raise MufasaError(
                "fewer than three molecules were found in the movie: check psf_fwhm_nm, pixel_size_nm and baseline_adu "
                "in the model, or take a brighter region"
            )
        self._null: Null | None = None
        self.views: list[View] = []  # of the base model, then after each effect
        self.fits: list[Fit] = []
        self._gained: list[float] = []  # evidence that each of them brought
        self.ranking: list[Candidate] = []
        self._contest: Contest | None = None
        self._alone: dict[str, Fit] = {}  # effects fitted into the base model

    # What is known ------------------------------------------------------------------------------------------

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
        return self.bench.measured.values

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

    # Steps --------------------------------------------------------------------------------------------------

    def examine(self) -> None:
        """Fit the nuisance values, simulate the neighbourhood of the model and of every effect."""
        start = self.measurement.model
        simulations = nearing.matching_simulations() + library.expected_simulations(self.kinds, len(nuisances(start)))
        self.bench.plan(simulations + FINALISTS * fit.planned_simulations())
        near = library.build(self.bench, nearing.matched(self.bench, start), self.kinds)
        self.views = [View(near, near.base)]

    def approach(self) -> None:
        """Where the model is still far off: simulate the neighbourhood anew around it, its free values moved downhill
        from where they were fitted or, where that is nearer, nuisance values matched again."""
        if not self.far_off or self.state is not self.fits[-1].state:
            return
        kinds = [kind for kind in self.kinds if kind not in self.chosen]
        n_free = len(self.state.free)
        self.bench.plan(
            nearing.matching_simulations()
            + nearing.descending_simulations(n_free)
            + library.expected_simulations(kinds, n_free)
        )
        model = nearing.nearer(self.library, self.state, self.model, self.x)
        model = nearing.descended(self.library, self.state, model, self.x)
        near = library.build(self.bench, model, kinds, self.chosen, self.state.values)
        self.views[-1] = View(near, near.base)

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

    def rank(self) -> list[Candidate]:
        """What is missing: the leads, the best of them fitted by direct simulation, best first."""
        self.approach()
        self._contest = None
        leads, tried = self.leads(), self.contest.tried
        self.contest.run(leads, {k: self.needed(forms[0]) for k, forms in leads.items()} if self.fits else None)
        if not self.fits:
            self._alone = dict(tried)
        fitted = sorted(tried.items(), key=lambda item: item[1].score)
        self.ranking = []
        for kind, found in fitted:
            near = tuple(k for k, other in fitted if k != kind and abs(other.score - found.score) < NEAR)
            self.ranking.append(self._candidate(found, near))
        for kind, (lead, *_) in leads.items():
            if kind not in tried:
                p = self.null.evidence.p(lead.gain)
                self.ranking.append(Candidate(kind, p, max(lead.gain, 0.0), None, None, lead.start().parameters(), {}))
        return self.ranking

    def add(self, what: str | Effect | Candidate) -> None:
        """Fit an effect into the model as it stands, and keep it; where misfit is left, in its best form."""
        kind = what if isinstance(what, str) else what.effect if isinstance(what, Candidate) else what.kind
        _known(kind)
        if kind in (effect.kind for effect in self.believed.effects):
            raise MufasaError(f"{kind} is in the model believed already: take it out there first")
        if kind in self.chosen:
            raise MufasaError(f"{kind} is already in the model: undo it first, or add another effect")
        if kind not in self.contest.tried:
            self.approach()
        if isinstance(what, Effect):
            found = fit.fit_effect(self.library, self.state, what, self.x)
        else:
            found = self.contest.fitted(self._starts(kind))
        found = self.contest.tried[kind] = self.contest.settled(found)
        near = {c.effect: c.indistinguishable_from for c in self.ranking}.get(kind, ())
        others = [c for c in self.ranking if c.effect != kind]
        place = next((i for i, c in enumerate(self.ranking) if c.effect == kind), len(others))
        self.ranking = [*others[:place], self._candidate(found, near), *others[place:]]
        self._keep(found)

    def simplify(self) -> None:
        """Take the first of two effects out again where the second one alone explains as much: a greedy first
        pick can be wrong."""
        if len(self.fits) != 2 or (alone := self._alone.get(self.chosen[1])) is None:
            return
        if self.library is not self.first_view.library:  # seen from elsewhere: not comparable
            return
        bar = self.state.score(self.x) + max(SECOND_SHARE * self.explained, self.null.evidence.at(SECOND))
        if alone.score < bar + self.null.evidence.at(SECOND):
            alone = self.contest.settled(alone)
            if alone.score < bar:
                self.undo()
                self.undo()
                self._rank_first(self._candidate(alone, ()))
                self._keep(alone)

    def reconsider(self) -> None:
        """Of two effects, exchange the first for a rival that explains more now that the second is there: what was
        named while something else was missing may have stood in for it. Not where more is missing still: far from the
        measurement everything stands in for something."""
        if len(self.fits) != 2:
            return
        base, first = self.first_view, self.chosen[0]
        least = base.state.score(self.x) - RIVAL * self._gained[0]
        rivals = [kind for kind, found in self._alone.items() if kind not in self.chosen and found.score < least]
        if not rivals:
            return
        library = replace(self.library, rays=base.library.rays | self.library.rays)
        alone = fit.without(library, self.state, first, fit.n_effect(self.fits[1]), self.x)
        contest = Contest(library, alone.state, self.x, lambda: self.null)
        contest.tried[first] = fit.fit_effect(library, alone.state, self.fits[0].effect, self.x)
        contest.run(self._leads(alone.state, {kind: library.rays[kind] for kind in rivals}), None)
        best = min(contest.tried, key=lambda kind: contest.tried[kind].score)
        if best == first:
            return
        found = contest.settled(contest.fitted([contest.tried[best].effect]))
        if (lead := self.state.score(self.x) - found.score) > 0 and not found.state.far_off(self.x):
            self.fits, self._gained = [alone], [base.state.score(self.x) - alone.score]
            self.views = [base, View(self.library, alone.state)]
            self._rank_first(self._candidate(found, (first,) if lead < NEAR else ()))
            self._keep(found)

    def undo(self) -> None:
        """Take the last effect out again."""
        if not self.fits:
            raise MufasaError("nothing to undo: no effect was added")
        self.fits.pop()
        self._gained.pop()
        self.views.pop()

    def report(self, verdict: Verdict | None = None) -> Report:
        """What has been found so far."""
        return compile_report(self, verdict)

    def _keep(self, found: Fit) -> None:
        self._gained.append(self.contest.evidence(found))
        self.fits.append(found)
        self.views.append(View(self.library, found.state))

    def _rank_first(self, candidate: Candidate) -> None:
        self.ranking = [candidate, *(c for c in self.ranking if c.effect != candidate.effect)]

    # Inside -------------------------------------------------------------------------------------------------

    def _candidate(self, found: Fit, near: tuple[str, ...]) -> Candidate:
        """The case of a fitted effect against the model as it stands."""
        before, after = self.state.held_out_error(self.x), found.state.held_out_error(self.x)
        share = float(np.clip((before - after) / max(before - self.state.floor, 1e-9), 0.0, 1.0))
        gain = max(self.contest.evidence(found), 0.0)
        p = self.null.evidence.p(gain)
        return Candidate(found.effect.kind, p, gain, after, share, found.effect.parameters(), found.sd, near)

    def _leads(self, state: State, rays: dict[str, list[Ray]]) -> dict[str, list[Lead]]:
        """What effects promise beside a state, best first."""
        return dict(sorted(state.screen(self.x, rays).items(), key=lambda item: -item[1][0].gain))

    def _starts(self, kind: str) -> list[Effect]:
        leads = self.leads()
        if kind not in leads:
            raise MufasaError(f"{kind} was left out of this investigation: name it in `effects`")
        return [lead.start() for lead in leads[kind]]

    @property
    def seconds(self) -> float:
        return time.monotonic() - self._started


def _known(kind: str) -> type[Effect]:
    try:
        return effect_class(kind)
    except ValueError as error:
        raise MufasaError(str(error)) from None
