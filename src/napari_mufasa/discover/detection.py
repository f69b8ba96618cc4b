"""Would an effect be seen? Movies of a model are simulated with it, and looked at as a diagnosis looks at first.

A diagnosis of a movie that nothing is hidden in tells what chance does there; movies with the effect tell how much more
than that it promises. In so many of them it is seen, and in so many of these it promises more than any other. What
chance does differs from one diagnosis to the next, which learns it from a few simulations: several are asked.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from napari_mufasa import checks
from napari_mufasa.discover.coordinates import changed, hard_limits
from napari_mufasa.discover.investigation import Investigation
from napari_mufasa.discover.library import Library, as_seen, simulated_rays
from napari_mufasa.discover.measurement import cropped
from napari_mufasa.discover.state import Ray
from napari_mufasa.effects import Effect
from napari_mufasa.errors import MufasaError
from napari_mufasa.model.model import Model
from napari_mufasa.simulate.movie import Progress, simulate, simulate_dark

if TYPE_CHECKING:
    from distributed import Client

FIRST_SEED = 30_000  # of the movies with the effect
CONFIDENCE = 0.95
LOOKS = 10  # at most: diagnoses of movies without the effect, each of which tells anew what chance does …
EACH = 4  # … for so many movies with it at least


@dataclass(frozen=True)
class Look:
    """What one diagnosis saw in the movies with an effect that it looked at.

    needed : what the effect must promise there: by chance any effect does so in 2 % of movies (`rules.ALARM`)
    evidence (movie,) : what it promises, fall of −2 log likelihood · first (movie,) : no other promises more
    """

    needed: float
    evidence: NDArray[np.float64]
    first: NDArray[np.bool_]

    @property
    def seen(self) -> int:
        """In so many movies it promises more than chance."""
        return int((self.evidence > self.needed).sum())


@dataclass(frozen=True)
class Power:
    """How often an effect at one strength is seen; `looks`: of diagnoses that know nothing of each other."""

    effect: Effect
    looks: tuple[Look, ...]

    @property
    def strength(self) -> float:
        return float(getattr(self.effect, self.effect.strength))

    @property
    def movies(self) -> int:
        """So many were simulated with the effect."""
        return sum(len(look.evidence) for look in self.looks)

    @property
    def seen(self) -> int:
        """In so many of them it promises more than chance."""
        return sum(look.seen for look in self.looks)

    @property
    def first(self) -> int:
        """In so many of these it promises most of all."""
        return sum(int((look.first & (look.evidence > look.needed)).sum()) for look in self.looks)

    @property
    def evidence(self) -> float:
        """The median of what it promises."""
        return float(np.median(np.concatenate([look.evidence for look in self.looks])))

    @property
    def needed(self) -> float:
        """The median of what it must promise."""
        return float(np.median([look.needed for look in self.looks]))

    @property
    def share(self) -> float:
        """The power: how likely the effect is seen in one movie."""
        return self.seen / self.movies

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % interval of `share`: that of Clopper and Pearson for as many movies, each with a diagnosis of its
        own, as would tell the share as well (Korn and Graubard, Surv. Methodol. 24, 193, 1998). Where all are seen, or
        none, nothing tells how far diagnoses differ: it is that of so many movies."""
        n, tail = self._worth_movies, (1 - CONFIDENCE) / 2
        seen = n * self.share
        low = stats.beta.ppf(tail, seen, n - seen + 1) if seen > 0 else 0.0
        high = stats.beta.isf(tail, seen + 1, n - seen) if seen < n else 1.0
        return float(low), float(high)

    @property
    def _worth_movies(self) -> float:
        """So many movies with a diagnosis each would tell the share as well as these, of which some share one."""
        p, n, looks = self.share, self.movies, len(self.looks)
        if looks < 2 or not 0 < p < 1:
            return n
        off = np.array([look.seen - p * len(look.evidence) for look in self.looks])
        variance = looks / (looks - 1) * float(off @ off) / n**2
        few = float(stats.t.ppf((1 + CONFIDENCE) / 2, n - 1) / stats.t.ppf((1 + CONFIDENCE) / 2, looks - 1))
        return float(min(n, p * (1 - p) / max(variance, 1e-12) * few**2))

    def row(self) -> dict[str, float]:
        """One row of a table."""
        low, high = self.interval
        return {
            self.effect.strength: self.strength, "power": self.share, "power_low": low, "power_high": high,
            "first": self.first / self.movies, "evidence": self.evidence,
        }  # fmt: skip


