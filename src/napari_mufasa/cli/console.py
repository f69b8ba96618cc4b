"""What every verb shares: progress and Ctrl-C, outputs that can be written, effects from text, small tables."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

import typer

from napari_mufasa.errors import MufasaError

if TYPE_CHECKING:
    from napari_mufasa.model.model import Model

MOVIE_SUFFIXES = (".tif", ".tiff", ".zarr")


@dataclass(frozen=True)
class Work:
    """What long work takes: `progress(done, total)` and `cancel()`."""

    progress: Callable[[int, int], None]
    cancel: Callable[[], bool]

    def both(self) -> dict[str, Any]:
        return {"progress": self.progress, "cancel": self.cancel}


@contextlib.contextmanager
def working(title: str) -> Iterator[Work]:
    """A progress bar on a terminal (nothing when piped), and Ctrl-C that stops at the next safe point.

    A second Ctrl-C stops at once. The bar goes to stderr, so that stdout stays clean for results.
    """
    stop = threading.Event()

    def ask_to_stop(_number: int, _frame: FrameType | None) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()
        print("\nstopping … (Ctrl-C again to stop at once)", file=sys.stderr)

    main_thread = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGINT, ask_to_stop) if main_thread else None
    try:
        with _bar(title) as progress:
            yield Work(progress, stop.is_set)
    finally:
        if main_thread:
            signal.signal(signal.SIGINT, before)
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
    with bars:
        task = bars.add_task(title, total=None)
        yield lambda done, total: bars.update(task, completed=done, total=total)


def check_movie_out(path: Path) -> None:
    """Fail before the work, not after it, when the movie could not be written."""
    if not path.name.lower().endswith(MOVIE_SUFFIXES):
        raise MufasaError(f"cannot write a movie to {path}: use .ome.tif, .tif or .zarr")
    check_file_out(path, directory=path.suffix == ".zarr")


def check_file_out(path: Path, directory: bool = False) -> None:
    if not path.parent.is_dir():
        raise MufasaError(f"no folder {path.parent}: make it first or choose another output path")
    _check_writable(path.parent)
    if path.is_dir() and not directory:
        raise MufasaError(f"{path} is a folder: give the path of a file")
    if directory and path.is_dir() and any(path.iterdir()) and not (path / "zarr.json").exists():
        raise MufasaError(f"{path} is a folder that holds other things: choose another output path")


def check_folder_out(path: Path) -> None:
    if path.exists() and not path.is_dir():
        raise MufasaError(f"{path} is a file: give the path of a folder")
    # The folder is made with its parents, and its files come from a temporary folder beside it.
    standing = next(parent for parent in path.absolute().parents if parent.exists())
    if not standing.is_dir():
        raise MufasaError(f"{standing} is a file: {path} cannot be made inside it; choose another output folder")
    _check_writable(path if path.is_dir() else standing)
    if path.is_dir():
        _check_writable(standing)


def _check_writable(folder: Path) -> None:
    import os

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
        data[name.strip()] = plain_value(value)
    return model.with_values({"effects": [data]}).effects[0]


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


@contextlib.contextmanager
def scratch(beside: Path, shape: tuple[int, ...], dtype: Any, *, in_memory: bool) -> Iterator[Any]:
    """An array to work in: in memory, or in a temporary file beside the output for movies larger than that."""
    import numpy as np

    if in_memory:
        yield np.empty(shape, dtype)
        return
    import tempfile

    with tempfile.NamedTemporaryFile(prefix=f".{beside.name}-", dir=beside.parent) as file:
        yield np.memmap(file.name, dtype=dtype, mode="w+", shape=shape)
