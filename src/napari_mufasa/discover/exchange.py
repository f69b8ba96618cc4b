"""One thing in the place of another: other forms of an effect, its rivals, and one effect for two."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from napari_mufasa.discover import joint
from napari_mufasa.discover.coordinates import changed, is_at_an_end
from napari_mufasa.discover.rules import BEGUN, DOUBTFUL, FORM_WORTH, NEAR, NOT_RISEN, RIVALS, UNCOMMON
from napari_mufasa.discover.stand import Case, Stand, Worth, are_rivals
from napari_mufasa.discover.standing import Standing
from napari_mufasa.discover.start import begun, started
from napari_mufasa.discover.state import State
from napari_mufasa.effects import Effect, effect_class


class Exchange(Standing):
    """Each try is settled within the budget, and kept where it is likelier; what cannot be told from what is kept is
    noted with its worth."""

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
            self._note_rivals(kind, {kinds_of(tried)[-1]: tried.misfit(stand.x) - stand.misfit for tried in tries})
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

    # Inside -------------------------------------------------------------------------------------------------

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
        return None if risen or stand.is_worth(worth_beside(stand, merged, needed)) else merged

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
        return 0 if self.suspects else sum(not effect_class(k).common_in(self.believed) for k in kinds_of(state))

    def _replaced(self, kind: str, tries: Sequence[State], more: float) -> bool:
        """Settle the best of `tries`, in each of which something else is in the place of an effect, unless it leaves so
        much `more` misfit; keep it where it is likelier. What cannot be told from the one that is kept is noted."""
        stand, unlikely = self.stand, self._unlikely(self.state)
        tries = sorted(tries, key=self._unlikely)
        margin = more if more < 0 else 0.0 if stand.content else 2 * NEAR
        if not tries:
            return False
        begun_here = kinds_of(tries[0])
        instead = [] if kind in begun_here else [k for k in begun_here if k not in kinds_of(stand.state)]
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


def worth_beside(stand: Stand, lesser: Stand, needed: float) -> Worth:
    """What a stand is worth that has one effect more than another."""
    evidence = max(lesser.state.score(stand.x) - stand.state.score(stand.x), 0.0)
    return Worth(evidence, lesser.error, needed)


def kinds_of(state: State) -> list[str]:
    return [effect.kind for effect in state.model.effects]


def each_form(effect: Effect) -> list[Effect]:
    """The effect with every choice of form, its own first."""
    found = [effect]
    for name, options in type(effect).choices().items():
        found += [changed(e, {}, **{name: option}) for e in found for option in options if option != getattr(e, name)]
    return found
