"""Let the interface have Python whenever it wants it, while our threads work."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

SWITCH_S = 0.0005
NICE = 5
_lock = threading.Lock()
_inside = 0
_before = 0.005


def step_back() -> None:
    """Let this thread, and those it starts, have what the interface's leaves of the processors.

    For good: only for threads that end with their work. Linux alone knows the priority of a thread.
    """
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICE)


@contextmanager
def courteous() -> Iterator[None]:
    """Run a thread's work so that the interface waits at most half a millisecond each time it needs the interpreter.

    With Python's own 5 ms, an interface that asks for it fifty times while it handles one event (Qt gives it up at
    every call) stands still for a quarter of a second beside a thread that computes.
    """
    global _inside, _before
    with _lock:
        if _inside == 0:
            _before = sys.getswitchinterval()
            sys.setswitchinterval(min(SWITCH_S, _before))
        _inside += 1
    try:
        yield
    finally:
        with _lock:
            _inside -= 1
            if _inside == 0:
                sys.setswitchinterval(_before)
