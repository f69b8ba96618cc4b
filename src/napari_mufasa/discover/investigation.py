"""The conversation: look where the model fails, ask what is missing, add it, see the error fall.

`diagnose` plays it alone; the viewer and `refine` let a user play it by hand. The measurement is seen only through
a `Bench`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from napari_mufasa.chance.streams import Streams
from napari_mufasa.discover import fit, library, nearing
from napari_mufasa.discover.contest import Contest
from napari_mufasa.discover.fit import Fit
from napari_mufasa.discover.library import View
from napari_mufasa.discover.measurement import prepare
from napari_mufasa.discover.movie_bench import MovieBench
from napari_mufasa.discover.reporting import compile_report
from napari_mufasa.discover.result import Candidate, Report, Verdict
from napari_mufasa.discover.standing import SECOND, SECOND_SHARE, Standing
from napari_mufasa.discover.trace_bench import TraceBench, candidate_kinds
from napari_mufasa.effects import Effect, catalogue, effect_class
from napari_mufasa.errors import MufasaError, need
from napari_mufasa.model.model import Model

RIVAL = 0.4  # of the first effect's evidence: a rival that is looked at again beside the second one
NEAR = 6.0  # −2 log likelihood within which two effects cannot be told apart


class Investigation(Standing):
    """One measured movie, one believed model, and the steps taken so far.

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
        _check(model, seed)
        self.measurement = prepare(movie, model, dark)
        kinds = _suitable(_searched(model) if effects is None else effects, model)
        super().__init__(MovieBench(self.measurement, seed, progress, cancel), model, kinds)

    def approach(self) -> None:
        """Where the model is still far off: simulate the neighbourhood anew around it, its free values moved downhill
        from where they were fitted or, where that is nearer, nuisance values matched again."""
        if not self.far_off or self.state is not self.fits[-1].state:
            return
        kinds = [kind for kind in self.kinds if kind not in self.chosen]
        n_free = len(self.state.free)
        self.bench.plan(
            self.bench.matching_simulations
            + nearing.descending_simulations(n_free)
            + library.expected_simulations(kinds, n_free, self.state.model)
        )
        model = nearing.nearer(self.library, self.state, self.model, self.x)
        model = nearing.descended(self.library, self.state, model, self.x)
        near = library.build(self.bench, model, kinds, self.chosen, self.state.values)
        self.views[-1] = View(near, near.base)

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

    def _starts(self, kind: str) -> list[Effect]:
        leads = self.leads()
        if kind not in leads:
            raise MufasaError(f"{kind} was left out of this investigation: name it in `effects`")
        return [lead.start() for lead in leads[kind]]


class TraceInvestigation(Investigation):
    """The same conversation about a table of traces alone; parameters as in `diagnose_traces`."""

    def __init__(
        self,
        traces: Any,
        model: Model,
        *,
        unit: str = "photoelectrons",
        profile: str = "psf",
        background_subtracted: bool = True,
        pixel_share: float | None = None,
        seed: int = 1,
        effects: Sequence[str] | None = None,
        progress: Callable[[int, int], None] | None = None,
        cancel: Callable[[], bool] | None = None,
    ) -> None:
        _check(model, seed)
        kinds = _suitable(candidate_kinds(model) if effects is None else effects, model)
        bench = TraceBench(
            traces, model, unit, profile, background_subtracted, pixel_share, seed=seed, progress=progress,
            cancel=cancel,
        )  # fmt: skip
        Standing.__init__(self, bench, model, kinds)


def _check(model: Model, seed: int) -> None:
    need(model, Model, "model", "give nm.preset(…) or nm.Model.from_json(…)")
    Streams(seed)  # raises on a bad seed


def _searched(model: Model) -> list[str]:
    """The effects that are considered where none are named."""
    return [kind for kind, effect in catalogue().items() if effect.considered_in(model)]


def _suitable(kinds: Sequence[str], model: Model) -> list[str]:
    """Those that suit the model and are not in it."""
    wanted = {kind: _known(kind) for kind in ([kinds] if isinstance(kinds, str) else kinds)}
    known = {effect.kind for effect in model.effects}
    return [kind for kind, effect in wanted.items() if effect.suits(model) and kind not in known]


def _known(kind: str) -> type[Effect]:
    try:
        return effect_class(kind)
    except ValueError as error:
        raise MufasaError(str(error)) from None
