"""What every verb shares: progress and Ctrl-C, outputs that can be written, effects from text, small tables."""

from __future__ import annotations

import contextlib
import os
import shlex
import shutil
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, Literal

import typer

from napari_mufasa import checks, cluster, provenance
from napari_mufasa.cli import notes
from napari_mufasa.errors import MufasaError

if TYPE_CHECKING:
    from napari_mufasa.files import Movie
    from napari_mufasa.model.model import Model
    from napari_mufasa.report.figures import Drawing
    from napari_mufasa.traces.extract import TraceSet

STOPPING = (signal.SIGINT, signal.SIGTERM)
MOVIE_SUFFIXES = (".tif", ".tiff", ".zarr")
FIGURES: dict[str, Literal["png", "svg"]] = {".png": "png", ".svg": "svg"}  # by suffix


@dataclass(frozen=True)
class Work:
    """What long work takes: `progress(done, total)`, `cancel()`, and the client of a cluster, if there is one."""

    progress: Callable[[int, int], None]
    cancel: Callable[[], bool]

    client: Any = None

    def both(self) -> dict[str, Any]:
        return {"progress": self.progress, "cancel": self.cancel}

    def all(self) -> dict[str, Any]:
        return {**self.both(), "client": self.client}


@contextlib.contextmanager
def working(title: str, scheduler: str | None = None) -> Iterator[Work]:
    """A progress bar on a terminal (nothing when piped), Ctrl-C that stops at the next safe point, and the client of a
    cluster where a scheduler is named.

    A second Ctrl-C stops at once. The bar goes to stderr, so that stdout stays clean for results.
    """
    stop = threading.Event()

    def ask_to_stop(_number: int, _frame: FrameType | None) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()
        print("\nstopping … (Ctrl-C again to stop at once)", file=sys.stderr)

    main_thread = threading.current_thread() is threading.main_thread()
    # A terminated job (SIGTERM) stops as with Ctrl-C and cleans up after itself.
    before = {each: signal.signal(each, ask_to_stop) for each in STOPPING} if main_thread else {}
    try:
        with cluster.connected(scheduler) as client, _bar(title) as progress:
            before_work = notes.so_far()

            def goes_on(done: int, total: int) -> None:
                if sys.stderr.isatty():  # else notes wait for the end, for a failure is told by its one line
                    notes.tell(before_work)
                progress(done, total)

            yield Work(goes_on, stop.is_set, client)
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)
    if stop.is_set():  # asked after the last safe point: the result is not wanted
        raise KeyboardInterrupt


@contextlib.contextmanager
def _bar(title: str) -> Iterator[Callable[[int, int], None]]:
    from rich.console import Console
    from rich.progress import Progress

    bars = Progress(
        *Progress.get_default_columns(),
        console=Console(stderr=True),
        transient=True,
        disable=not sys.stderr.isatty(),
        # What a verb prints goes above the bar on a terminal, and where it was sent to when piped.
        redirect_stdout=sys.stdout.isatty(),
    )
    from napari_mufasa.compiled import told_of_compiling

    with bars:
        task = bars.add_task(title, total=None)
        with told_of_compiling(lambda: bars.update(task, description=f"{title}: compiling, once for this machine")):
            yield lambda done, total: bars.update(task, description=title, completed=done, total=total)


def check_movie_out(path: Path, overwrite: bool) -> None:
    """Fail before the work, not after it, when the movie could not be written."""
    if not path.name.lower().endswith(MOVIE_SUFFIXES):
        raise MufasaError(f"cannot write a movie to {path}: use .ome.tif, .tif or .zarr")
    check_file_out(path, overwrite, directory=path.suffix == ".zarr")


def check_file_out(path: Path, overwrite: bool, directory: bool = False) -> None:
    if not path.parent.is_dir():
        raise MufasaError(f"no folder {path.parent}: make it first or choose another output path")
    _check_writable(path.parent)
    if path.is_dir() and not directory:
        raise MufasaError(f"{path} is a folder: give the path of a file")
    if directory and path.is_dir() and any(path.iterdir()) and not (path / "zarr.json").exists():
        raise MufasaError(f"{path} is a folder that holds other things: choose another output path")
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise MufasaError(f"{path} is neither file nor folder: give the path of a file")
    if os.path.lexists(path) and not overwrite:
        raise MufasaError(f"{path} is there already: choose another output path, or add --overwrite to replace it")


