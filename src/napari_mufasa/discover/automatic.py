"""The conversation played without a user: all of it (`diagnose`), or along effects that the user names (`refine`)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

from napari_mufasa import checks
from napari_mufasa.discover.investigation import Investigation, TraceInvestigation
from napari_mufasa.discover.result import Report
from napari_mufasa.discover.state import Lead
from napari_mufasa.effects import Effect
from napari_mufasa.errors import MufasaError
from napari_mufasa.model.model import Model

if TYPE_CHECKING:
    from distributed import Client


def diagnose(
    movie: Any,
    model: Model,
    dark: Any = None,
    *,
    seed: int = 1,
    effects: Sequence[str] | None = None,
    max_effects: int | None = None,
    budget: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    cancel: Callable[[], bool] | None = None,
    client: Client | None = None,
) -> Report:
    """Find what a model lacks to explain a movie (docs/discovery.md).

    What explains the misfit together is taken up and fitted together; what does not earn its place is taken out again,
    until nothing more is beyond chance or the budget is spent.

    Parameters
    ----------
    movie : (frame, y, x) counts (ADU), array or lazy array
    model : the model believed; its shape and length are taken from the movie
    dark : (frame, y, x) dark frames; None: those of the movie before the light comes on, if there are any; the movie's
        own are left out either way
    seed : the same seed gives the same answer
    effects : kinds to consider; None: the whole catalogue that suits the camera, uncommon effects where the common
        ones leave the model far off its floor
    max_effects : so many are added at most; None: as many as earn their place
    budget : simulations that may be spent; None: 5000, fewer of a large movie
    progress : called with (done, in all); cancel : True stops (raises `Cancelled`)
    client : of a cluster that simulates (docs/clusters.md)

    Raises
    ------
    MufasaError : a movie, dark frames, model or kind of effect that cannot be used.
    """
    _check(max_effects, budget)
    inquiry = Investigation(
        movie, model, dark, seed=seed, effects=effects, budget=budget, progress=progress, cancel=cancel, client=client,
    )  # fmt: skip
    return play(inquiry, max_effects)


def diagnose_traces(
    traces: Any,
    model: Model,
    *,
    unit: str | None = None,
    profile: str | None = None,
    background_subtracted: bool | None = None,
    pixel_share: float | None = None,
    effects: Sequence[str] | None = None,
    max_effects: int | None = None,
    budget: int | None = None,
    seed: int = 1,
    progress: Callable[[int, int], None] | None = None,
    cancel: Callable[[], bool] | None = None,
    client: Client | None = None,
) -> Report:
    """Find what a model lacks to explain a table of traces (molecule, frame), when there is no movie
    (docs/discovery.md).

    The same evidence, rules and report as for movies, from what traces show without an image. Brightness and
    background are fitted first, from ADU also the EM gain.

    Parameters
    ----------
    traces … pixel_share : as for `compare_traces`
    effects : kinds to consider; None: those of photophysics and light that a lone trace can show
    max_effects, budget, seed, progress, cancel, client : as for `diagnose`

    Raises
    ------
    MufasaError : traces that are too few or unusable, an unknown effect or option.
    """
    _check(max_effects, budget)
    inquiry = TraceInvestigation(
        traces, model, unit=unit, profile=profile, background_subtracted=background_subtracted,
        pixel_share=pixel_share, seed=seed, effects=effects, budget=budget, progress=progress, cancel=cancel,
        client=client,
    )  # fmt: skip
    return play(inquiry, max_effects)


def play(inquiry: Investigation, max_effects: int | None) -> Report:
    """The whole conversation, by one way and, where that leaves something unexplained, by a second: what it has
    ended with begun afresh. Half of the budget is kept for that, but where the first way is near when its own half
    ends it, it goes on with what is left. The one that leaves less error is kept, and what was spared in it for the
    budget's sake is judged; its values are told from where they have come to. Where simulations are cheap, one way has
    all the budget: values are matched again beside every effect there, which leaves them less room to go astray."""
    inquiry.most_effects = max_effects
    inquiry.examine()
    ranking = inquiry.rank(0)
    twice = not inquiry.bench.is_cheap
    inquiry.reserve = inquiry.left // 2 if twice else 0
    if not inquiry.affords(1):  # a second way begins with what the first has found
        inquiry.reserve = 0
    _one_way(inquiry)
    cut_short = twice and inquiry.chosen and not inquiry.affords(1)
    inquiry.reserve = 0
    if cut_short and inquiry.affords(1) and not inquiry.stand.far_off:
        _one_way(inquiry)
    first_way = inquiry.stands
    unexplained = inquiry.chosen and not inquiry.stand.content
    if twice and unexplained:
        if inquiry.begin_afresh() or inquiry.stand.far_off:
            _one_way(inquiry)
        inquiry.stands = min(first_way, inquiry.stands, key=lambda stands: stands[-1].error)
    believed = inquiry.first
    inquiry.judge_camera()
    if inquiry.first is not believed:
        ranking = inquiry.rank(0)
    inquiry.prune()
    if inquiry.chosen and inquiry.stand.content:
        inquiry.exchange()
    while inquiry.merge():
        inquiry.prune()
    inquiry.arrive()
    inquiry.ranking = [candidate for candidate in ranking if candidate.effect not in inquiry.chosen]
    return inquiry.report()


def _one_way(inquiry: Investigation) -> None:
    """What explains the misfit is taken up together and fitted together until nothing more promises anything; what does
    not earn its place goes again, and another look is taken, until all that is left has earned it, or the budget is
    spent. Nothing is judged far from the floor while a second way is to come."""
    dismissed: dict[str, set[str]] = {}  # kinds taken out again, and beside which others
    while True:
        _climb(inquiry, dismissed)
        too_early = inquiry.reserve and inquiry.stand.far_off
        dropped = set[str]() if too_early else inquiry.prune()
        _dismiss(dismissed, dropped, inquiry)
        if inquiry.stand.content or not (dropped or (inquiry.chosen and (inquiry.deepen() or inquiry.exchange()))):
            break


def _climb(inquiry: Investigation, dismissed: dict[str, set[str]]) -> None:
    """Take up what promises something, or other forms of what is in the model where they promise more, until nothing
    does; drop what is surely useless on the way."""
    while True:
        if inquiry.chosen and not inquiry.stand.far_off:
            _dismiss(dismissed, inquiry.prune(sure=True), inquiry)
        if inquiry.chosen and (inquiry.stand.content or not inquiry.affords(1)):
            break
        inquiry.look()
        stand, known = inquiry.stand, set(inquiry.chosen)
        but = {kind for kind, beside in dismissed.items() if known <= beside}
        leads = stand.promising(but) if stand.alarmed or known else []
        leads = leads[: inquiry.room]
        if (known or not leads) and inquiry.widen():
            continue
        if not leads:
            break
        apart = [cases for cases in leads if not known or stand.stands_apart(cases[0][0])]
        leads = leads if stand.far_off else apart or leads
        if known and not apart and (inquiry.deepen() or _in_other_forms(inquiry, [cases[0][0] for cases in leads])):
            continue
        if not (affordable := [leads[:n] for n in range(len(leads), 0, -1) if inquiry.affords(n)]):
            break
        _dismiss(dismissed, inquiry.take_up(affordable[0]), inquiry)


def _in_other_forms(inquiry: Investigation, leads: list[Lead]) -> bool:
    """Other forms of the effects that have moved what these leads move, or else of all that are in the model."""
    kin = set[str]().union(*(inquiry.stand.kin(lead) for lead in leads))
    return inquiry.exchange(sum(lead.gain for lead in leads), kin or None)


def _dismiss(dismissed: dict[str, set[str]], dropped: set[str], inquiry: Investigation) -> None:
    """Note what was taken out again, and beside what."""
    beside = set(inquiry.chosen) | dropped
    dismissed |= {kind: beside for kind in dropped}


def _check(max_effects: int | None, budget: int | None) -> None:
    if max_effects is not None:
        checks.whole(max_effects, "max_effects")
    if budget is not None:
        checks.whole(budget, "budget", 1)


def refine(
    movie: Any,
    model: Model,
    add: Sequence[str | Effect],
    dark: Any = None,
    *,
    seed: int = 1,
    progress: Callable[[int, int], None] | None = None,
    cancel: Callable[[], bool] | None = None,
    client: Client | None = None,
) -> Report:
    """The same by hand: fit the effects the user names, together, and report the error (docs/discovery.md).

    Parameters
    ----------
    add : kinds, fitted from scratch, or effects, whose values the fit starts from
    movie, model, dark, seed : as for `diagnose`
    progress : called with (done, in all); cancel : True stops (raises `Cancelled`)
    client : of a cluster that simulates (docs/clusters.md)

    Raises
    ------
    MufasaError : a movie, dark frames, model or effect that cannot be used.
    """
    add = [add] if isinstance(add, (str, Effect)) else add
    if not isinstance(add, Iterable) or not (add := list(add)) or not all(isinstance(a, (str, Effect)) for a in add):
        raise MufasaError("nothing to add: give `add`, a list of kinds of effects, or of effects")
    kinds = [a if isinstance(a, str) else a.kind for a in add]
    checks.need(model, Model, "model", "give preset(NAME) or Model.from_json(PATH)")
    if twice := sorted({kind for kind in kinds if kinds.count(kind) > 1}):
        raise MufasaError(f"{twice[0]} is added twice: give one of each kind")
    for kind in {effect.kind for effect in model.effects} & set(kinds):
        raise MufasaError(f"{kind} is in the model already: take it out there first, or add another effect")
    inquiry = Investigation(
        movie, model, dark, seed=seed, effects=kinds, progress=progress, cancel=cancel, client=client
    )
    inquiry.add(*add)
    inquiry.judge_camera()
    return inquiry.report()
