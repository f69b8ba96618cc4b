"""A cluster that can be worked with: its scheduler answers, and its workers would give the same digits."""

from __future__ import annotations

import contextlib
import logging
import platform
import re
import warnings
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any
from weakref import WeakSet

from napari_mufasa.errors import MufasaError
from napari_mufasa.provenance import version

if TYPE_CHECKING:
    from distributed import Client

PATIENCE_S = 10.0  # a scheduler has to answer, and a first worker to be there
NUMERICAL = ("numpy", "numba", "scipy")  # packages whose versions may move last digits
OURS = "napari_mufasa"

_checked: WeakSet[Any] = WeakSet()


@contextlib.contextmanager
def connected(address: str | None) -> Iterator[Client | None]:
    """A client of the scheduler at `address`, as tcp://host:8786, checked and closed at the end; None without one.

    Raises `MufasaError` where none answers, or where its workers cannot be used.
    """
    if address is None:
        yield None
        return
    with _quiet(), contextlib.ExitStack() as opened:
        yield _opened(address, opened)


def _opened(address: str, opened: contextlib.ExitStack) -> Client:
    distributed = _distributed()
    try:
        if not _has_port(address):  # a client of such an address ends with a traceback of its own
            raise ValueError(address)
        client: Client = opened.enter_context(distributed.Client(address, timeout=PATIENCE_S, set_as_default=False))
    except (OSError, ValueError, AssertionError, TimeoutError):
        raise MufasaError(
            f"no scheduler answers at {address}: start one with 'dask scheduler', and give the address that it prints, "
            "as tcp://host:8786"
        ) from None
    check(client)
    return client


def _has_port(address: str) -> bool:
    """Whether an address that needs a port has one, as host:8786 or tcp://host:8786."""
    scheme, _, where = address.rpartition("://")
    return scheme not in ("", "tcp", "tls") or re.fullmatch(r".+:\d+/?", where) is not None


def check(client: Any) -> None:
    """Raise `MufasaError` for a client that is none, is closed, or whose workers cannot be used; warn where their last
    digits may differ from those of this machine. A client is looked at once."""
    distributed = _distributed()
    if not isinstance(client, distributed.Client):
        raise MufasaError(
            f"client is a {type(client).__name__}: give distributed.Client(ADDRESS, set_as_default=False)"
        )
    if client.asynchronous:
        raise MufasaError("client is asynchronous: give distributed.Client(ADDRESS) of a program that is not")
    if client.status != "running":
        raise MufasaError("client is closed: open a new one with distributed.Client(ADDRESS)")
    if _default() is client:
        raise MufasaError(
            "client is the default one, by which dask would also read movies: open it with "
            "distributed.Client(ADDRESS, set_as_default=False)"
        )
    if client in _checked:
        return
    at = client.scheduler.address
    try:
        client.wait_for_workers(1, timeout=PATIENCE_S)
    except TimeoutError:
        raise MufasaError(f"the scheduler at {at} has no workers: start some with 'dask worker {at}'") from None
    found = client.get_versions(packages=[OURS, *NUMERICAL])["workers"]
    for worker, told in found.items():
        theirs = told["packages"].get(OURS)
        if theirs != version():
            has = f"napari-mufasa {theirs}" if theirs else "no napari-mufasa"
            raise MufasaError(f"the worker {worker} has {has}, not {version()}: install the same version there")
    here = machine()
    for worker, there in client.run(machine).items():
        if lacking := sorted(set(here["effects"]) - set(there["effects"])):
            raise MufasaError(f"the worker {worker} does not know the effect {lacking[0]}: install its package there")
        if other := [f"{name} {there[name]} for {here[name]}" for name in here if there[name] != here[name]
                     and name != "effects"]:  # fmt: skip
            warnings.warn(
                f"the worker {worker} has {', '.join(other)}: last digits may differ from those of this machine",
                stacklevel=2,
            )
    _checked.add(client)


def _default() -> Any:
    """The client by which dask computes, if there is one."""
    try:
        return _distributed().Client.current()
    except ValueError:
        return None


def machine() -> dict[str, Any]:
    """What the digits of a process hang on."""
    from importlib import metadata

    from napari_mufasa.model.registry import catalogue

    versions = {name: metadata.version(name) for name in NUMERICAL}
    return {"effects": list(catalogue()), "processor": _processor(), **versions}


@cache
def _processor() -> str:
    """Its name: loops are compiled for the processor they run on."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _distributed() -> Any:
    try:
        import distributed
    except ImportError:
        raise MufasaError(
            "a cluster needs the package distributed: pip install 'napari-mufasa[cluster]', here and on the workers"
        ) from None
    return distributed


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """What the library logs of connections that come and go is for its developers; what is wrong is told by us."""
    logger = logging.getLogger("distributed")
    before = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        logger.setLevel(before)