def check_figure_out(path: Path | None) -> None:
    """Fail before the work, not after it, when the name is of no kind of figure that is drawn."""
    if path is not None and path.suffix.lower() not in FIGURES:
        raise MufasaError(f"--figure {path}: cannot draw into such a file, use {' or '.join(FIGURES)}")


def figure_bytes(drawing: Drawing, path: Path) -> bytes:
    """The figure as a file of the kind that its name says."""
    return drawing.render("light", FIGURES[path.suffix.lower()])


def check_not_read(out: Path, *inputs: Path | None) -> None:
    """An output must not take the place of what it is made from, not even with --overwrite."""
    for path in inputs:
        if path is not None and out.exists() and path.exists() and out.samefile(path):
            raise MufasaError(f"{out} is also read: choose another output path")


def check_apart(*outputs: Path | None) -> None:
    """Two outputs must not be one file: the second would take the place of the first."""
    given = [path.absolute() for path in outputs if path is not None]
    for path in given:
        if given.count(path) > 1:
            raise MufasaError(f"{path.name} is given for the same output twice: give each output a file of its own")


def check_room(path: Path, n_bytes: int) -> None:
    """Fail before the work when the disk has no room for a movie; zarr packs counts to about half."""
    free = shutil.disk_usage(path.parent).free
    if n_bytes > (4 * free if path.suffix == ".zarr" else free):
        size = checks.size(n_bytes)
        raise MufasaError(
            f"{path} would have {size}, the disk has {checks.size(free)} free: take less, or another disk"
        )


def check_folder_out(path: Path, overwrite: bool, names: Sequence[str], *inputs: Path | None) -> None:
    """`names`: what the verb writes, as patterns of file names; `inputs`: what it reads."""
    from napari_mufasa.files.outputs import is_one_of

    for each in inputs:
        if each is not None and path.is_dir() and is_one_of(each.name, names):
            check_not_read(path / each.name, each)
    if path.is_dir() and not overwrite:
        there = sorted(file.name for file in path.iterdir() if is_one_of(file.name, names))
        if there:
            more = f" and {len(there) - 1} more" if len(there) > 1 else ""
            raise MufasaError(
                f"{path / there[0]}{more} would be replaced: choose another output folder, or add --overwrite"
            )
    if path.exists() and not path.is_dir():
        raise MufasaError(f"{path} is a file: give the path of a folder")
    # A folder that is not there is made with its parents; one that is there is all that is written into.
    standing = next(place for place in (path.absolute(), *path.absolute().parents) if place.exists())
    if not standing.is_dir():
        raise MufasaError(f"{standing} is a file: {path} cannot be made inside it; choose another output folder")
    _check_writable(standing)


def _check_writable(folder: Path) -> None:
    if not os.access(folder, os.W_OK | os.X_OK):
        raise MufasaError(f"cannot write into {folder}: allow it or choose another output path")


def effect_from_text(model: Model, text: str) -> Any:
    """An effect given as KIND[:NAME=VALUE,…], checked against the model it is for."""
    kind, _, rest = text.partition(":")
    data: dict[str, Any] = {"kind": kind.strip()}
    for item in filter(None, (part.strip() for part in rest.split(","))):
        name, equals, value = item.partition("=")
        if not equals:
            raise MufasaError(f"effect {text!r}: {item!r} is not NAME=VALUE; write KIND:NAME=VALUE,NAME=VALUE")
        if name.strip() in data:
            raise MufasaError(f"effect {text!r} has {name.strip()} twice: give it once")
        data[name.strip()] = plain_value(value)
    effect = model.with_values({"effects": [data]}).effects[0]
    for name in data.keys() & type(effect).model_fields.keys():
        if name != "kind" and not effect.matters(name):
            forms = " or ".join(f"form={form}" for form in sorted(effect.only_for(name)))
            raise MufasaError(f"effect {text!r}: {name} matters to {forms} only: add that, or leave {name} out")
    return effect


