"""Where an investigation stands: one measurement, one model believed, and the steps taken so far."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from napari_mufasa.discover import camera, joint, library
from napari_mufasa.discover.bench import Bench
from napari_mufasa.discover.null import Null
from napari_mufasa.discover.result import Candidate
from napari_mufasa.discover.rules import BUDGET, BUDGET_VALUES, CAMERA_OFF, CAMERA_ROUNDS, NEAR, START, TELLING
from napari_mufasa.discover.stand import Stand
from napari_mufasa.discover.state import State
from napari_mufasa.errors import MufasaError
from napari_mufasa.model.model import Model


class Standing:
    """One measurement (seen through its bench), one model believed, the kinds of effects considered, and the stands:
    of the model believed, then after each step.

    kinds : of effects considered · further : those considered where they leave the model far off its floor
    suspects : the only kinds that its user has asked for; () where the catalogue is searched
    ranking : effects that are not in the model, as of the last look · budget : simulations that may be spent ·
    reserve : those of them that are kept for later · most_effects : that are added (None: as many as earn their place)
    """

    def __init__(
        self, bench: Bench[Any], believed: Model, budget: int | None, kinds: list[str], further: list[str]
    ) -> None:
        self._started = time.monotonic()
        self.bench, self.believed, self.seed = bench, believed, bench.seed
        self.kinds, self.further = kinds, further
        self.suspects: tuple[str, ...] = ()
        self.budget = min(BUDGET, BUDGET_VALUES // bench.size) if budget is None else budget
        self.reserve = 0
        self.most_effects: int | None = None
        self.stands: list[Stand] = []
        self.ranking: list[Candidate] = []

    def examine(self) -> None:
        """Match the nuisance values, set the camera right, simulate the neighbourhood of model and effects."""
        bench = self.bench
        n_free = len(bench.free_values(bench.start))
        bench.plan(bench.matching_simulations + library.expected_simulations(self.kinds, n_free, bench.start))
        near = library.with_rays(self._with_its_camera(), self.kinds)
        self.stands = [Stand(near, (), bench.x, Null.of(*near.null_distribution()), near.base)]

    def _with_its_camera(self) -> library.Library:
        """The neighbourhood of the model believed, its nuisance values matched, and gain and read noise of its camera
        set right where they are far off: slopes say too little from there. The camera is left as it is believed where
        it is its register's noise that is not what is believed."""
        bench = self.bench
        near = believed = library.build(bench, bench.matched(bench.start), ())
        look = library.ray_simulations(self.kinds, bench.start) + START
        again = bench.matching_simulations + library.expected_simulations([], len(near.base.free), bench.start)
        for _ in range(CAMERA_ROUNDS if bench.shows_camera else 0):
            model = camera.set_right(near.base, bench.x, CAMERA_OFF if near is believed else CAMERA_OFF**2)
            if model is near.base.model or self.left < again + look:
                break
            bench.plan(again + look)
            there = library.build(bench, bench.matched(model), ())
            if there.base.score(bench.x) > near.base.score(bench.x) - NEAR:
                break
            near = there
        if near is believed or not camera.may_be_register(bench.start):
            return near
        return believed if camera.is_register(near, believed, bench.x) else near

    @property
    def first(self) -> Stand:
        """The model believed, its nuisance values near the measurement."""
        if not self.stands:
            self.examine()
        return self.stands[0]

    @property
    def stand(self) -> Stand:
        """The model as it stands."""
        return self.stands[-1] if self.stands else self.first

    @property
    def state(self) -> State:
        return self.stand.state

    @property
    def camera_is_off(self) -> bool:
        """Whether the camera was found not to be as believed."""
        return camera.is_off(self.state)

    @property
    def chosen(self) -> list[str]:
        return list(self.stand.added)

    @property
    def model(self) -> Model:
        """The model as it stands, its free values at their best."""
        return self.state.model_at(self.state.adjusted(self.bench.x).moves)

    @property
    def seconds(self) -> float:
        return time.monotonic() - self._started

    @property
    def left(self) -> int:
        """Simulations that may still be spent, but for the reserve and those that a report takes."""
        return self.budget - self.reserve - self.bench.done - TELLING

    @property
    def room(self) -> int | None:
        """How many effects more may be added; None: any number."""
        return None if self.most_effects is None else max(self.most_effects - len(self.chosen), 0)

    def affords(self, n_effects: int) -> bool:
        """Whether so many effects can be started and settled within the budget, with one step downhill at least; and
        further ones so that what is in the model can still be judged."""
        stand = self.stand
        n_free = len(stand.state.free) + 2 * n_effects
        least = library.further_simulations(stand.library, self.kinds, n_free, stand.state.model) + 4 * n_free
        return self.left > n_effects * START + least * (2 if n_effects and self.chosen else 1)

    def candidates(self) -> list[Candidate]:
        """The cases of the effects in the model."""
        stand, model, sds = self.stand, self.model, self.stand.uncertainties
        found = []
        for kind in stand.added:
            worth, effect = stand.worths[kind], next(e for e in model.effects if e.kind == kind)
            evidence, error = max(worth.evidence, 0.0), stand.error
            p = stand.null.evidence_of(kind).p(evidence)
            found.append(
                Candidate(
                    kind,
                    p,
                    evidence,
                    error,
                    stand.share(kind),
                    effect.parameters(),
                    sds[kind],
                    tuple(stand.in_place_of(kind)),
                    worth.error_without,
                )
            )
        return found

    def undo(self) -> None:
        """Take the last step back."""
        if len(self.stands) < 2:
            raise MufasaError("nothing to undo: no effect was added")
        self.stands.pop()

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
