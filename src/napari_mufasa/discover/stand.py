"""Where an investigation stands: a model, its simulated neighbourhood, and what each added effect is worth there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from napari_mufasa.discover import joint
from napari_mufasa.discover.library import Library
from napari_mufasa.discover.metric import stretch
from napari_mufasa.discover.null import Null
from napari_mufasa.discover.rules import (
    ALIKE,
    AT_ONCE,
    BESIDE,
    CONTENT,
    EXPLAINED,
    FALLS,
    FAR,
    FORM_FIRST,
    FORM_WORTH,
    FURTHER,
    KNOWN,
    MISFIT_ALARM,
    NOT_RISEN,
    RIVAL,
    RIVALS,
    SHAPE,
    STILL_OFF,
    SURE,
)
from napari_mufasa.discover.state import Lead, Ray, State
from napari_mufasa.discover.uncertainty import parameters_sd
from napari_mufasa.effects import effect_class

Array = NDArray[np.float64]
Case = list[Lead]  # one effect's: the leads of its forms, the best first


@dataclass(frozen=True)
class Worth:
    """What an added effect is worth to the model it is in: by how much the misfit rises without it (its evidence),
    the held-out error then, the evidence it needs to stay, and the rivals that would explain about as much in its
    place, with how much more misfit they leave. It is `judged` once a whole fit without it has told."""

    evidence: float
    error_without: float
    needed: float
    rivals: Mapping[str, float] = field(default_factory=dict)
    judged: bool = False

    @property
    def is_some(self) -> bool:
        return self.evidence > self.needed


@dataclass(frozen=True)
class Stand:
    """A model with the effects added so far (`added`, in order), seen from its own neighbourhood.

    x (part, observable) : the measurement · null : what chance does in the model believed · first : its mean and spread
    """

    library: Library
    added: tuple[str, ...]
    x: Array
    null: Null
    first: State
    known: tuple[tuple[str, Worth], ...] = ()  # what fits have shown, of an effect or of what is in its place

    @property
    def state(self) -> State:
        return self.library.base

    @property
    def seen_as_first(self) -> bool:
        """Whether the camera is that of the model believed as it was seen first."""
        return self.state.values == self.first.values

    @cached_property
    def error(self) -> float:
        """Held-out error."""
        return self.state.held_out_error(self.x)

    @cached_property
    def misfit(self) -> float:
        return self.state.misfit(self.x)

    @cached_property
    def content(self) -> bool:
        """Is the error at its floor, and no more misfit left than chance leaves, as a whole and in any observable?"""
        return self.state.at_floor(self.x) and self.null.misfit.p(self.misfit) > CONTENT and not self.one_is_off

    @cached_property
    def one_is_off(self) -> bool:
        """Was one observable so far off, and is so still, that chance would leave none of them there, on the same side
        and mostly as far? What an effect has put off itself is the error of its form."""
        off, was_off = (each.adjusted(self.x).soft[self.state.measurable] for each in (self.state, self.first))
        by_chance = stats.norm.isf(STILL_OFF / (2 * off.size))
        beyond_chance = np.minimum(np.abs(off), np.abs(was_off)) > by_chance
        left = stretch(off) / np.where(beyond_chance, stretch(was_off), np.inf)
        return bool(np.any(left > 1 - EXPLAINED))

    @cached_property
    def far_off(self) -> bool:
        """Is so much still wrong that what the effects are worth is not to be had yet?"""
        return self.state.far_off(self.x)

    def needed(self, kind: str) -> float:
        """The evidence that an effect must promise. A further one is tried from where the usual chance ends: what it is
        worth is judged by fits, and by freaks of chance, too."""
        return float(self.null.evidence.law.isf(FURTHER)) if self.added else self.null.needed(kind)

    @cached_property
    def leads(self) -> dict[str, list[Lead]]:
        """What every effect not yet in the model promises in each of its forms, by the emulator; best first."""
        return dict(sorted(self.in_doubt.screen(self.x, self.library.rays).items(), key=lambda item: -item[1][0].gain))

    @cached_property
    def in_doubt(self) -> State:
        """The state that allows for errors of the form of the effects in it."""
        return self.state.doubting(self.moved_by(kind) for kind in self.added)

    @property
    def alarmed(self) -> bool:
        """Is the model inadequate beyond chance?"""
        by_effect = any(forms[0].gain > self.needed(kind) for kind, forms in self.leads.items())
        return by_effect or self.null.misfit.p(self.misfit) < MISFIT_ALARM

    def promising(self, but: set[str]) -> list[list[Case]]:
        """The effects that explain the misfit together, each beside those before it, and with each what promises about
        as much in its place. One that moves what those before it move, and promises much less than the best, waits
        until they are in; one that only describes, until no other promises anything; and what the form of those in the
        model may have left is no lead, but where the error is not explained and nothing else is left."""
        laws = {kind: rays for kind, rays in self.library.rays.items() if kind not in but}
        describing = {kind: laws.pop(kind) for kind in list(laws) if effect_class(kind).describes_only}
        far = self.error > FAR * self.state.floor
        seen_by = [self.in_doubt, self.state] if far else [self.in_doubt]
        tries = (self._together(dict(rays), state) for rays in (laws, describing) for state in seen_by)
        return next((found for found in tries if found), [])

    def _together(self, rays: dict[str, list[Ray]], state: State) -> list[list[Case]]:
        found: list[list[Case]] = []
        while rays and len(found) < AT_ONCE:
            taken = [cases[0][0] for cases in found]
            leads = state.screen(self.x, rays, taken)
            least = {kind: self._least(forms[0], taken) for kind, forms in leads.items()}
            if not (clear := [k for k, forms in leads.items() if forms[0].gain > least[k]]):
                break
            first, *others = sorted(clear, key=lambda k: -leads[k][0].gain)
            best = leads[first][0]
            alike = [k for k in others if self._vies(leads[k][0], best)]
            found.append([leads[kind] for kind in (first, *alike[:RIVALS])])
            del rays[first]
        return found

    def _vies(self, lead: Lead, best: Lead) -> bool:
        """Does a lead promise about as much as the best, and move the same things as far, or is it, where little else
        is wrong, known to look like it? One whose settings end where it promises most may come to more than it
        promises."""
        share = FORM_WORTH if lead.may_be_stronger and not best.may_be_stronger else RIVAL
        alike = not self.far_off and are_rivals(lead.ray.effect.kind, best.ray.effect.kind)
        return lead.gain > share * best.gain and (alike or _shared(lead.shift, best.shift, self.state.spread) > ALIKE)

    def _least(self, lead: Lead, taken: Sequence[Lead]) -> float:
        """What a lead must promise beside those that are taken up already."""
        needed = self.needed(lead.ray.effect.kind)
        if not taken:
            return needed
        moved = np.sum([other.shift for other in taken], axis=0)
        return max(needed, _shared(lead.shift, moved, self.state.spread) * BESIDE * taken[0].gain)

    @cached_property
    def worths(self) -> dict[str, Worth]:
        """What each of the added effects is worth, by simulations without it."""
        known = dict(self.known)
        if len(self.added) == 1 and not known and self.seen_as_first:  # the model without it is the one believed
            alone = self.first.score(self.x) - self.state.score(self.x)
            return {self.added[0]: Worth(alone, self.first.held_out_error(self.x), self.null.needed(self.added[0]))}
        states = {kind: self.without(kind) for kind in self.added}
        evidence = {kind: state.misfit(self.x) - self.misfit for kind, state in states.items()}
        moved = {kind: self.moved_by(kind) for kind in states}
        found = {}
        for kind, state in states.items():
            shared = {k: _shared(moved[kind], moved[k], self.state.spread) for k in states if k != kind}
            forms = SHAPE * sum(shared[k] * max(evidence[k], 0.0) for k in shared)
            needed = max(self.null.evidence_of(kind).at(FURTHER), forms)
            found[kind] = known.get(kind) or Worth(evidence[kind], state.held_out_error(self.x), needed)
        return found

    def without(self, kind: str) -> State:
        """The model without one of its effects, the others where they are."""
        return joint.removed(self.library, kind)

    def moved_by(self, kind: str) -> Array:
        """What an added effect does to the observables (part, observable), the others where they are."""
        return self.state.mean - self.without(kind).mean

    def stands_apart(self, lead: Lead) -> bool:
        """Does it promise much of what is left, and nothing that the form of an effect in the model may have left?"""
        left = self.misfit - float(self.null.misfit.law.median())
        return lead.gain > FORM_FIRST * left and not self.kin(lead)

    def kin(self, lead: Lead) -> set[str]:
        """The effects in the model that move as far what it moves or, where little else is wrong, are known to look
        like it: it may promise what their form has left."""
        spread = self.state.spread
        known = set() if self.far_off else set(self.rivals_added(lead.ray.effect.kind))
        return known | {kind for kind in self.added if _shared(lead.shift, self.moved_by(kind), spread) > ALIKE}

    def rivals_of(self, kind: str) -> list[Case]:
        """What promises much of what an added effect is worth, in its place, and of what is known to look like it, a
        little of that, for beside that effect it is seen to do less than alone; best first."""
        worth = self.worths[kind]
        laws = {k: rays for k, rays in self.library.rays.items() if not effect_class(k).describes_only}
        leads = self.without(kind).screen(self.x, laws).values()
        least = max(worth.evidence, self.needed(kind))

        def is_much(lead: Lead) -> bool:
            return lead.gain > (KNOWN if are_rivals(kind, lead.ray.effect.kind) else RIVAL) * least

        return sorted((forms for forms in leads if is_much(forms[0])), key=lambda forms: -forms[0].gain)

    def companions_of(self, kind: str, beside: State) -> list[Case]:
        """What could do a part of what an added effect does, as its leads are beside a state with another form of that;
        what moves most of it first."""
        moves = self.moved_by(kind)
        shares = {
            other: max(_shared(moves, ray.shift, self.state.spread) for ray in rays)
            for other, rays in self.library.rays.items()
            if not effect_class(other).describes_only
        }
        alike = sorted((other for other in shares if shares[other] > ALIKE), key=lambda other: -shares[other])
        leads = beside.screen(self.x, {other: self.library.rays[other] for other in alike})
        return [leads[other] for other in alike]

    def as_cases(self) -> list[list[Case]]:
        """The added effects as they are, what is worth most first, with each what promises about as much in its place
        and moves the same; near the floor, where few stand in for another, only if both are known to look alike."""
        found = []
        for kind in sorted(self.added, key=lambda kind: -self.worths[kind].evidence):
            itself = self.as_it_is(kind)
            alike = [
                case
                for case in self.rivals_of(kind)
                if self._vies(case[0], itself) and (self.far_off or are_rivals(kind, case[0].ray.effect.kind))
            ]
            found.append([[itself], *alike[:RIVALS]])
        return found

    def as_it_is(self, kind: str) -> Lead:
        """An added effect as a lead that promises what it is worth."""
        effect = next(e for e in self.state.model.effects if e.kind == kind)
        ray = Ray(effect, self.moved_by(kind), effect.none_at(self.state.model))
        return Lead(self.worths[kind].evidence, ray, 1.0)

    def share(self, kind: str) -> float:
        """How much of the error that is off without an added effect it takes away, 0 … 1."""
        return share_of(self.worths[kind].error_without, self.error, self.state.floor)

    def in_place_of(self, kind: str) -> dict[str, float]:
        """What cannot be told from an added effect, with how much more misfit it leaves in its place."""
        same = effect_class(kind).same_as(self.state.model, self.added)
        return {other: 0.0 for other in same if other not in self.added} | dict(self.worths[kind].rivals)

    def is_worth(self, worth: Worth) -> bool:
        """Does an effect earn its place: enough evidence, and a lower held-out error; beside others, whose form it may
        make up for, clearly lower?

        Where no other is, at the floor, no effect can lower it much: sure evidence will do if the error does not rise.
        """
        if not worth.is_some:
            return False
        if len(self.added) > 1:
            return self.error * FALLS < worth.error_without
        sure = worth.evidence > self.null.evidence.at(SURE) and self.state.at_floor(self.x)
        return self.error < worth.error_without * (NOT_RISEN if sure else 1.0)

    def is_promise(self, kind: str) -> bool:
        """Is it slopes alone that let the others make up for an added effect? Simulations of where these come to then
        show that it is worth what it needs."""
        return joint.shown_worth(self.library, kind, self.x) > self.worths[kind].needed

    def may_stand_in(self, kind: str) -> bool:
        """Is an effect worth so little of another that it may make up for where the values of that one have come to:
        of a known rival in the model; while misfit is left, of one that moves the same, and ever of one that takes back
        much of what it does? And, at the floor, is the model so near it without the effect that the values of the
        others may do? Where there are no others, what it is worth is known: by the model believed."""
        if len(self.added) == 1:
            return False
        if self.state.at_floor(self.x) and self.worths[kind].error_without < FAR * self.state.floor:
            return True
        worth, moved, spread = self.worths[kind].evidence, self.moved_by(kind), self.state.spread
        if any(worth < self.worths[rival].evidence for rival in self.rivals_added(kind)):
            return True
        great = [self.moved_by(k) for k, other in self.worths.items() if worth < FORM_WORTH * other.evidence]
        same = not self.content and any(_shared(moved, by, spread) > ALIKE for by in great)
        return same or any(_taken_back(moved, by, spread) > FORM_WORTH for by in great)

    def rivals_added(self, kind: str) -> list[str]:
        """The effects in the model that are known to look like one of them."""
        return [other for other in self.added if are_rivals(kind, other)]

    def like_both(self, kind: str, other: str) -> dict[str, list[Ray]]:
        """The settings of what is not in the model, has a law of its own, and is known to look like two that are."""
        return {
            k: rays
            for k, rays in self.library.rays.items()
            if k not in self.added and are_rivals(k, kind) and are_rivals(k, other)
            if not effect_class(k).describes_only
        }

    def knowing(self, kind: str, worth: Worth) -> Stand:
        """The same stand with what is known of one effect."""
        return replace(self, known=(*((k, w) for k, w in self.known if k != kind), (kind, worth)))

    @cached_property
    def birge(self) -> float:
        """How much wider uncertainties are for misfit that is left: the model is not quite what was measured."""
        usual = float(np.median([self.state.misfit(row) for row in self.library.base.check]))
        return float(max(1.0, self.misfit / usual) ** 0.5)

    @cached_property
    def uncertainties(self) -> dict[str, dict[str, float]]:
        """Standard deviations of the free parameters of each added effect, by simulations."""
        return {kind: {} for kind in self.added} | parameters_sd(self.library, self.birge)


def are_rivals(kind: str, other: str) -> bool:
    """Are two effects known to look alike?"""
    return kind in effect_class(other).rivals or other in effect_class(kind).rivals


def share_of(before: float, after: float, floor: float) -> float:
    """How much of what could be removed of an error was removed, 0 … 1."""
    return float(np.clip((before - after) / max(before - floor, 1e-9), 0.0, 1.0))


def _shared(moves: Array, moved: Array, spread: Array) -> float:
    """How much of what an effect moves, others have moved already as far, 0 … 1."""
    moves, moved = np.square(moves[0] / spread[0]), np.square(moved[0] / spread[0])
    return float(np.minimum(moves, moved).sum() / max(moves.sum(), 1e-9))


def _taken_back(moves: Array, moved: Array, spread: Array) -> float:
    """How much of what an effect moves, another moves the other way."""
    one, other = moves[0] / spread[0], moved[0] / spread[0]
    return -float(one @ other) / max(float(one @ one), 1e-9)
