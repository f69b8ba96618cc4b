"""The conversation played without a user: all of it (`diagnose`), or along effects that the user names (`refine`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from napari_mufasa.discover.investigation import Investigation, TraceInvestigation
from napari_mufasa.discover.result import Candidate, Report
from napari_mufasa.effects import Effect
from napari_mufasa.model.model import Model


def diagnose(
    movie: Any,
    model: Model,
    dark: Any = None,
    *,
    seed: int = 1,
    effects: Sequence[str] | None = None,
    max_effects: int = 3,
    progress: Callable[[int, int], None] | None = None,
    cancel: Callable[[], bool] | None = None,
) -> Report:
    """Find what a model lacks to explain a movie (docs/discovery.md).

    Effects are added one at a time while the evidence is beyond chance and the held-out error falls.

    Parameters
    ----------
    movie : (frame, y, x) counts (ADU), array or lazy array
    model : the model believed; its shape and length are taken from the movie
    dark : (frame, y, x) dark frames or None
    seed : the same seed gives the same answer
    effects : kinds to consider; None: the whole catalogue that suits the camera
    max_effects : so many are added at most
    progress : called with (done, in all); cancel : True stops (raises `Cancelled`)

    Raises
    ------
    MufasaError : a movie, dark frames, model or kind of effect that cannot be used.
    """
    inquiry = Investigation(movie, model, dark, seed=seed, effects=effects, progress=progress, cancel=cancel)
    return _played(inquiry, max_effects)


def diagnose_traces(
    traces: Any,
    model: Model,
    *,
    unit: str = "photoelectrons",
    profile: str = "psf",
    background_subtracted: bool = True,
    pixel_share: float | None = None,
    effects: Sequence[str] | None = None,
    max_effects: int = 3,
    seed: int = 1,
    progress: Callable[[int, int], None] | None = None,
    cancel: Callable[[], bool] | None = None,
) -> Report:
    """Find what a model lacks to explain a table of traces (molecule, frame), when there is no movie
    (docs/discovery.md).

    The same evidence, rules and report as for movies, from what traces show without an image. Brightness and
    background are fitted first, from ADU also the EM gain.

    Parameters
    ----------
    traces … pixel_share : as for `compare_traces`
    effects : kinds to consider; None: those of photophysics and light that a lone trace can show
    max_effects, seed, progress, cancel : as for `diagnose`

    Raises
    ------
    MufasaError : traces that are too few or unusable, an unknown effect or option.
    """
    inquiry = TraceInvestigation(
        traces, model, unit=unit, profile=profile, background_subtracted=background_subtracted,
        pixel_share=pixel_share, seed=seed, effects=effects, progress=progress, cancel=cancel,
    )  # fmt: skip
    return _played(inquiry, max_effects)


def _played(inquiry: Investigation, max_effects: int) -> Report:
    """The whole conversation: effects are added while they convince."""
    inquiry.examine()
    told: list[Candidate] = []  # the ranking a reader wants is that of the base model
    while len(inquiry.chosen) < max_effects and inquiry.leads() and inquiry.alarmed():
        ranking = inquiry.rank()
        helped = any(inquiry.convincing(candidate) and _holds(inquiry, candidate) for candidate in ranking)
        if helped:
            inquiry.simplify()
            inquiry.reconsider()
        fitted_now = {c.effect: c for c in inquiry.ranking if c.effect in inquiry.chosen}
        told = [fitted_now.get(c.effect, c) for c in told] or inquiry.ranking
        told = sorted(told, key=lambda c: c.effect not in inquiry.chosen)
        if not helped:
            break
    inquiry.ranking = told
    inquiry.approach()  # still far off: what is told of the model is what simulations around it show
    return inquiry.report()


def _holds(inquiry: Investigation, candidate: Candidate) -> bool:
    """Add an effect; take it out again where, once it is settled, there is none of it or it does not help."""
    before = inquiry.state
    inquiry.add(candidate)
    if inquiry.fits[-1].is_some and inquiry.improves(before, inquiry.state, candidate):
        return True
    inquiry.undo()
    return False


def refine(
    movie: Any,
    model: Model,
    add: Sequence[str | Effect],
    dark: Any = None,
    *,
    seed: int = 1,
    progress: Callable[[int, int], None] | None = None,
    cancel: Callable[[], bool] | None = None,
) -> Report:
    """The same loop by hand: fit the effects the user names, in order, and report the error (docs/discovery.md).

    Parameters
    ----------
    add : kinds, fitted from scratch, or effects, whose values the fit starts from
    movie, model, dark, seed : as for `diagnose`
    progress : called with (done, in all); cancel : True stops (raises `Cancelled`)

    Raises
    ------
    MufasaError : a movie, dark frames, model or effect that cannot be used.
    """
    add = [add] if isinstance(add, (str, Effect)) else add
    kinds = [a if isinstance(a, str) else a.kind for a in add]
    inquiry = Investigation(movie, model, dark, seed=seed, effects=kinds, progress=progress, cancel=cancel)
    for effect in add:
        inquiry.add(effect)
    return inquiry.report()
