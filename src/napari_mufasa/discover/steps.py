"""The steps from one stand to the next: effects are taken up, what is in the model is fitted deeper, what does not earn
its place is taken out (forms and rivals: `exchange`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from napari_mufasa.discover import camera, joint, library
from napari_mufasa.discover.exchange import Exchange, kinds_of, worth_beside
from napari_mufasa.discover.rules import (
    CLEAR,
    FAR,
    FAR_LESS,
    FAR_OFF,
    FORM_ERROR,
    NEAR,
    NOT_RISEN,
    REMOVALS,
    START,
)
from napari_mufasa.discover.stand import Case, Stand, Worth
from napari_mufasa.discover.start import started
from napari_mufasa.discover.state import State


class Steps(Exchange):
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
            new = [case for case in group if _kind(case) not in kinds_of(state)]
            found = [started(stand.library, beside, case, stand.x) for case in new]
            return found + (self._begun_before_courses(new[0]) if new and beside is stand.state else [])

        for group in sorted(groups, key=lambda group: _kind(group[0]) in self.bench.read_last):
            if state is not stand.state and not any(self._promises(state, case) for case in group):
                continue
            begun_here, before = tries(group, state), kinds_of(state)
            state = min(begun_here, key=lambda tried: tried.surprise(stand.x), default=state)
            if len(groups) > 1 and len(begun_here) > 1 and state.far_off(stand.x):
                doubtful += [(kind, group) for kind in kinds_of(state) if kind not in before]
        for kind, group in doubtful:
            others = tries(group, joint.lacking(stand.library, state, kind))
            state = min([state, *others], key=lambda tried: tried.surprise(stand.x))
        kinds = [kind for kind in kinds_of(state) if kind not in kinds_of(stand.state)]
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
        worth = worth_beside(stand, lesser, needed)
        further = joint.arrived if not stand.is_worth(worth) else None if far else joint.deepened
        if further is not None and (near := further(lesser.library, x, self.kinds, self.left)):
            lesser = self._seen_in(near)
            worth = worth_beside(stand, lesser, needed)
        return worth, None if stand.is_worth(worth) else lesser

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


def _differ(course: Sequence[float], other: Sequence[float]) -> bool:
    """Do two courses of an effect differ by more than its form may?"""
    return len(course) != len(other) or bool(np.subtract(course, other).std() > FORM_ERROR * np.std(course))


def _kind(case: Case) -> str:
    return case[0].ray.effect.kind
