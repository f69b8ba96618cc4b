"""Would an effect be seen? Movies of a model are simulated with it, and looked at as a diagnosis looks at first.

A diagnosis of a movie that nothing is hidden in tells what chance does; movies with the effect tell how much more than
that it promises. In so many of them it is seen, and in so many of these it promises more than any other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
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
from napari_mufasa.simulate.movie import simulate, simulate_dark

if TYPE_CHECKING:
    from distributed import Client

FIRST_SEED = 30_000  # of the movies with the effect
CONFIDENCE = 0.95


@dataclass(frozen=True)
class Power:
    """How often an effect at one strength is seen.

    Attributes
    ----------
    effect : with its parameters · movies : that were simulated with it
    seen : in so many of them it promises more than chance gives the best of all effects (`needed`)
    first : in so many of these it promises most of all · evidence : its median, fall of −2 log likelihood
    needed : what chance alone exceeds in 2 % of movies without any effect (`rules.ALARM`)
    """

    effect: Effect
    movies: int
    seen: int
    first: int
    evidence: float
    needed: float

    @property
    def strength(self) -> float:
        return float(getattr(self.effect, self.effect.strength))

    @property
    def share(self) -> float:
        """The power: how likely the effect is seen in one movie."""
        return self.seen / self.movies

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % interval of `share` (Clopper and Pearson, Biometrika 26, 404, 1934)."""
        found = stats.binomtest(self.seen, self.movies).proportion_ci(CONFIDENCE, "exact")
        return float(found.low), float(found.high)

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
    progress: Callable[[int, int], None] | None = None,
    cancel: Callable[[], bool] | None = None,
    client: Client | None = None,
) -> list[Power]:
    """The power to see an effect in a movie of this model, before it is taken; one answer for each strength.

    Parameters
    ----------
    model : of the experiment; of a large one the part that a diagnosis looks at is simulated
    effect : what may be hidden in the movie; in the form and with the parameters given
    strengths : of the effect; None: the one it has
    movies : simulated with each · dark_frames : recorded beside the movie; 0: none
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
    if effect.kind in (known.kind for known in model.effects):
        raise MufasaError(f"{effect.kind} is in the model already: take it out there to ask whether it would be seen")
    cases = [_at(effect, s) for s in (strengths if strengths is not None else [getattr(effect, effect.strength)])]
    model = cropped(model)
    dark = simulate_dark(model, dark_frames, seed) if dark_frames else None
    inquiry = Investigation(
        simulate(model, seed=seed, cancel=cancel).movie, model, dark, seed=seed, effects=effects,
        progress=progress, cancel=cancel, client=client,
    )  # fmt: skip
    if effect.kind in inquiry.further:
        inquiry.kinds.append(effect.kind)
    elif effect.kind not in inquiry.kinds:
        raise MufasaError(f"{effect.kind} is not among the effects considered, or does not suit the camera")
    stand = inquiry.stand
    bench, state, needed = inquiry.bench, stand.state, stand.needed
    bench.plan((movies + len(stand.library.rays[effect.kind])) * len(cases))
    found = []
    for case in cases:
        rows = bench.rows([(state.model.with_effects(case), FIRST_SEED + k) for k in range(movies)])
        rows = np.where(
            np.isfinite(rows), rows, state.mean
        )  # what a movie does not show speaks neither for nor against
        rays = stand.library.rays | _as_read(stand.library, case)
        leads = [{kind: forms[0].gain for kind, forms in state.screen(x, rays).items()} for x in rows]
        seen = [gains for gains in leads if gains[case.kind] > needed]
        first = sum(max(gains, key=lambda kind: gains[kind]) == case.kind for gains in seen)
        evidence = float(np.median([gains[case.kind] for gains in leads]))
        found.append(Power(case, movies, len(seen), first, evidence, needed))
    return found


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
