"""Jobs done elsewhere, their results in order: on threads of this process, or on the workers of a cluster.

A job on a cluster carries all that it needs, so that any worker can do it again when the one that had it is gone; its
chance comes from seeds, so that it gives the same again.
"""

from __future__ import annotations

import pickle
import threading
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import TYPE_CHECKING, Any, TypeVar

from napari_mufasa import provenance
from napari_mufasa.cluster.connection import check
from napari_mufasa.errors import Cancelled, MufasaError

if TYPE_CHECKING:
    from distributed import Client

Job = TypeVar("Job")
Done = TypeVar("Done")
Cancel = Callable[[], bool]
AHEAD = 3  # jobs handed out for each thread of a cluster: one it does, and some that wait beside it
LOOK_S = 0.2  # so often `cancel` is asked while a job is waited for


def in_order(
    work: Callable[[Job], Done],
    jobs: Iterable[Job],
    *,
    client: Client | None = None,
    workers: int = 1,
    ahead: int | None = None,
    cancel: Cancel | None = None,
) -> Iterator[Done]:
    """``work(job)`` of each job, in the order of the jobs, which are taken as they are handed out.

    Parameters
    ----------
    work : what is done; for a cluster it must be possible to pickle it, and the same object serves all its jobs in a
        process, so that it may keep what several of them need
    client : of a cluster; None: `workers` threads of this process; 0: the one that asks, job by job
    ahead : jobs handed out before the first of them is waited for; None: on threads all, on a cluster a few a thread
    cancel : asked again and again; True stops with `Cancelled`

    Raises
    ------
    MufasaError : a client that cannot be used, a cluster that is gone, a job that ended several workers.
    """
    if client is None and workers == 0:
        for job in jobs:
            _stop_if(cancel)
            yield work(job)
    elif client is None:
        yield from _on_threads(work, jobs, workers, ahead, cancel)
    else:
        check(client)
        yield from _on_cluster(work, jobs, client, ahead, cancel)


def unwanted() -> bool:
    """Whether the job that asks runs on a cluster, and nobody waits for it any more: it may stop."""
    try:
        from distributed import get_worker

        worker = get_worker()
        state = worker.state.tasks.get(worker.get_current_task())
    except (ImportError, ValueError, AttributeError):  # not on a cluster
        return False
    return state is None or state.state == "cancelled"


def _on_threads(
    work: Callable[[Job], Done], jobs: Iterable[Job], workers: int, ahead: int | None, cancel: Cancel | None
) -> Iterator[Done]:
    with ThreadPoolExecutor(workers) as pool:
        yield from _each(jobs, lambda job: pool.submit(work, job), lambda future: future.result(), ahead, cancel)


def _on_cluster(
    work: Callable[[Job], Done], jobs: Iterable[Job], client: Any, ahead: int | None, cancel: Cancel | None
) -> Iterator[Done]:
    packed, command = _packed(work), provenance.made_by()["command"]

    def hand_out(job: Job) -> Any:
        with warnings.catch_warnings():  # a block of a movie is larger than what the library thinks a job should be
            warnings.simplefilter("ignore")
            return client.submit(_done, packed, _packed(job), command, pure=False, key=None)

    threads = sum(client.nthreads().values())
    yield from _each(jobs, hand_out, lambda future: _result(future, client, cancel), ahead or AHEAD * threads, cancel)


def _each(
    jobs: Iterable[Job],
    hand_out: Callable[[Job], Any],
    result: Callable[[Any], Done],
    ahead: int | None,
    cancel: Cancel | None,
) -> Iterator[Done]:
    pending: deque[Any] = deque()
    upcoming = iter(jobs)
    try:
        for job in upcoming:
            pending.append(hand_out(job))
            if ahead is not None and len(pending) >= ahead:
                break
        while pending:
            _stop_if(cancel)
            found = result(pending[0])
            pending.popleft()
            for job in upcoming:
                pending.append(hand_out(job))
                break
            yield found
    finally:
        for future in pending:
            future.cancel()


def _result(future: Any, client: Any, cancel: Cancel | None) -> Any:
    """What a job gave, `cancel` being asked while it is waited for."""
    from concurrent.futures import CancelledError

    from distributed import KilledWorker

    is_done = threading.Event()
    future.add_done_callback(lambda _: is_done.set())
    # `future.result` with a time limit would give up what is on its way: a large block would never come.
    while not future.done():
        is_done.wait(LOOK_S)
        _stop_if(cancel)
        if client.status not in ("running", "connecting"):
            raise _gone()
    try:
        return future.result()
    except KilledWorker as error:
        raise MufasaError(
            f"a job ended {error.allowed_failures + 1} workers of the cluster one after the other: look into their "
            "logs, and give them more memory"
        ) from None
    except (CancelledError, OSError):
        if future.status == "error":  # the job's own
            raise
        raise _gone() from None


def _gone() -> MufasaError:
    return MufasaError("the scheduler of the cluster is gone, and what it held with it: start it again, and this work")


def _stop_if(cancel: Cancel | None) -> None:
    if cancel is not None and cancel():
        raise Cancelled


def _packed(what: Any) -> bytes:
    try:
        return pickle.dumps(what, protocol=pickle.HIGHEST_PROTOCOL)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise MufasaError(
            f"what should be done on the cluster cannot be sent there ({error}): an effect must be a class "
            "of a package that the workers have, too"
        ) from None


@lru_cache(maxsize=4)
def _unpacked(packed: bytes) -> Any:
    """What all jobs of a kind share, made once in a process."""
    return pickle.loads(packed)


def _done(packed: bytes, job: bytes, command: str | None) -> Any:
    """A job, on a worker."""
    with provenance.by(command), _READING:
        return _unpacked(packed)(pickle.loads(job))


class _ReadHere:
    """While any job runs in a process, lazy arrays are read by it: dask would else hand that to the cluster, too."""

    def __init__(self) -> None:
        self._lock, self._running = threading.Lock(), 0
        self._setting: Any = None

    def __enter__(self) -> None:
        import dask

        with self._lock:
            self._running += 1
            if self._running == 1:
                self._setting = dask.config.set(scheduler="threads")

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._running -= 1
            if self._running == 0:
                self._setting.__exit__(None, None, None)


_READING = _ReadHere()