def effects_from_texts(model: Model, texts: Sequence[str]) -> list[Any]:
    """Effects given as KIND[:NAME=VALUE,…], one of each kind."""
    effects = [effect_from_text(model, text) for text in texts]
    kinds = [effect.kind for effect in effects]
    for kind in kinds:
        if kinds.count(kind) > 1:
            raise MufasaError(f"{kind} is given more than once: a model has one of each kind, give one")
    return effects


def plain_value(text: str) -> Any:
    """A number, null, true, … as in JSON, and any other word as it is."""
    import json

    try:
        return json.loads(text)
    except ValueError:
        return text.strip()


def print_table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Aligned columns; numbers with four significant digits. On a terminal lines are folded to its width.

    Anywhere else nothing is cut, folded or coloured: other programs read it.
    """
    from rich.console import Console
    from rich.table import Column, Table
    from rich.text import Text

    screen = Console(width=None if sys.stdout.isatty() else 2**16)
    # As `Text`, so that brackets in a cell are no markup.
    columns = (Column(Text(name), overflow="fold") for name in head)
    table = Table(*columns, box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for row in rows:
        table.add_row(*(Text(_cell(value)) for value in row))
    # Captured, because rich would end the process with an error where the reader (head, less) has left.
    with screen.capture() as drawn:
        screen.print(table)
    for line in drawn.get().splitlines():
        typer.echo(line.rstrip())


def _cell(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else "–" if value is None else str(value)


def tell_disagreement(movie: Movie, model: Model, dark: Any = None) -> None:
    """Notes on what movie and model contradict each other in; shape and length are the movie's."""
    from napari_mufasa.propose import differences

    for words in differences(movie, model):
        note(words)
    if movie.unit == "adu":
        _tell_mismatches(movie, model, dark)


def _tell_mismatches(movie: Movie, model: Model, dark: Any) -> None:
    from napari_mufasa.propose import mismatches

    found = mismatches(movie.data, model, dark)
    for mismatch in found:
        note(f"the model may not belong to this movie: {mismatch.words}")
    if found:
        command = shlex.join(["napari-mufasa", "propose", str(movie.path), "--out", "proposed.json"])
        note(f"a model of the movie itself is made by: {command}")


def dark_frames(path: Path | None, movie: Movie | None = None) -> Any:
    """Frames without light, (frame, y, x), lazy; None without a file. `movie`: what they are the dark frames of."""
    from napari_mufasa import files

    if path is not None and movie is not None and movie.unit != "adu":
        raise MufasaError(f"--dark belongs to camera counts; {movie.path} holds {movie.unit}: drop it")
    return None if path is None else files.read_movie(path).recorded().data


def tell_molecules(out: Path, found: TraceSet) -> None:
    """How many molecules are kept, why others are not, and notes."""
    from napari_mufasa.report.lines import moving_line

    typer.echo(f"{out}: {found.kept.sum()} molecules kept of {len(found.molecules)} candidates")
    reasons = found.molecules["reason"][~found.kept]
    general = reasons.str.replace(r"[\d.]+", "…", regex=True)
    for words, count in general.value_counts().head(6).items():
        each = reasons[general == words].unique()
        typer.echo(f"  {count} × {each[0] if len(each) == 1 else words}")
    if found.path_px is not None:
        typer.echo(moving_line(found))
    for note in found.notes:
        typer.echo(f"note: {note}" + (" (--follow-drift)" if note.endswith("follow the drift") else ""))


def note(text: str) -> None:
    """A line for the user that is no result: told on stderr once the work goes well."""
    warnings.warn(text, stacklevel=2)


@contextlib.contextmanager
def filling(
    out: Path, names: Sequence[str], model: Model, seed: int | None = None, inputs: Sequence[Path | None] = ()
) -> Iterator[Path]:
    """The folder of a verb's output, whole or not there, with where it comes from; `names` as in `check_folder_out`."""
    from napari_mufasa import files

    made = provenance.provenance(model, seed, inputs)
    with files.filling(out, names) as folder:
        yield folder
        files.write_json(folder / f"{(made['command'] or 'python').split()[0]}.{provenance.FILE}", made)


def tell_origin(out: Path, model: Model | None = None, inputs: Sequence[Path | None] = ()) -> None:
    """NAME.provenance.json beside a file that cannot hold where it comes from."""
    from napari_mufasa import files

    files.write_json(out.with_name(f"{out.name}.{provenance.FILE}"), provenance.provenance(model, None, inputs))
