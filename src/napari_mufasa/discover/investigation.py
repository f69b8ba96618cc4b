"""The conversation: look where the model fails, ask what is missing, add it, see the error fall.

`diagnose` plays it alone; the viewer and `refine` let a user play it by hand. The measurement is seen only through
a `Bench`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from napari_mufasa import checks
from napari_mufasa.chance.streams import Streams
from napari_mufasa.discover import joint, library
from napari_mufasa.discover.coordinates import changed
from napari_mufasa.discover.measurement import prepare
from napari_mufasa.discover.movie_bench import MovieBench
from napari_mufasa.discover.reporting import compile_report
from napari_mufasa.discover.result import Candidate, Report, Verdict
from napari_mufasa.discover.rules import CLEAR, FAR, FAR_LESS, NEAR, RIVAL, RIVALS
from napari_mufasa.discover.stand import Case, Stand, Worth
from napari_mufasa.discover.standing import Standing, share_of
from napari_mufasa.discover.start import SIMULATIONS, begun, started
from napari_mufasa.discover.state import Lead, State
from napari_mufasa.discover.trace_bench import TraceBench, candidate_kinds
from napari_mufasa.effects import Effect, catalogue, effect_class
from napari_mufasa.errors import MufasaError
from napari_mufasa.model.model import Model

FINALISTS = 5  # leads that are started when a user asks what is missing


class Investigation(Standing):
    """One measured movie, one believed model, and the steps taken so far.

    Parameters
    ----------
    movie : (frame, y, x) counts (ADU), array or lazy array
    model : the model believed; its shape and length are taken from the movie
    dark : (frame, y, x) dark frames or None
    seed : the same seed gives the same answer
    effects : kinds to consider; None: the whole catalogue that suits the camera
    budget : simulations that may be spent; None: 4000, fewer of a large movie (`rules.BUDGET_VALUES`)
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
        budget: int | None = None,
        progress: Callable[[int, int], None] | None = None,
        cancel: Callable[[], bool] | None = None,
    ) -> None:
        _check(model, seed)
        self.measurement = prepare(movie, model, dark)
        considered = _considered(effects, list(catalogue()), model)
        super().__init__(MovieBench(self.measurement, seed, progress, cancel), model, budget, *considered)

    # Steps --------------------------------------------------------------------------------------------------

    def rank(self, tries: int = FINALISTS) -> list[Candidate]:
        """What is missing: the leads, the best of them tried by simulation, best first."""
        stand = self.stand
        self.bench.plan(tries * SIMULATIONS)
        tried: dict[str, State] = {}
        for kind, forms in list(stand.leads.items())[:tries]:
            if len(tried) < 2 or forms[0].gain > stand.needed:
                tried[kind] = started(stand.library, stand.state, forms, stand.x)
        misfits = {kind: state.misfit(stand.x) for kind, state in tried.items()}
        self.ranking = []
        for kind in sorted(tried, key=lambda k: misfits[k]):
            near = tuple(k for k in tried if k != kind and abs(misfits[k] - misfits[kind]) < NEAR)
            self.ranking.append(self._tried(kind, tried[kind], near))
        self.ranking += [self._lead(kind, forms[0]) for kind, forms in stand.leads.items() if kind not in tried]
        return self.ranking

    def widen(self) -> bool:
        """Consider the uncommon effects, too, where the model as it stands is far off its floor. True if there were
        any to consider."""
        stand = self.stand
        new = [kind for kind in self.further if kind not in stand.added]
        if not new or stand.error < FAR * stand.state.floor:
            return False
        self.bench.plan(library.ray_simulations(new, stand.state.model))
        self.kinds, self.further = [*self.kinds, *new], []
        self.stands[-1] = replace(stand, library=library.with_rays(stand.library, new))
        return True

    def add(self, *what: str | Effect | Candidate) -> None:
        """Fit effects into the model as it stands, together with all that is in it already."""
        stand = self.stand
        kinds = [w if isinstance(w, str) else w.effect if isinstance(w, Candidate) else w.kind for w in what]
        for kind in kinds:
            self._addable(kind)
        self.bench.plan(len(kinds) * SIMULATIONS + self._settling(len(kinds)))
        state = stand.state
        for kind, one in zip(kinds, what, strict=True):
            if isinstance(one, Effect):
                state = begun(stand.library, state, [one], stand.x)
            elif kind in stand.leads:
                state = started(stand.library, state, stand.leads[kind], stand.x)
            else:  # not among those considered so far
                state = begun(stand.library, state, _each_form(effect_class(kind)()), stand.x)
        self.kinds += [kind for kind in kinds if kind not in self.kinds]
        self._settle(state)

    def take_up(self, groups: Sequence[Sequence[Case]]) -> set[str]:
        """Fit promising effects into the model together, of each group the one that explains most once it is started.
        Returns the kinds that stay out: what comes to next to none, and where all together explain nothing (the step
        is taken back) all but the first, or an only one."""
        stand, state = self.stand, self.stand.state
        self.bench.plan(sum(len(group) for group in groups) * SIMULATIONS + self._settling(len(groups)))
        for group in groups:
            tries = [started(stand.library, state, case, stand.x) for case in group if _kind(case) not in _kinds(state)]
            state = min(tries, key=lambda tried: tried.surprise(stand.x), default=state)
        kinds = [kind for kind in _kinds(state) if kind not in _kinds(stand.state)]
        if self._settle(state, kinds, stand.misfit):
            if self.stand.misfit < stand.misfit:
                return set(kinds) - set(self.chosen)
            self.undo()
        return set(kinds[1:] or kinds)

    def deepen(self) -> bool:
        """All free values further downhill from where they stand. True if that explains more."""
        stand = self.stand
        self.bench.plan(self._settling(0))
        near = joint.deepened(stand.library, stand.x, self.kinds, self.left)
        if near is None:
            return False
        self._stand_at(near)
        if self.stand.misfit < stand.misfit and self.stand.error < stand.error:
            return True
        self.undo()
        return False

    def remove(self, *kinds: str) -> None:
        """Take effects out; the others are fitted anew."""
        for kind in kinds:
            if kind not in self.stand.added:
                raise MufasaError(f"{kind} was not added: {', '.join(self.stand.added) or 'nothing'} can be taken out")
        self.bench.plan(joint.REMOVALS + self._settling(0))
        self._settle(joint.removed(self.stand.library, *kinds))

    def undo(self) -> None:
        """Take the last step back."""
        if len(self.stands) < 2:
            raise MufasaError("nothing to undo: no effect was added")
        self.stands.pop()

    def prune(self) -> set[str]:
        """Take out what does not earn its place: at once what is worth far less than it needs, then one by one; what
        only a whole fit without them can tell is told by one. Returns the kinds taken out."""
        dropped: set[str] = set()
        at_once = True
        while self.chosen:
            stand = self.stand
            doubtful = {
                k: w for k, w in stand.worths.items() if not stand.is_worth(w) and (k, w) not in stand.confirmed
            }
            if not doubtful or not (len(stand.added) == 1 or self.affords(0)):
                break
            if len(stand.added) == 1:
                self.stands = self.stands[:1]
                return dropped | set(doubtful)
            order = sorted(doubtful, key=lambda k: doubtful[k].evidence)
            far_less = [k for k in order if doubtful[k].evidence < FAR_LESS * doubtful[k].needed]
            kinds = far_less if at_once and 0 < len(far_less) < len(stand.added) else order[:1]
            worth, lesser = self._lesser(kinds, sum(doubtful[k].needed for k in kinds))
            if lesser is not None:
                self.stands[-1] = lesser
                dropped |= set(kinds)
            elif len(kinds) == 1:
                self.stands[-1] = stand.confirming(kinds[0], worth)
            else:  # they stand in for one another
                at_once = False
        return dropped

    def _lesser(self, kinds: Sequence[str], needed: float) -> tuple[Worth, Stand | None]:
        """What effects are worth by a whole fit without them, and the stand without them where that is too little. Its
        neighbourhood is simulated where a few simulations leave that in doubt."""
        stand, x = self.stand, self.stand.x
        self.bench.plan(joint.REMOVALS + self._settling(0))
        there = joint.brought(stand.library, joint.removed(stand.library, *kinds), x, self.kinds, self.left)
        worth = Worth(there.misfit(x) - stand.misfit, there.held_out_error(x), needed)
        if worth.evidence > CLEAR * needed and stand.is_worth(worth):
            return worth, None
        self._stand_at(joint.seen_from(stand.library, there.model, x, self.kinds))
        lesser = self.stands.pop()
        evidence = max(lesser.state.score(x) - stand.state.score(x), 0.0)
        worth = Worth(evidence, lesser.error, needed)
        return worth, None if stand.is_worth(worth) else lesser

    def exchange(self, leads: Sequence[Case] = ()) -> bool:
        """Try other forms, and rivals, in the place of each effect; keep the first that explains more. What could not
        be told from an effect is noted with its worth. While there are `leads`, only other forms of the effects that
        move what those do."""
        for kind in self.stand.added:
            stand = self.stand
            if not self.affords(1):
                return False
            if leads and not any(stand.moves_alike(case[0], kind) for case in leads):
                continue
            tries = self._begun_without(kind, () if leads else stand.rivals_of(kind, RIVAL)[:RIVALS])
            effect = next(e for e in stand.state.model.effects if e.kind == kind)
            if not stand.content and (others := [e for e in _each_form(effect) if e.chosen != effect.chosen]):
                tries.append(begun(stand.library, stand.without(kind), others, stand.x))
            if self._replaced(kind, tries):
                return True
        return False

    def _begun_without(self, kind: str, cases: Sequence[Case]) -> list[State]:
        """Each case started in the place of an effect."""
        stand = self.stand
        return [started(stand.library, stand.without(kind), case, stand.x) for case in cases]

    def _replaced(self, kind: str, tries: list[State]) -> bool:
        """Settle the best of `tries`, in each of which something else is in the place of an effect; keep it where it
        explains more."""
        stand = self.stand
        tries = sorted(tries, key=lambda state: state.surprise(stand.x))
        behind = {t.model.effects[-1].kind: t.misfit(stand.x) - stand.misfit for t in tries}
        if near := {k: by for k, by in behind.items() if k != kind and by < NEAR}:
            stand = stand.confirming(kind, replace(stand.worths[kind], rivals=near))
            self.stands[-1] = stand
        surprise = stand.state.surprise(stand.x)
        if not tries or tries[0].surprise(stand.x) > surprise + (0.0 if stand.content else 2 * NEAR):
            return False
        if not self._settle(tries[0], below=stand.misfit + NEAR):
            return False
        other = self.stands.pop()
        if other.state.surprise(stand.x) > surprise - NEAR or other.error > stand.error:
            return False
        self.stands[-1] = other
        return True

    def report(self, verdict: Verdict | None = None) -> Report:
        """What has been found so far."""
        return compile_report(self, verdict)

    # Inside -------------------------------------------------------------------------------------------------

    def _settle(self, state: State, on_trial: Sequence[str] = (), below: float = np.inf) -> bool:
        """All free values fitted together, and the neighbourhood simulated anew: a further stand, if the misfit there
        is `below` what it should be."""
        last = self.stand
        near = joint.settled(last.library, state, last.x, self.kinds, self.left, on_trial, below)
        if near is not None:
            self._stand_at(near)
        return near is not None

    def _stand_at(self, near: library.Library) -> None:
        last = self.stand
        added = tuple(effect.kind for effect in near.base.model.effects if effect.kind in self.kinds)
        order = [k for k in last.added if k in added] + [k for k in added if k not in last.added]
        self.stands.append(Stand(near, tuple(order), last.x, last.null, self.first.state))

    def _settling(self, n_effects: int) -> int:
        state = self.state
        return min(
            joint.settling_simulations(self.stand.library, self.kinds, len(state.free) + 2 * n_effects, state.model),
            max(self.left, 1),
        )

    def _addable(self, kind: str) -> None:
        _known(kind)
        if kind in (effect.kind for effect in self.believed.effects):
            raise MufasaError(f"{kind} is in the model believed already: take it out there first")
        if kind in self.stand.added:
            raise MufasaError(f"{kind} is already in the model: undo it first, or add another effect")

    def _tried(self, kind: str, state: State, near: tuple[str, ...]) -> Candidate:
        """The case of an effect that was started beside the model as it stands."""
        stand, x = self.stand, self.stand.x
        effect = next(e for e in state.model_at(state.adjusted(x).moves).effects if e.kind == kind)
        after = state.held_out_error(x)
        gain = max(stand.misfit - state.misfit(x), 0.0)
        return Candidate(
            kind, self.first.null.evidence.p(gain), gain, after, share_of(stand.error, after, stand.state.floor),
            effect.parameters(), {}, near,
        )  # fmt: skip

    def _lead(self, kind: str, lead: Lead) -> Candidate:
        p = self.first.null.evidence.p(lead.gain)
        return Candidate(kind, p, max(lead.gain, 0.0), None, None, lead.start().parameters(), {})


