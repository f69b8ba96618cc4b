"""The contest for a place in the model: many effects and forms are judged by few simulations, close ones by more.

How close is told in shares of the best evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.discover import fit
from napari_mufasa.discover.coordinates import changed
from napari_mufasa.discover.fit import Fit
from napari_mufasa.discover.library import Library
from napari_mufasa.discover.null import ALARM, Null
from napari_mufasa.discover.state import Lead, State
from napari_mufasa.effects import Effect

Array = NDArray[np.float64]
FINALISTS, LATER_FINALISTS = 5, 3  # leads that are fitted by simulation, for the first effect and for further ones
STARTS = 0.25  # a first effect is fitted from this share of the best lead's evidence
PROMISING = 0.6  # a further one from this share of the evidence that is needed
FORM_WORTH = 0.2  # of the evidence: another form is fitted
MISFIT = 0.05  # at the floor, with less misfit than chance leaves so often, a fit is left as it is
CONTESTED = 0.6  # of the best evidence: contested, each may show its best form
PLAIN = 15.0  # −2 log likelihood by which another form must be better than the plain one (noise of judging: about 5)
CLOSE = 0.85  # of the best evidence: rivals and forms are judged by more simulations


class Contest:
    """Effects fitted into one state, and judged against each other by the measurement x (part, observable).

    tried : fits by kind of effect · formed : of those, the kinds tried in all their promising forms
    """

    def __init__(self, library: Library, state: State, x: Array, null: Callable[[], Null]) -> None:
        self.library, self.state, self.x = library, state, x
        self.tried: dict[str, Fit] = {}
        self.formed: set[str] = set()
        self._null = null

    def evidence(self, found: Fit) -> float:
        """Twice the log likelihood ratio of a fit against the model as it stands."""
        return self.state.score(self.x) - found.score

    def run(self, leads: dict[str, list[Lead]], needed: dict[str, float] | None) -> None:
        """Fit the finalists; those that are contested in all their forms, close rivals with more simulations.

        `needed` is the evidence that each further effect must bring, None for the first one. A fit that ends at no
        strength does not count: what explains there is what moved beside it.
        """
        most = FINALISTS if needed is None else LATER_FINALISTS
        self.library.bench.plan(most * fit.planned_simulations())
        for kind in _worth_a_fit(leads, needed):
            to_beat = max(map(self.evidence, self.tried.values()), default=0.0)
            tried = self._tried(leads[kind], to_beat)
            if tried is not None and tried.is_some:
                self.tried[kind] = tried
            most -= tried is None or tried.is_some
            if most == 0:
                break
        if not self.tried:
            return
        # With several things missing it matters little which comes first.
        far = all(tried.state.far_off(self.x) for tried in self.tried.values())
        contested = self._within(CLOSE if far else CONTESTED)
        if len(contested) > 1:
            self.tried |= {kind: self._best_form(self.tried[kind]) for kind in contested}
            self.formed = set(contested)
        if not far and len(close := self._within(CLOSE)) > 1:
            again = sharpened(self.library, [self.tried[kind] for kind in close], self.x)
            self.tried |= zip(close, again, strict=True)

    def _tried(self, forms: Sequence[Lead], to_beat: float) -> Fit | None:
        """The best of an effect's forms fitted, None where it explains far less than `to_beat`. A fit that explains
        more than chance and still ends at no strength has gone astray: then the other forms have their turn."""
        starts, promised = [lead.start() for lead in forms], forms[0].gain
        found = fit.fit_if_promising(self.library, self.state, starts, self.x, to_beat, promised)
        if found is None or found.is_some or self.evidence(found) < self._null().evidence.at(ALARM):
            return found
        others = [start for start in starts if start.chosen != found.effect.chosen]
        again = fit.fit_if_promising(self.library, self.state, others, self.x, to_beat) if others else None
        return again if again is not None and again.is_some else found

    def fitted(self, starts: Sequence[Effect]) -> Fit:
        """One effect from the best of `starts`, its forms; where misfit is left, in its best form."""
        kind = starts[0].kind
        found = self.tried.get(kind) or fit.fit_effect(self.library, self.state, starts, self.x)
        return found if kind in self.formed else self._best_form(found)

    def settled(self, found: Fit) -> Fit:
        """The fit judged by more simulations; where it leaves more than chance, also with derivatives of its own, and
        once more where its best lies beyond what was simulated."""
        (found,) = sharpened(self.library, [found], self.x)
        for turn in range(2):
            if self._content(found) or (turn and not fit.lies_beyond(found, self.x)):
                break
            self.library.bench.plan(fit.sharpening_simulations(self.library, len(found.state.free)))
            again = fit.sharpen(self.library, found, self.x, anew=True)
            if again.score >= found.score:
                break
            found = again
        return found

    def _content(self, found: Fit) -> bool:
        """Is the held-out error at its floor, and no more misfit left than chance leaves?"""
        return found.state.at_floor(self.x) and self._null().misfit.p(found.misfit) > MISFIT

    def _within(self, share: float) -> list[str]:
        """The fitted effects with more than this share of the best evidence."""
        best = max(map(self.evidence, self.tried.values()))
        return [kind for kind, found in self.tried.items() if self.evidence(found) > share * best]

    def _best_form(self, found: Fit) -> Fit:
        """The same effect in its other forms (other time courses, dwell laws, profiles), where one fits better; the
        plain one is always among them."""
        plain, form = type(found.effect)().chosen, found.effect.chosen
        others: list[Lead] = []
        if not self._content(found):
            leads = self.state.screen(self.x, {found.effect.kind: self.library.rays[found.effect.kind]})
            best, *_ = forms = leads[found.effect.kind]
            # A form that is chance itself (a walk, pink noise) promises far less by one simulation than it holds, and
            # one that was simulated at weak settings only less than it does where it is stronger.
            worth = [lead for lead in forms if lead.gain > FORM_WORTH * best.gain or lead.may_be_stronger]
            others = [lead for lead in worth if lead.ray.effect.chosen != form]
        starts = [lead.start() for lead in others]
        if plain not in (form, *(start.chosen for start in starts)):
            starts.append(changed(found.effect, {}, **plain))
        self.library.bench.plan(len(starts) * fit.planned_simulations())
        least = FORM_WORTH / fit.HOPELESS * self.evidence(found)
        tries = [fit.fit_if_promising(self.library, self.state, start, self.x, least) for start in starts]
        return self._closest([found, *filter(None, tries)])

    def _closest(self, fits: Sequence[Fit]) -> Fit:
        """The best of several forms; those that come close are judged by more simulations first, and by how well they
        tell the half of the field that they were not fitted to. The plain one stays unless another is clearly better.

        The likelihood of the whole field is no judge of its own: what differs from sensor to sensor moves many
        observables together, and a form without that freedom looks sharper than it is.
        """
        bar = CLOSE * max(self.evidence(found) for found in fits)
        close = [found for found in fits if self.evidence(found) > bar] or fits
        if len(close) > 1:
            close = sharpened(self.library, close, self.x)

        def worse(found: Fit) -> float:
            error = found.state.held_out_error(self.x)
            plain = found.effect.chosen == type(found.effect)().chosen
            return float(found.score + self.x.shape[1] * error**2 - (PLAIN if plain else 0.0))

        return min(close, key=worse)


def _worth_a_fit(leads: dict[str, list[Lead]], needed: dict[str, float] | None) -> list[str]:
    """The leads worth a fit, best first; few where the first is far ahead or none can be convincing."""
    order = list(leads)
    gain = [leads[kind][0].gain for kind in order]
    if needed is None:
        return [k for i, k in enumerate(order) if i < 2 or gain[i] > STARTS * max(gain[0], 1.0)]
    return [k for i, k in enumerate(order) if i < 1 or gain[i] > PROMISING * needed[k]]


def sharpened(library: Library, fits: Sequence[Fit], x: Array) -> list[Fit]:
    """Fits judged by more simulations."""
    library.bench.plan(len(fits) * fit.sharpening_simulations(library))
    return [fit.sharpen(library, found, x) for found in fits]