def power(
    model: Model,
    effect: Effect,
    strengths: Sequence[float] | None = None,
    *,
    movies: int = 40,
    dark_frames: int = 50,
    effects: Sequence[str] | None = None,
    seed: int = 1,
    progress: Progress | None = None,
    cancel: Callable[[], bool] | None = None,
    client: Client | None = None,
) -> list[Power]:
    """The power to see an effect in a movie of this model, before it is taken; one answer for each strength.

    Parameters
    ----------
    model : of the experiment; of a large one the part that a diagnosis looks at is simulated
    effect : what may be hidden in the movie; in the form and with the parameters given
    strengths : of the effect; None: the one it has
    movies : simulated with each; four or more share a diagnosis that tells what chance does there, of two to ten ·
    dark_frames : recorded beside the movie; 0: none
    effects : kinds that a diagnosis considers; None: the common ones of the catalogue, and this one
    seed : the same seed gives the same answer · progress, cancel, client : see `simulate`

    Raises
    ------
    MufasaError : an effect that the model has, a strength it cannot have, numbers that cannot be used.
    Memory: one movie per core.
    """
    checks.need(model, Model, "model", "give nm.preset(…) or Model.from_json(PATH)")
    checks.need(
        effect, Effect, "effect", "give nm.catalogue()[KIND](…), as nm.catalogue()['stage_drift'](distance_px=0.5)"
    )
    checks.whole(movies, "movies", 2, 10_000)
    checks.whole(dark_frames, "dark_frames", 0, 10_000)
    checks.seed(seed)
    if effect.kind in (known.kind for known in model.effects):
        raise MufasaError(f"{effect.kind} is in the model already: take it out there to ask whether it would be seen")
    cases = [_at(effect, s) for s in (strengths if strengths is not None else [getattr(effect, effect.strength)])]
    if not cases:
        raise MufasaError("strengths is empty: give one or more, or None for the one that the effect has")
    model = cropped(model)
    n_looks = min(max(movies // EACH, 2), LOOKS)
    shares = [len(share) for share in np.array_split(np.arange(movies), n_looks)]
    found: list[list[Look]] = [[] for _ in cases]
    for i, share in enumerate(shares):
        own = seed * LOOKS + i
        inquiry = Investigation(
            simulate(model, seed=own, cancel=cancel).movie, model,
            simulate_dark(model, dark_frames, own) if dark_frames else None, seed=own, effects=effects,
            progress=_turn(progress, i, n_looks), cancel=cancel, client=client,
        )  # fmt: skip
        for looks, look in zip(found, _looks(inquiry, cases, share), strict=True):
            looks.append(look)
    return [Power(case, tuple(looks)) for case, looks in zip(cases, found, strict=True)]


def _looks(inquiry: Investigation, cases: Sequence[Effect], movies: int) -> list[Look]:
    """What a diagnosis of a movie without an effect sees in movies with it; of each case."""
    kind = cases[0].kind
    if kind in inquiry.further:
        inquiry.kinds.append(kind)
    elif kind not in inquiry.kinds:
        raise MufasaError(f"{kind} is not among the effects considered, or does not suit the camera")
    stand = inquiry.stand
    bench, state = inquiry.bench, stand.state
    bench.plan((movies + len(stand.library.rays[kind])) * len(cases))
    found = []
    for case in cases:
        rows = bench.rows([(state.model.with_effects(case), FIRST_SEED + k) for k in range(movies)])
        rows = np.where(
            np.isfinite(rows), rows, state.mean
        )  # what a movie does not show speaks neither for nor against
        rays = stand.library.rays | _as_read(stand.library, case)
        leads = [{other: forms[0].gain for other, forms in state.screen(x, rays).items()} for x in rows]
        evidence = np.array([gains[kind] for gains in leads])
        best = np.array([max(gains.values()) for gains in leads])
        found.append(Look(stand.needed(kind), evidence, evidence == best))
    return found


def _turn(progress: Progress | None, done: int, of: int) -> Progress | None:
    """The progress of one of several diagnoses, as part of all."""
    if progress is None:
        return None
    told = progress
    return lambda now, total: told(done * total + now, of * total)


def strength_seen(found: Sequence[Power], share: float = 0.9) -> float | None:
    """The least strength that is seen with a power of `share`, between those tried (on a line over the logarithm of
    strengths that are all above 0); None where none of them is."""
    ordered = sorted(found, key=lambda one: one.strength)
    x = np.array([one.strength for one in ordered])
    scale = np.log if (x > 0).all() else lambda values: values
    for weaker, stronger in zip([None, *ordered], ordered, strict=False):
        if stronger.share < share:
            continue
        if weaker is None:
            return stronger.strength
        part = (share - weaker.share) / (stronger.share - weaker.share)
        ends = scale(np.array([weaker.strength, stronger.strength]))
        at = float(ends[0] + part * (ends[1] - ends[0]))
        return float(np.exp(at)) if (x > 0).all() else at
    return None


def _as_read(library: Library, case: Effect) -> dict[str, list[Ray]]:
    """The rays of an effect turned as it is: a diagnosis reads directions and the like off the movie that has it."""
    read = library.bench.read_off(case.kind)
    seen = {name: getattr(case, name) for name, value in read.items() if isinstance(value, float)}
    if not seen:
        return {}
    return simulated_rays(library, {case.kind: as_seen([ray.effect for ray in library.rays[case.kind]], seen)})


def _at(effect: Effect, strength: float) -> Effect:
    low, high = hard_limits(effect, effect.strength)
    checks.number(strength, f"{effect.kind}.{effect.strength}", low, high)
    return changed(effect, {effect.strength: float(strength)})
