"""A batch: the steps of each movie in turn, finished ones kept (docs/batches.md)."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from napari_mufasa import checks, files, provenance
from napari_mufasa.batch.movies import Entry
from napari_mufasa.batch.settings import Settings
from napari_mufasa.batch.steps import STEPS, WRITTEN
from napari_mufasa.cluster import in_order, unwanted
from napari_mufasa.errors import MufasaError

if TYPE_CHECKING:
    from distributed import Client

    from napari_mufasa.model.model import Model

DONE = "done.json"


@dataclass(frozen=True)
class Result:
    """What became of a movie: `told` by its steps; `error` where it could not be done; `kept`: steps done before."""

    entry: Entry
    told: dict[str, Any]
    error: str = ""
    kept: tuple[str, ...] = ()
    seconds: float = 0.0


def run(
    entries: Sequence[Entry], out: Path, settings: Settings, *, overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None, cancel: Callable[[], bool] | None = None,
    client: Client | None = None,
) -> Iterator[Result]:  # fmt: skip
    """Do each movie in turn; results go to `out`/NAME/STEP, and what is finished there is not done again.

    A step is finished when its done.json is there, which is written last; it says what the step was done with. A movie
    that cannot be done is told in its result, and the others go on. With the `client` of a cluster its workers do the
    movies; they read and write the same files, at the same paths as this machine (docs/clusters.md).

    Raises
    ------
    MufasaError : before anything is done, for steps that are unknown, models that cannot be read, or results in `out`
        that were made with something else, unless `overwrite`.
    """
    checks.whole(settings.seed, "seed", 0)
    for step in settings.steps:
        checks.choice(step, "step", tuple(STEPS))
    if idle := settings.without_use:
        raise MufasaError(
            f"none of the steps {', '.join(settings.steps)} uses {', '.join(idle)}: drop it, or add a step"
        )
    _check_effects(settings)
    models = {path: _model(path) for path in {entry.model for entry in entries}}
    identities = [{step: _identity(e, models[e.model], settings, step) for step in settings.steps} for e in entries]
    if not overwrite:
        for entry, identity in zip(entries, identities, strict=True):
            for step in settings.steps:
                _check_same(out / entry.name / step, identity[step])
    movies = [
        _Movie(entry, models[entry.model], out / entry.name, settings, identity)
        for entry, identity in zip(entries, identities, strict=True)
    ]
    if client is None:
        results = in_order(lambda movie: movie.done(cancel), movies, workers=0, cancel=cancel)
    else:
        results = in_order(_there, [movie.seen_from_anywhere() for movie in movies], client=client, cancel=cancel)
    for number, result in enumerate(results):
        yield replace(result, entry=entries[number])
        if progress is not None:
            progress(number + 1, len(entries))


@dataclass(frozen=True)
class _Movie:
    """What is done to a movie: the steps of `settings`, their results in `folder`, each finished one with what it was
    done with (`identity`)."""

    entry: Entry
    model: Model
    folder: Path
    settings: Settings
    identity: dict[str, dict[str, Any]]

    def seen_from_anywhere(self) -> _Movie:
        """The same with whole paths."""
        dark = None if self.entry.dark is None else self.entry.dark.absolute()
        entry = replace(self.entry, movie=self.entry.movie.absolute(), dark=dark)
        return replace(self, entry=entry, folder=self.folder.absolute())

    def done(self, cancel: Callable[[], bool] | None) -> Result:
        begun, told, kept = time.monotonic(), dict[str, Any](), list[str]()
        entry, settings, identity = self.entry, self.settings, self.identity
        try:
            read, dark, seen = None, None, dict[str, Any]()
            for step in settings.steps:
                place = self.folder / step
                done = _done(place)
                if done is not None and done["made_from"] == identity[step]:
                    told |= done["told"]
                    kept.append(step)
                    continue
                if read is None:
                    read = files.read_movie(entry.movie).recorded()
                    dark = None if entry.dark is None else files.load(entry.dark, recorded=True)
                    seen = dict(zip(("frames", "height", "width"), read.data.shape, strict=True))
                    seen["doubts"] = _doubts(read, self.model, dark)
                    told |= seen
                if done is not None:  # of another run; while its parts are replaced it is none
                    (place / DONE).unlink()
                with files.filling(place, WRITTEN[step]) as temporary:
                    said = STEPS[step](temporary, read, self.model, dark, settings, cancel=cancel)
                said |= seen
                files.write_json(place / DONE, {"made_from": identity[step], "told": said, **provenance.made_by()})
                told |= files.whole.plain(said)
        except MufasaError as error:
            return Result(entry, told, str(error), tuple(kept), time.monotonic() - begun)
        return Result(entry, told, "", tuple(kept), time.monotonic() - begun)


def _there(movie: _Movie) -> Result:
    """A movie on a worker of a cluster, until nobody waits for it any more."""
    return movie.done(unwanted)


def _doubts(movie: files.Movie, model: Model, dark: Any) -> list[str]:
    """Why the model may not belong to this movie."""
    from napari_mufasa.propose import differences, mismatches

    return [*differences(movie, model), *(mismatch.words for mismatch in mismatches(movie.data, model, dark))]


def _model(path: Path | None) -> Model:
    from napari_mufasa.model.model import Model

    if path is None:
        raise MufasaError("a movie of the batch has no model: name one for all, or in the list")
    return Model.from_json(path)


def _check_effects(settings: Settings) -> None:
    from napari_mufasa.effects import catalogue

    for kind in settings.effects or ():
        checks.choice(kind, "effect", tuple(catalogue()))


def _identity(entry: Entry, model: Model, settings: Settings, step: str) -> dict[str, Any]:
    """What the results of a step depend on, as plain data."""
    made_from = {
        "movie": files.signature(entry.movie), "dark": None if entry.dark is None else files.signature(entry.dark),
        "model": model.to_dict(), "step": step, "version": provenance.version(), **settings.of(step),
    }  # fmt: skip
    identity: dict[str, Any] = json.loads(json.dumps(files.whole.plain(made_from), sort_keys=True))
    return identity


def _done(folder: Path) -> dict[str, Any] | None:
    """What is there of a step that was finished; None where it was not, or where that cannot be read."""
    try:
        found = files.read_json(folder / DONE)
    except MufasaError:
        return None
    return found if isinstance(found, dict) and {"made_from", "told"} <= set(found) else None


def _check_same(folder: Path, identity: dict[str, Any]) -> None:
    done = _done(folder)
    if done is None or done["made_from"] == identity:
        return
    other = [key for key in identity if done["made_from"].get(key) != identity[key]]
    raise MufasaError(
        f"{folder} was made with another {', '.join(other)}: choose another output folder, or add --overwrite"
    )
