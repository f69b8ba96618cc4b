"""How loops are compiled: with numba, once for a machine, free of the interpreter's lock.

Import this module only where loops run: it needs numba. What is compiled here is kept in files and found again by the
next process. Three kinds, of which only the last two may reorder sums to work on several numbers at once:

* `jit`: arithmetic as it is written.
* `vectorised`: a loop that Python calls.
* `inlined`: what such loops call. It is always built into its caller: numba would else keep a copy for each caller,
  every copy optimised anew and rounding in its own way, and would run the one that this process happened to load first,
  so that the last bits hung on whether a loop was just compiled or found in a file. `tests/house` looks after it.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

from numba import njit
from numba.core import event

jit: Any = njit(cache=True, nogil=True, error_model="numpy")
vectorised: Any = njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
inlined: Any = njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)


@contextlib.contextmanager
def told_of_compiling(tell: Callable[[], object]) -> Iterator[None]:
    """`tell` is called when a loop is about to be compiled meanwhile, in the thread that compiles it: that takes
    seconds, all of them up to a minute, and users shall know what they wait for."""
    with event.install_listener("numba:compile", _Hears(tell)):
        yield


class _Hears(event.Listener):
    def __init__(self, tell: Callable[[], object]) -> None:
        self.tell = tell

    def on_start(self, _: Any) -> None:
        self.tell()

    def on_end(self, _: Any) -> None:
        pass
