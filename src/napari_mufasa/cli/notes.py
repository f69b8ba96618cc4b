"""What a verb notes beside its results: told on stderr, each once and in one line."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextvars import ContextVar

_notes: ContextVar[dict[str, bool]] = ContextVar("notes")  # of the verb that runs, and whether each is told


def begin() -> None:
    """A verb begins: nothing is noted."""
    _notes.set({})


def so_far() -> list[str]:
    """What is noted so far."""
    return list(_notes.get({}))


def tell(chosen: Sequence[str]) -> None:
    """Print those that are not told yet: on a terminal of what was noted before the work once that goes on, of all
    at the end."""
    told = _notes.get({})
    for note in [note for note in chosen if not told[note]]:
        told[note] = True
        print(f"napari-mufasa: note: {note}", file=sys.stderr)


def collect(message: Warning | str, category: type[Warning]) -> None:
    """Our own warnings, each once and in one line; what libraries tell their developers is not for users."""
    if category is UserWarning:
        _notes.get().setdefault(one_line(str(message)), False)


def one_line(message: str) -> str:
    """One line without control characters: names of files are others' words."""
    return "".join(letter if letter.isprintable() else "?" for letter in " ".join(message.split()))
