"""How a step's function tells its progress and learns that it is to stop, without either being a parameter.

A function called by a script has nobody to tell: ``steering()`` then gives callbacks that do nothing.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

Progress = Callable[[int, int], None]
Cancel = Callable[[], bool]

_RUN: ContextVar[tuple[Progress, Cancel]] = ContextVar("run", default=(lambda done, total: None, lambda: False))


@contextmanager
def steered(progress: Progress, cancel: Cancel) -> Iterator[None]:
    """What runs in here reports to `progress` and asks `cancel`."""
    token = _RUN.set((progress, cancel))
    try:
        yield
    finally:
        _RUN.reset(token)


def steering() -> tuple[Progress, Cancel]:
    """The callbacks of the run under way; they may be called from any thread."""
    return _RUN.get()


class Helm:
    """Progress and cancel for an object that outlives single runs: those of the run that holds it.

    ``with helm:`` lets one run at it at a time: one that was cancelled may still be leaving.
    """

    def __init__(self) -> None:
        self._run = steering()
        self.lock = threading.Lock()

    def __enter__(self) -> None:
        self.lock.acquire()
        self._run = steering()

    def __exit__(self, *_: object) -> None:
        self.lock.release()

    def progress(self, done: int, total: int) -> None:
        self._run[0](done, total)

    def cancel(self) -> bool:
        return self._run[1]()
