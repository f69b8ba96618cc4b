"""Sums that round alike on every number of threads: linear algebra on one.

The libraries below NumPy and SciPy share large products and decompositions out among threads, and how they are cut
decides in which order sums are rounded. The matrices here have a few hundred rows: one thread is as fast.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

# The number is one of the whole process, and only one thread may set it at a time.
_TURN = threading.RLock()


def one_thread(function: Callable[P, R]) -> Callable[P, R]:
    """The function, with its linear algebra on one thread; where several threads call such functions, in turns: it must
    not wait for another thread."""

    @wraps(function)
    def alone(*args: P.args, **kwargs: P.kwargs) -> R:
        with _TURN, _libraries().limit(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return alone


@cache
def _libraries() -> Any:
    import scipy.linalg  # noqa: F401  (brings a library of its own, which must be there to be found)
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
