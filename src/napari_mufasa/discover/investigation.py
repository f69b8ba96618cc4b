"""The conversation: look where the model fails, ask what is missing, add it, see the error fall.

`diagnose` plays it alone; the viewer and `refine` let a user play it by hand. The measurement is seen only through
a `Bench`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from napari_mufasa import checks
from napari_mufasa.chance.streams import Streams
from napari_mufasa.discover import joint
from napari_mufasa.discover.coordinates import changed
from napari_mufasa.discover.exchange import each_form
from napari_mufasa.discover.measurement import prepare
from napari_mufasa.discover.movie_bench import MovieBench
from napari_mufasa.discover.reporting import compile_report
from napari_mufasa.discover.result import Candidate, Report, Verdict
from napari_mufasa.discover.rules import FINALISTS, NEAR, REMOVALS, START
from napari_mufasa.discover.stand import share_of
from napari_mufasa.discover.start import begun, started
from napari_mufasa.discover.state import Lead, State
from napari_mufasa.discover.steps import Steps
from napari_mufasa.discover.trace_bench import TraceBench, candidate_kinds
from napari_mufasa.effects import Effect, catalogue, effect_class
from napari_mufasa.errors import MufasaError
from napari_mufasa.model.model import Model

if TYPE_CHECKING:
    from distributed import Client


class Investigation(Steps):
    """One measured movie, one believed model, and the steps taken so far.

    Parameters
    ----------
    movie : (frame, y, x) counts (ADU), array or lazy array
    model : the model believed; its shape and length are taken from the movie
    dark : (frame, y, x) dark frames or None
    seed : the same seed gives the same answer
    effects : kinds to consider; None: the whole catalogue that suits the camera
    budget : simulations that may be spent; None: 5000, fewer of a large movie (`rules.BUDGET_VALUES`)
    progress, cancel, client : see `simulate`

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
        client: Client | None = None,
    ) -> None:
        _check(model, seed)
        self.measurement = prepare(movie, model, dark)
        considered = _considered(effects, list(catalogue()), model)
        super().__init__(MovieBench(self.measurement, seed, progress, cancel, client), model, budget, *considered)
        self.suspects = tuple(effects or ())

    # Steps --------------------------------------------------------------------------------------------------

    def rank(self, tries: int = FINALISTS) -> list[Candidate]:
        """What is missing: the leads, the best of them tried by simulation, best first."""
        self.look()
        stand = self.stand
        self.bench.plan(tries * START)
        tried: dict[str, State] = {}
        for kind, forms in list(stand.leads.items())[:tries]:
            if len(tried) < 2 or forms[0].gain > stand.needed(kind):
                tried[kind] = started(stand.library, stand.state, forms, stand.x)
        misfits = {kind: state.misfit(stand.x) for kind, state in tried.items()}
        self.ranking = []
        for kind in sorted(tried, key=lambda k: misfits[k]):
            near = tuple(k for k in tried if k != kind and abs(misfits[k] - misfits[kind]) < NEAR)
            self.ranking.append(self._tried(kind, tried[kind], near))
        self.ranking += [self._lead(kind, forms[0]) for kind, forms in stand.leads.items() if kind not in tried]
        return self.ranking

    def add(self, *what: str | Effect | Candidate) -> None:
        """Fit effects into the model as it stands, together with all that is in it already. An `Effect` starts from its
        values; what the measurement shows directly is read off unless it was given."""
        stand = self.stand
        kinds = [w if isinstance(w, str) else w.effect if isinstance(w, Candidate) else w.kind for w in what]
        for kind in kinds:
            self._addable(kind)
        self.bench.plan(len(kinds) * START + self._settling(len(kinds)))
        state = stand.state
        for kind, one in zip(kinds, what, strict=True):
            if isinstance(one, Effect):
                seen = self.bench.read_off(kind, state.model)
                unsaid = {name: value for name, value in seen.items() if name not in one.model_fields_set}
                state = begun(stand.library, state, [changed(one, unsaid)], stand.x)
            elif kind in stand.leads:
                state = started(stand.library, state, stand.leads[kind], stand.x)
            else:  # not among those considered so far
                state = begun(stand.library, state, each_form(effect_class(kind)()), stand.x)
        self.kinds += [kind for kind in kinds if kind not in self.kinds]
        self._settle(state)
        self.arrive()

    def remove(self, *kinds: str) -> None:
        """Take effects out; the others are fitted anew."""
        for kind in kinds:
            if kind not in self.stand.added:
                raise MufasaError(f"{kind} was not added: {', '.join(self.stand.added) or 'nothing'} can be taken out")
        self.bench.plan(REMOVALS + self._settling(0))
        self._settle(joint.removed(self.stand.library, *kinds))
        self.arrive()

    def report(self, verdict: Verdict | None = None) -> Report:
        """What has been found so far."""
        return compile_report(self, verdict)

    # Inside -------------------------------------------------------------------------------------------------

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
        p, share = self.first.null.evidence_of(kind).p(gain), share_of(stand.error, after, stand.state.floor)
        return Candidate(kind, p, gain, after, share, effect.parameters(), {}, near)

    def _lead(self, kind: str, lead: Lead) -> Candidate:
        p = self.first.null.evidence_of(kind).p(lead.gain)
        return Candidate(kind, p, max(lead.gain, 0.0), None, None, lead.start().parameters(), {})


class TraceInvestigation(Investigation):
    """The same conversation about a table of traces alone; parameters as in `diagnose_traces`."""

    def __init__(
        self,
        traces: Any,
        model: Model,
        *,
        unit: str | None = None,
        profile: str | None = None,
        background_subtracted: bool | None = None,
        pixel_share: float | None = None,
        seed: int = 1,
        effects: Sequence[str] | None = None,
        budget: int | None = None,
        progress: Callable[[int, int], None] | None = None,
        cancel: Callable[[], bool] | None = None,
        client: Client | None = None,
    ) -> None:
        _check(model, seed)
        considered = _considered(effects, candidate_kinds(), model)
        bench = TraceBench(
            traces, model, unit, profile, background_subtracted, pixel_share, seed=seed, progress=progress,
            cancel=cancel, client=client,
        )  # fmt: skip
        Steps.__init__(self, bench, model, budget, *considered)
        self.suspects = tuple(effects or ())


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
