"""Does a finding hold elsewhere: in the other half of the field, in another movie of the same set-up?

Two questions, each answered by data that the finding has not seen. Does a diagnosis there, from the model believed,
name the same effects with the same parameters? And how far off is the completed model there, when nothing but
brightness, background, molecules and what a movie shows directly is taken from there?
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_mufasa import checks
from napari_mufasa.discover import library
from napari_mufasa.discover.automatic import diagnose
from napari_mufasa.discover.coordinates import changed
from napari_mufasa.discover.measurement import prepare
from napari_mufasa.discover.movie_bench import MovieBench
from napari_mufasa.discover.result import Report
from napari_mufasa.errors import MufasaError
from napari_mufasa.model.model import Model

if TYPE_CHECKING:
    from distributed import Client

AGREE = 1.96  # standard deviations of their difference within which two values agree: 95 % of differences by chance
LEAST_PX = 24  # of a half

Progress = Callable[[int, int], None]
Cancel = Callable[[], bool]


@dataclass(frozen=True)
class Confirmation:
    """A finding against data of the same set-up that it has not seen.

    Attributes
    ----------
    here, there : the diagnoses, both from the model believed
    error : there: of the model believed ("before"), of the model completed here ("carried"), of the one completed there
        ("after"), and the floor
    """

    here: Report
    there: Report
    error: dict[str, float]

    @property
    def both(self) -> list[str]:
        """Effects named here and there."""
        return [kind for kind in self.here.chosen if kind in self.there.chosen]

    @property
    def shared(self) -> float:
        """How much of all names given is given twice, 0 … 1; where none is given, 1 if nothing is missing in either, or
        else 0."""
        named = {*self.here.chosen, *self.there.chosen}
        if not named:
            return float(self.here.verdict == self.there.verdict == "adequate")
        return len(self.both) / len(named)

    @property
    def parameters(self) -> list[dict[str, Any]]:
        """The fitted parameters of the effects named twice: effect, parameter, here, here_sd, there, there_sd, and
        whether they agree within the 95 % interval of their difference."""
        one, other = ({c.effect: c for c in report.ranking} for report in (self.here, self.there))
        rows = []
        for kind in self.both:
            for name, sd in one[kind].parameters_sd.items():
                if name not in other[kind].parameters_sd:
                    continue  # of another form
                a, b, sd_b = one[kind].parameters[name], other[kind].parameters[name], other[kind].parameters_sd[name]
                rows.append(
                    {
                        "effect": kind, "parameter": name, "here": a, "here_sd": sd, "there": b, "there_sd": sd_b,
                        "agree": bool(abs(a - b) <= AGREE * np.hypot(sd, sd_b)),
                    }
                )  # fmt: skip
        return rows

    def to_dict(self, against: str = "") -> dict[str, Any]:
        """`check` of report.json (docs/files.md); `against`: what the other data are, in a word."""
        return {
            "against": against,
            "verdict": self.there.verdict,
            "error": self.error,
            "shared": self.shared,
            "both": self.both,
            "only_here": [kind for kind in self.here.chosen if kind not in self.both],
            "only_there": [kind for kind in self.there.chosen if kind not in self.both],
            "parameters": self.parameters,
        }


def confirm(
    here: Report,
    movie: Any,
    model: Model,
    dark: Any = None,
    *,
    seed: int = 1,
    effects: Sequence[str] | None = None,
    budget: int | None = None,
    progress: Progress | None = None,
    cancel: Cancel | None = None,
    client: Client | None = None,
) -> Confirmation:
    """Check a diagnosis on another movie of the same set-up (docs/discovery.md).

    Parameters
    ----------
    here : what `diagnose` found from `model` in the first movie
    movie, model, dark, seed, effects, budget : of the other movie, as for `diagnose`; the model believed is the same
    progress : called with (done, in all); cancel : True stops (raises `Cancelled`)
    client : of a cluster that simulates (docs/clusters.md)

    Raises
    ------
    MufasaError : a movie, dark frames or model that cannot be used.
    """
    checks.need(here, Report, "report", "give what diagnose(…) returned")
    steering: dict[str, Any] = {"progress": progress, "cancel": cancel, "client": client}
    movie = checks.stack(movie)
    there = diagnose(movie, model, dark, seed=seed, effects=effects, budget=budget, **steering)
    completed = here.model.in_shape(n_frames=movie.shape[0], shape_px=tuple(movie.shape[1:]), maps=model.camera)
    if model.effects_refer_to is not None:  # those believed speak of another part of this movie than of the first
        completed = completed.referring_to(model.effects_refer_to)
    carried, floor = _carried(completed, movie, dark, here.chosen, seed, **steering)
    error = {"before": there.error["before"], "carried": carried, "after": there.error["after"], "floor": floor}
    return Confirmation(here, there, error)


def confirm_halves(
    movie: Any,
    model: Model,
    dark: Any = None,
    *,
    seed: int = 1,
    effects: Sequence[str] | None = None,
    budget: int | None = None,
    progress: Progress | None = None,
    cancel: Cancel | None = None,
    client: Client | None = None,
) -> Confirmation:
    """Diagnose the left and the right half of a movie apart, and check the first on the second (docs/discovery.md).

    Parameters and errors as for `diagnose`; `budget` is that of each half. The upper and the lower half where the
    field is higher than wide.

    Raises
    ------
    MufasaError : halves of less than 24 pixels; and as `diagnose`.
    """
    steering: dict[str, Any] = {"progress": progress, "cancel": cancel, "client": client}
    movie = checks.stack(movie)
    n_frames, height, width = (int(n) for n in movie.shape)
    whole = model.in_shape(n_frames=n_frames, shape_px=(height, width))
    if max(height, width) < 2 * LEAST_PX:
        raise MufasaError(f"the movie is {height} × {width} pixels: one of them must be {2 * LEAST_PX} to give halves")
    halves = []
    for part in (slice(0, max(height, width) // 2), slice(max(height, width) // 2, max(height, width))):
        rows, columns = (slice(0, height), part) if width >= height else (part, slice(0, width))
        region = (slice(0, n_frames), rows, columns)
        own_dark = None if dark is None else checks.stack(dark, "dark")[:, rows, columns]
        halves.append((movie[region], whole.in_shape(region=region), own_dark))
    (one, one_model, one_dark), (other, other_model, other_dark) = halves
    here = diagnose(one, one_model, one_dark, seed=seed, effects=effects, budget=budget, **steering)
    return confirm(here, other, other_model, other_dark, seed=seed, effects=effects, budget=budget, **steering)


def _carried(
    completed: Model, movie: Any, dark: Any, kinds: list[str], seed: int, progress: Progress | None,
    cancel: Cancel | None, client: Client | None,
) -> tuple[float, float]:  # fmt: skip
    """The held-out error of a completed model in a movie, and its floor: effects as they are, but for what the movie
    shows of them directly; brightness, background, molecules and the like fitted."""
    bench = MovieBench(prepare(movie, completed, dark), seed, progress, cancel, client)
    start = bench.start.model_copy(update={"effects": tuple(e for e in bench.start.effects if e.kind not in kinds)})
    for effect in bench.start.effects:  # each beside those before it
        if effect.kind in kinds:
            start = start.with_effects(changed(effect, bench.read_off(effect.kind, start)))
    n_free = len(bench.free_values(start))
    bench.plan(bench.matching_simulations + library.expected_simulations([], n_free, start, read=len(kinds)))
    near = library.with_halves(library.build(bench, bench.matched(start), []), kinds)
    return near.base.held_out_error(bench.x), near.base.floor
