"""What every public door asks of what it is handed: each check says in one line what is wrong and what to give.

They know no physics and read nothing that they need not: shapes and types are looked at, never the pixels.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any

from napari_mufasa.errors import MufasaError

if TYPE_CHECKING:
    from numpy.typing import NDArray

COLOURS = (3, 4)  # RGB and RGBA, as the last axis
LEAST_WIDTH = 16  # so high is no movie that is as narrow as a colour is


def need(value: object, kind: type, name: str, remedy: str) -> None:
    """Raise unless `value` is a `kind`: what was handed over instead, and what to give."""
    if not isinstance(value, kind):
        raise MufasaError(f"{name} is a {type(value).__name__}, not a {kind.__name__}: {remedy}")


def whole(value: Any, name: str, least: int = 0, most: int | None = None) -> int:
    """A whole number, least … most."""
    fits = isinstance(value, Integral) and not isinstance(value, bool)
    if not fits or int(value) < least or (most is not None and int(value) > most):
        limits = f"≥ {least}" if most is None else f"from {least} to {most}"
        raise MufasaError(f"{name} = {told(value)}: give a whole number {limits}")
    return int(value)


def number(value: Any, name: str, least: float = -math.inf, most: float = math.inf) -> float:
    """A finite number, least … most."""
    fits = isinstance(value, Real) and not isinstance(value, bool)
    try:
        if fits and math.isfinite(value) and least <= float(value) <= most:
            return float(value)
    except OverflowError:  # a whole number too large for a float
        pass
    inside = "" if least == -math.inf and most == math.inf else f" from {least:g} to {most:g}"
    raise MufasaError(f"{name} = {told(value)}: give a finite number{inside}")


def seed(value: Any) -> int:
    """A seed: any whole number from 0."""
    return whole(value, "seed")


def choice(value: Any, name: str, options: Iterable[str]) -> str:
    """One of the words `options`."""
    known = list(options)
    if not isinstance(value, str) or value not in known:
        raise MufasaError(f"{name} {told(value)} is unknown: choose one of {', '.join(known)}")
    return value


def words(value: Any, name: str) -> list[str]:
    """A list of words; one word is a list of one."""
    if isinstance(value, str):
        return [value]
    found = list(value) if isinstance(value, Iterable) else []
    if not isinstance(value, Iterable) or not all(isinstance(each, str) for each in found):
        raise MufasaError(f"{name} = {told(value)}: give a list of words")
    return found


def several(value: Any, name: str) -> list[Any]:
    """A list of values."""
    if isinstance(value, str) or not isinstance(value, Iterable):
        raise MufasaError(f"{name} = {told(value)}: give a list of values")
    return list(value)


def stack(value: Any, name: str = "movie", *, single: bool = False) -> Any:
    """An array (frame, y, x) of real numbers, not empty; NumPy, dask, zarr, or what slices like them.

    Lists become arrays; a layer gives its data; with `single` one image (y, x) becomes one frame. Objects are refused:
    nothing is ever unpickled.
    """
    import numpy as np

    if not hasattr(value, "shape"):
        value = getattr(value, "data", value)
    if not hasattr(value, "shape"):
        if not isinstance(value, (list, tuple)):
            what = "a path: open it with napari_mufasa.files.load" if isinstance(value, (str, os.PathLike)) else ""
            raise MufasaError(f"{name} is {what or f'{told(value)}: give an array (frame, y, x)'}")
        try:
            value = np.asarray(value)
        except (TypeError, ValueError):
            raise MufasaError(f"{name} is a list of unequal parts: give an array (frame, y, x)") from None
    shape = tuple(int(n) for n in value.shape)
    kind = np.dtype(getattr(value, "dtype", None) or np.asarray(value[:1]).dtype).kind
    if kind not in "uif":
        raise MufasaError(f"{name} holds {_content(kind, value.dtype)}: needs real numbers (frame, y, x)")
    if np.ma.isMaskedArray(value) and np.ma.is_masked(value):
        raise MufasaError(f"{name} is a masked array, and the mask would be lost: crop or fill those pixels first")
    colours = shape[-1:] in {(n,) for n in COLOURS}
    if colours and (len(shape) == 4 or (len(shape) == 3 and shape[1] >= LEAST_WIDTH)):
        raise MufasaError(f"{name} of shape {shape} looks like a colour image: needs one grey stack (frame, y, x)")
    if len(shape) > 3:
        raise MufasaError(
            f"{name} has {len(shape)} axes {shape}: needs one stack (frame, y, x); choose one channel and one plane, "
            f"as {name}[:, 0]"
        )
    if 0 in shape:
        raise MufasaError(f"{name} of shape {shape} is empty: give a non-empty stack (frame, y, x)")
    if len(shape) == 2 and single:
        return value[None]
    if len(shape) != 3:
        raise MufasaError(f"{name} has shape {shape}: needs a non-empty stack (frame, y, x)")
    return value


def dark_stack(value: Any, shape_px: tuple[int, ...]) -> Any:
    """Dark frames (frame, y, x) of a movie whose frames are `shape_px` (y, x); one image (y, x) becomes one frame."""
    dark = stack(value, "dark", single=True)
    if tuple(dark.shape[1:]) != tuple(shape_px):
        raise MufasaError(
            f"dark has shape {tuple(dark.shape)}, the movie's frames are {tuple(shape_px)}: "
            "give dark frames of the same region (frame, y, x)"
        )
    return dark


def unread(stack: Any) -> Any:
    """The stack, parts of which can be taken without reading them (a slice of zarr, or of its like, would be read), and
    are read in its own chunks."""
    import numpy as np

    if isinstance(stack, np.ndarray) or hasattr(stack, "dask"):
        return stack
    from dask.array import from_array

    return from_array(stack, chunks=getattr(stack, "chunks", None) or "auto")  # type: ignore[no-untyped-call]


def table(value: Any, name: str) -> NDArray[Any]:
    """An array (molecule, frame) of finite real numbers, not empty; one trace (frame,) becomes a table of one."""
    import numpy as np

    try:
        array = np.asarray(value)
    except (TypeError, ValueError):
        raise MufasaError(f"{name} are a list of unequal parts: give an array (molecule, frame)") from None
    if array.dtype.kind not in "buif":
        raise MufasaError(
            f"{name} hold {_content(array.dtype.kind, array.dtype)}: needs real numbers (molecule, frame)"
        )
    array = np.atleast_2d(array) if array.ndim == 1 else array
    if array.ndim != 2 or array.size == 0:
        raise MufasaError(f"{name} have shape {array.shape}: needs a non-empty (molecule, frame) array")
    if not np.isfinite(array).all():
        raise MufasaError(f"{name} have values that are not finite: drop or fill those frames first")
    return array


def affordable(n_bytes: int, what: str, remedy: str) -> None:
    """Raise where `what` would need more memory than the machine has, before any of it is asked for."""
    most = memory_bytes()
    if n_bytes > most:
        raise MufasaError(f"{what} would take {size(n_bytes)} of memory, this machine has {size(most)}: {remedy}")


def memory_bytes() -> int:
    """Memory of this machine; where it does not tell, 64 GB."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return 2**36


def size(n_bytes: float) -> str:
    """Bytes in words: 3.2 GB."""
    for unit in ("bytes", "kB", "MB", "GB", "TB", "PB"):
        if n_bytes < 1000 or unit == "PB":
            return f"{n_bytes:.3g} {unit}"
        n_bytes /= 1000
    raise AssertionError("not reached")


def told(value: Any) -> str:
    """What was handed over, short enough for one line."""
    if isinstance(value, int) and value.bit_length() > 100:
        return f"a whole number of {value.bit_length()} bits"
    if value is None or isinstance(value, (str, bool, int, float, complex)) or type(value).__module__ == "numpy":
        text = " ".join(repr(value).split())
        return text if len(text) <= 60 else text[:57] + "…"
    return f"a {type(value).__name__}"


def counted(n: int, what: str) -> str:
    """So many of something: "1 frame", "2 frames"."""
    return f"{n} {what}" if n == 1 else f"{n} {what}s"


def _content(kind: str, dtype: Any) -> str:
    return {"O": "Python objects", "b": "yes and no (bool)", "c": f"complex numbers ({dtype})"}.get(kind, str(dtype))