def _kind(case: Case) -> str:
    return case[0].ray.effect.kind


def _kinds(state: State) -> list[str]:
    return [effect.kind for effect in state.model.effects]


def _each_form(effect: Effect) -> list[Effect]:
    """The effect with every choice of form, its own first."""
    found = [effect]
    for name, options in type(effect).choices().items():
        found += [changed(e, {}, **{name: option}) for e in found for option in options if option != getattr(e, name)]
    return found


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
        budget: int | None = None,
        progress: Callable[[int, int], None] | None = None,
        cancel: Callable[[], bool] | None = None,
    ) -> None:
        _check(model, seed)
        considered = _considered(effects, candidate_kinds(), model)
        bench = TraceBench(
            traces, model, unit, profile, background_subtracted, pixel_share, seed=seed, progress=progress,
            cancel=cancel,
        )  # fmt: skip
        Standing.__init__(self, bench, model, budget, *considered)


def _check(model: Model, seed: int) -> None:
    checks.need(model, Model, "model", "give nm.preset(…) or nm.Model.from_json(…)")
    Streams(seed)  # raises on a bad seed


def _considered(named: Sequence[str] | None, shown: Sequence[str], model: Model) -> tuple[list[str], list[str]]:
    """The kinds considered, and those considered later: those named, or of those `shown` by the measurement the common
    ones first."""
    kinds = _suitable(shown if named is None else named, model)
    first = [kind for kind in kinds if named is not None or effect_class(kind).common_in(model)]
    return first, [kind for kind in kinds if kind not in first]


def _suitable(kinds: Sequence[str], model: Model) -> list[str]:
    """Those that suit the model and are not in it."""
    wanted = {kind: _known(kind) for kind in checks.words(kinds, "effects")}
    known = {effect.kind for effect in model.effects}
    return [kind for kind, effect in wanted.items() if effect.suits(model) and kind not in known]


def _known(kind: str) -> type[Effect]:
    try:
        return effect_class(kind)
    except ValueError as error:
        raise MufasaError(str(error)) from None
