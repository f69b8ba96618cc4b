"""The steps from one stand to the next: effects are taken up, what is in the model is fitted deeper, what does not earn
its place is taken out, forms and rivals are exchanged."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from napari_mufasa.discover import camera, joint, library
from napari_mufasa.discover.coordinates import changed, is_at_an_end
from napari_mufasa.discover.rules import (
    BEGUN,
    CLEAR,
    DOUBTFUL,
    FAR,
    FAR_LESS,
    FAR_OFF,
    FORM_ERROR,
    FORM_WORTH,
    NEAR,
    NOT_RISEN,
    REMOVALS,
    RIVALS,
    START,
    UNCOMMON,
)
from napari_mufasa.discover.stand import Case, Stand, Worth, are_rivals
from napari_mufasa.discover.standing import Standing
from napari_mufasa.discover.start import begun, started
from napari_mufasa.discover.state import State
from napari_mufasa.effects import Effect, effect_class
from napari_mufasa.errors import MufasaError


class Steps(Standing):
    """Each step simulates within the budget, and leaves a stand that explains more, or the one it began with."""

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

    def look(self) -> None:
        """See what effects would do from where the model stands now."""
        stand = self.stand
        if stand.library.earlier:
            self.bench.plan(library.ray_simulations(stand.library.most_promising(stand.x), stand.state.model))
            self.stands[-1] = replace(stand, library=library.renewed(stand.library, stand.x))

    def take_up(self, groups: Sequence[Sequence[Case]]) -> set[str]:
        """Fit promising effects into the model together, of each group the one that explains most once it is started;
        what is read off as others leave it comes last. What is chosen while much is still wrong is compared again,
        beside the effects of the other groups; a group that promises nothing any more beside those before it waits.
        Returns the kinds that stay out: what comes to next to none, and where all together explain nothing (the step
        is taken back) all but the first, or an only one."""
        stand, state, doubtful = self.stand, self.stand.state, []
        self.bench.plan(sum(len(group) for group in groups) * START + self._settling(len(groups)))

        def tries(group: Sequence[Case], beside: State) -> list[State]:
            new = [case for case in group if _kind(case) not in _kinds(state)]
            found = [started(stand.library, beside, case, stand.x) for case in new]
            return found + (self._begun_before_courses(new[0]) if new and beside is stand.state else [])

        for group in sorted(groups, key=lambda group: _kind(group[0]) in self.bench.read_last):
            if state is not stand.state and not any(self._promises(state, case) for case in group):
                continue
            begun_here, before = tries(group, state), _kinds(state)
            state = min(begun_here, key=lambda tried: tried.surprise(stand.x), default=state)
            if len(groups) > 1 and len(begun_here) > 1 and state.far_off(stand.x):
                doubtful += [(kind, group) for kind in _kinds(state) if kind not in before]
        for kind, group in doubtful:
            others = tries(group, joint.lacking(stand.library, state, kind))
            state = min([state, *others], key=lambda tried: tried.surprise(stand.x))
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

    def arrive(self) -> None:
        """See the model from where its values are at their best, so that what is told of them is what simulations with
        them show: slopes taken elsewhere promise along a valley what is not to be had at its end."""
        stand = self.stand
        if not self.chosen or not self.affords(0):
            return
        self.bench.plan(self._settling(0))
        near = joint.arrived(stand.library, stand.x, self.kinds, self.left)
        if near is not None:
            there = self._seen_in(near)
            fallen = stand.misfit - there.misfit
            known = tuple((kind, replace(w, evidence=w.evidence + fallen)) for kind, w in stand.known)
            self.stands[-1] = replace(there, known=known)

    def judge_camera(self) -> None:
        """Where the camera was set right before any effect was known, try it as it is believed, beside those that are
        known now, which may have been taken for it; where an excess noise of its register is among them, try another
        gain in its place. As it is believed it is kept, unless that leaves clearly more misfit."""
        stand, x = self.stand, self.stand.x
        if not (self.bench.shows_camera and self.chosen and self.affords(0)):
            return
        if self.camera_is_off:
            state, other, below = stand.state, self.bench.start, stand.misfit + NEAR
        elif camera.REGISTER in self.chosen:
            state, below = stand.without(camera.REGISTER), stand.misfit - NEAR
            other = camera.set_right(state, x, least=0.0)
        else:
            return
        if other is state.model:
            return
        self.bench.plan(self._settling(0))
        model = camera.with_camera_of(state.model, other)
        state, base = (camera.known_from(each, model) for each in (state, stand.state))
        here = replace(stand.library, base=base)
        near = joint.from_elsewhere(here, state, model, x, self.kinds, self.left, below)
        if near is None:
            return
        self._stand_at(near)
        if self.stand.misfit > below or self.stand.error > NOT_RISEN * stand.error:
            self.undo()
        elif not self.chosen:  # it was the gain alone
            self.stands = [replace(self.stand, first=self.state)]

    def prune(self, sure: bool = False) -> set[str]:
        """Take out what does not earn its place: at once what is worth far less than it needs, if together it is not
        worth what one needs, then one by one; what only a whole fit without them can tell is told by one. Where only
        what is `sure` shall go, what is worth far less goes, the least first, if a few simulations show that the others
        make up for it; where the budget affords no fit, so does then what has not earned its place (not at the end of a
        way while some of the budget is kept for another). Returns the kinds taken out."""
        dropped: set[str] = set()
        at_once = True
        while self.chosen:
            stand = self.stand
            doubtful = {
                k: w
                for k, w in stand.worths.items()
                if (not stand.is_worth(w) or stand.may_stand_in(k)) and not w.judged
            }
            if not doubtful:
                break
            if len(stand.added) == 1 and stand.seen_as_first:
                self.stands = [self._first_again()]
                return dropped | set(doubtful)
            order = sorted(doubtful, key=lambda k: doubtful[k].evidence)
            far_less = [k for k in order if doubtful[k].evidence < FAR_LESS * doubtful[k].needed]
            if sure or not self.affords(0):
                if self.reserve and not sure:
                    break
                little = far_less if sure or far_less else [k for k in order if not stand.is_worth(doubtful[k])]
                useless = next((k for k in little if not stand.is_promise(k)), None)
                if useless is None:
                    break
                self.stands[-1] = self._seen_in(joint.left_out(stand.library, useless))
                dropped.add(useless)
                continue
            kinds = far_less if at_once and 0 < len(far_less) < len(stand.added) else order[:1]
            worth, lesser = self._lesser(kinds, max(doubtful[k].needed for k in kinds))
            if lesser is not None:
                self.stands[-1] = lesser
                dropped |= set(kinds)
            elif len(kinds) == 1:
                self.stands[-1] = stand.knowing(kinds[0], replace(worth, judged=True))
            else:  # they stand in for one another
                at_once = False
        return dropped

    def exchange(self, waiting: float | None = None, kinds: set[str] | None = None) -> bool:
        """Try other forms, and rivals, in the place of each effect (of these `kinds`); then, where misfit is left,
        another form and what moves the same beside it; keep the first that explains more. What could not be told from
        an effect is noted with its worth. While others are `waiting` that promise so much: no rivals, no more effects
        than before, and no form that promises less."""
        least = NEAR if waiting is None else -max(waiting, NEAR)
        formed: dict[str, State] = {}
        for kind in self.stand.added if kinds is None else [kind for kind in self.stand.added if kind in kinds]:
            stand = self.stand
            if not self.affords(1):
                return False
            tries = self._begun_without(kind, stand.rivals_of(kind)[:RIVALS] if waiting is None else ())
            self._note_rivals(kind, {_kinds(tried)[-1]: tried.misfit(stand.x) - stand.misfit for tried in tries})
            if not stand.content and (state := self._in_other_forms(kind)) is not None:
                formed[kind] = state
                tries.append(state)
            if self._replaced(kind, tries, least):
                return True
        pairs = formed.items() if waiting is None and self.room != 0 else ()
        return any(
            self.affords(2) and self._replaced(kind, self._begun_beside(state, kind), least) for kind, state in pairs
        )

    def merge(self) -> bool:
        """Try one effect in the place of two, the lesser of which is worth no more than a form may be: another form of
        one that the other is a rival of, or of any where that is doubtful, or what is known to look like both; keep it
        where two are not worth their place beside one."""
        stand = self.stand
        explained = self.first.misfit - stand.misfit
        for kind in sorted(stand.added, key=lambda kind: stand.worths[kind].evidence):
            worth = stand.worths[kind]
            if worth.evidence > FORM_WORTH * explained:
                break
            for other in stand.added:
                if other != kind and self.affords(1):
                    lesser = self._merged(other, kind, worth.needed)
                    if lesser is not None:
                        self.stands[-1] = lesser
                        return True
        return False

    def begin_afresh(self) -> bool:
        """All that is in the model taken up anew beside the model believed (see `Stand.as_cases`), for what was fitted
        while much was wrong has led values astray. The stands before are left. True where more than one step has led
        there, and the budget affords that."""
        groups = self.stand.as_cases()
        if len(self.stands) < 3 or self.left < sum(len(group) for group in groups) * START + self._settling(0):
            return False
        self.stands = [self._first_again()]
        self.take_up(groups)
        return bool(self.chosen)

    def undo(self) -> None:
        """Take the last step back."""
        if len(self.stands) < 2:
            raise MufasaError("nothing to undo: no effect was added")
        self.stands.pop()

    # Inside -------------------------------------------------------------------------------------------------

    def _first_again(self) -> Stand:
        """The model believed, with the rays of effects that are considered since then, too."""
        first, rays = self.first.library, self.stand.library.rays
        new = frozenset(rays) - frozenset(first.rays)
        return replace(self.first, library=replace(first, rays=rays | first.rays, earlier=first.earlier | new))

    def _promises(self, state: State, case: Case) -> bool:
        """Do an effect's leads still promise something beside what is begun in a state?"""
        kind = _kind(case)
        leads = state.screen(self.stand.x, {kind: [lead.ray for lead in case]})
        return leads[kind][0].gain > self.stand.needed(kind)

    def _settle(self, state: State, on_trial: Sequence[str] = (), below: float = np.inf) -> bool:
        """All free values fitted together, and the neighbourhood simulated anew: a further stand, if the misfit there
        is `below` what it should be."""
        last = self.stand
        near = joint.settled(last.library, state, last.x, self.kinds, self.left, on_trial, below)
        if near is not None:
            self._stand_at(near)
        return near is not None

    def _stand_at(self, near: library.Library) -> None:
        self.stands.append(self._seen_in(near))

    def _seen_in(self, near: library.Library) -> Stand:
        """The stand whose neighbourhood that is."""
        last = self.stand
        added = tuple(effect.kind for effect in near.base.model.effects if effect.kind in self.kinds)
        order = [k for k in last.added if k in added] + [k for k in added if k not in last.added]
        return Stand(near, tuple(order), last.x, last.null, self.first.state)

    def _settling(self, n_effects: int) -> int:
        state = self.state
        return min(
            joint.settling_simulations(self.stand.library, self.kinds, len(state.free) + 2 * n_effects, state.model),
            max(self.left, 1),
        )

    def _lesser(self, kinds: Sequence[str], needed: float) -> tuple[Worth, Stand | None]:
        """What effects are worth by a whole fit without them, and the stand without them where that is too little. Its
        neighbourhood is simulated where a few simulations leave that in doubt, or end near the floor; there, what still
        is worth its place is judged at the end of the way downhill: the others may do without it, and slopes taken
        beside it need not show how. And what is not is judged where simulations, not slopes, say that the others have
        come to without it."""
        stand, x = self.stand, self.stand.x
        self.bench.plan(REMOVALS + self._settling(0))
        there = joint.brought(stand.library, joint.removed(stand.library, *kinds), x, self.kinds, self.left)
        worth = Worth(there.misfit(x) - stand.misfit, there.held_out_error(x), needed)
        far = worth.error_without > (FAR_OFF if any(map(stand.rivals_added, kinds)) else FAR) * stand.state.floor
        if far and worth.evidence > CLEAR * needed and stand.is_worth(worth):
            return worth, None
        lesser = self._seen_in(joint.seen_from(stand.library, there.model, self.kinds))
        worth = _worth_beside(stand, lesser, needed)
        further = joint.arrived if not stand.is_worth(worth) else None if far else joint.deepened
        if further is not None and (near := further(lesser.library, x, self.kinds, self.left)):
            lesser = self._seen_in(near)
            worth = _worth_beside(stand, lesser, needed)
        return worth, None if stand.is_worth(worth) else lesser

    def _begun_without(self, kind: str, cases: Sequence[Case]) -> list[State]:
        """Each case started in the place of an effect."""
        stand = self.stand
        return [started(stand.library, stand.without(kind), case, stand.x) for case in cases]

    def _begun_beside(self, formed: State, kind: str) -> list[State]:
        """Beside another form of an effect, one at a time, what moves the same: the form that is in the model may have
        taken the place of two, and leave nothing for either of them alone."""
        stand = self.stand
        cases = stand.companions_of(kind, formed)[:RIVALS]
        return [started(stand.library, formed, case, stand.x) for case in cases]

    def _begun_before_courses(self, case: Case) -> list[State]:
        """A case started before each effect in the model whose course is read otherwise beside it, and then that effect
        beside it: what was read off may hold what the case is about."""
        stand, found = self.stand, []
        for effect in stand.state.model.effects:
            course = getattr(effect, "course", ())
            if effect.kind not in stand.added or not course or not effect.matters("course"):
                continue
            bare = stand.without(effect.kind)
            seen = self.bench.read_off(effect.kind, stand.library.beside(bare, case[0].start()))
            if _differ(course, seen.get("course", course)):
                there = started(stand.library, bare, case, stand.x)
                found.append(started(stand.library, there, [stand.as_it_is(effect.kind)], stand.x))
        return found

    def _in_other_forms(self, kind: str) -> State | None:
        """An effect begun in the best of its other forms in its own place; None where it has none, or none that was
        kept when it was tried."""
        stand = self.stand
        known = stand.library.formed
        if kind not in known:
            bare = stand.without(kind)
            others = self._other_forms(kind, bare)
            known[kind] = begun(stand.library, bare, others, stand.x, apart=True) if others else None
        return known[kind]

    def _other_forms(self, kind: str, bare: State) -> list[Effect]:
        """An effect in its other forms, with what is read off the measurement beside a state that lacks it; in its own
        again, too, where a shape of it has come to the end of its range, for it may have begun in the wrong valley."""
        effect = next(e for e in self.state.model.effects if e.kind == kind)
        astray = is_at_an_end(effect, self.state.model)
        others = [e for e in each_form(effect) if astray or e.chosen != effect.chosen]
        seen = self.bench.read_off(kind, bare.model) if others else {}
        return [changed(e, seen) for e in others]

    def _merged(self, kind: str, lesser: str, needed: float) -> Stand | None:
        """The stand with one effect in the place of two, if the two are not worth there what they need. What looks like
        both is tried once, in the place of an effect and a lesser one."""
        stand, x = self.stand, self.stand.x
        once = stand.worths[lesser].evidence <= stand.worths[kind].evidence
        alike = stand.like_both(kind, lesser) if once else {}
        may_be_form = are_rivals(kind, lesser) or stand.share(lesser) < DOUBTFUL
        if not alike and not (may_be_form and effect_class(kind).choices()):
            return None
        bare = joint.removed(stand.library, kind, lesser)
        forms = self._other_forms(kind, bare) if may_be_form else []
        tries = [started(stand.library, bare, case, x) for case in bare.screen(x, alike).values()]
        if forms:
            tries.append(begun(stand.library, bare, forms, x, apart=True))
        best = min(tries, key=lambda tried: tried.surprise(x))
        if not self._settle(best, below=stand.misfit + needed):
            return None
        merged = self.stands.pop()
        risen = merged.error > NOT_RISEN * stand.error
        return None if risen or stand.is_worth(_worth_beside(stand, merged, needed)) else merged

    def _note_rivals(self, kind: str, behind: Mapping[str, float]) -> None:
        """Note with an effect's worth what was in its place, so much `behind` it in misfit, and cannot be told from it;
        the more misfit is left, the farther behind that may be. What was noted before and is now seen to be farther
        behind is noted no more."""
        if not behind:
            return
        stand, worth = self.stand, self.stand.worths[kind]
        rivals = {**worth.rivals, **behind}
        near = {rival: by for rival, by in rivals.items() if by < NEAR * stand.birge**2}
        if near != worth.rivals:
            self.stands[-1] = stand.knowing(kind, replace(worth, rivals=near))

    def _unlikely(self, state: State) -> float:
        """How unlikely a state is (−2 log likelihood, as its surprise), the more so the more uncommon effects it has:
        where the data cannot tell an uncommon effect from a common one, it is the common one."""
        return state.surprise(self.stand.x) + UNCOMMON * self._uncommon(state)

    def _uncommon(self, state: State) -> int:
        """How many effects of a state few movies have, unless the user has named those that are considered."""
        return 0 if self.suspects else sum(not effect_class(k).common_in(self.believed) for k in _kinds(state))

    def _replaced(self, kind: str, tries: Sequence[State], more: float) -> bool:
        """Settle the best of `tries`, in each of which something else is in the place of an effect, unless it leaves so
        much `more` misfit; keep it where it is likelier. What cannot be told from the one that is kept is noted."""
        stand, unlikely = self.stand, self._unlikely(self.state)
        tries = sorted(tries, key=self._unlikely)
        margin = more if more < 0 else 0.0 if stand.content else 2 * NEAR
        if not tries:
            return False
        begun_here = _kinds(tries[0])
        instead = [] if kind in begun_here else [k for k in begun_here if k not in _kinds(stand.state)]
        # The few simulations around a start are wide: what is begun looks less likely than it is.
        begun_behind = tries[0].misfit(stand.x) - stand.misfit
        commoner = self._uncommon(tries[0]) < self._uncommon(stand.state)
        alike = any(are_rivals(kind, rival) for rival in instead)
        is_near = begun_behind < more + BEGUN if alike else commoner and begun_behind < more
        if not is_near and self._unlikely(tries[0]) > unlikely + margin:
            return False
        if not self._settle(tries[0], below=stand.misfit + more):
            self._note_rivals(kind, dict.fromkeys(instead, more))  # it is that far behind at least
            return False
        other = self.stands.pop()
        if self._unlikely(other.state) > unlikely - NEAR or other.error > NOT_RISEN * stand.error:
            if tries[0] is stand.library.formed.get(kind):
                stand.library.formed[kind] = None
            self._note_rivals(kind, dict.fromkeys(instead, _behind(other, stand)))
            return False
        self.stands[-1] = other
        for rival in instead:
            self._note_rivals(rival, {kind: _behind(stand, other)})
        return True


def _behind(one: Stand, other: Stand) -> float:
    """How far one stand is behind another, by misfit or by likelihood, whichever says less."""
    x = one.x
    return min(one.misfit - other.misfit, one.state.surprise(x) - other.state.surprise(x))


def _worth_beside(stand: Stand, lesser: Stand, needed: float) -> Worth:
    """What a stand is worth that has one effect more than another."""
    evidence = max(lesser.state.score(stand.x) - stand.state.score(stand.x), 0.0)
    return Worth(evidence, lesser.error, needed)


def _differ(course: Sequence[float], other: Sequence[float]) -> bool:
    """Do two courses of an effect differ by more than its form may?"""
    return len(course) != len(other) or bool(np.subtract(course, other).std() > FORM_ERROR * np.std(course))


def _kind(case: Case) -> str:
    return case[0].ray.effect.kind


def _kinds(state: State) -> list[str]:
    return [effect.kind for effect in state.model.effects]


def each_form(effect: Effect) -> list[Effect]:
    """The effect with every choice of form, its own first."""
    found = [effect]
    for name, options in type(effect).choices().items():
        found += [changed(e, {}, **{name: option}) for e in found for option in options if option != getattr(e, name)]
    return found
