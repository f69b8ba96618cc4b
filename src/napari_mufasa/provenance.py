"""Where an output comes from: the program's version, the command, the seed, the model, what was read."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from pathlib import Path
from typing import Any, Protocol

FILE = "provenance.json"
_command: ContextVar[str | None] = ContextVar("command", default=None)


class Describes(Protocol):
    """What describes a movie in plain data: a `Model`."""

    def to_dict(self) -> dict[str, Any]: ...


@contextmanager
def command(arguments: Sequence[str]) -> Iterator[None]:
    """Outputs made inside say that this command made them: its arguments, but for where it writes to, and files by
    their names, so that the same work gives the same bytes in any folder."""
    kept, skip = [], False
    for argument in arguments:
        name, equals, value = argument.partition("=")
        if skip or name in (*WHERE, *HOW):
            skip = not skip and name in WHERE and not equals
            continue
        kept.append(f"{name}={_name(value)}" if equals and argument.startswith("--") else _name(argument))
    with by(shlex.join(kept)):
        yield


@contextmanager
def by(text: str | None) -> Iterator[None]:
    """Outputs made inside say that this command made them, as `made_by` told it elsewhere."""
    token = _command.set(text)
    try:
        yield
    finally:
        _command.reset(token)


WHERE, HOW = ("--out", "--truth", "--scheduler"), ("--overwrite", "--resume", "--debug")


def _name(text: str) -> str:
    return Path(text).name if os.sep in text else text


def made_by() -> dict[str, str | None]:
    """The program's version and the command that runs; None for the command from Python and from the viewer."""
    return {"version": version(), "command": _command.get()}


@cache
def version() -> str:
    from importlib import metadata

    return metadata.version("napari-mufasa")


def provenance(
    model: Describes | None = None, seed: int | None = None, inputs: Sequence[Path | None] = ()
) -> dict[str, Any]:
    """What made an output, as plain data: version, command, seed, inputs (name and size), model."""
    read = [path for path in inputs if path is not None]
    files = [{"name": path.name, "bytes": path.stat().st_size if path.is_file() else None} for path in read]
    described: Mapping[str, Any] | None = None if model is None else model.to_dict()
    return {"program": "napari-mufasa", **made_by(), "seed": seed, "inputs": files, "model": described}
