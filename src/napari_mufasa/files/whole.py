"""Files that are whole or not there: everything is written to a temporary name and renamed."""

from __future__ import annotations

import contextlib
import glob
import json
import os
import platform
import shutil
import uuid
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_mufasa import checks
from napari_mufasa.errors import MufasaError
from napari_mufasa.files.outputs import is_one_of

if TYPE_CHECKING:
    import pandas as pd

PathLike = str | os.PathLike[str]
MOST_JSON_BYTES = 2**30  # camera maps of 2048 × 2048 pixels, written as numbers, are 240 MB


@contextlib.contextmanager
def replacing(path: PathLike) -> Iterator[Path]:
    """A temporary path beside `path`, renamed to it at the end; removed when anything fails.

    What a killed process left of the same file is removed, too. A file that is there already is replaced: whoever must
    not do that looks first.
    """
    target = Path(path)
    if not target.parent.is_dir():
        raise MufasaError(f"no folder {target.parent}: make it first or choose another output path")
    if target.is_dir() and not is_zarr_folder(target):
        raise MufasaError(f"{target} is a folder: choose a file name for the output")
    temporary = _temporary(target)
    try:
        yield temporary
        if temporary.is_file():
            _to_the_disk(temporary)
        if target.is_dir():  # cannot be replaced in one step: set aside first, so that one of the two is always whole
            old = _temporary(target)
            os.replace(target, old)
            os.replace(temporary, target)
            shutil.rmtree(old)
        else:
            os.replace(temporary, target)
    finally:
        remove(temporary)


@contextlib.contextmanager
def filling(folder: PathLike, names: Sequence[str] = ()) -> Iterator[Path]:
    """A temporary folder; its files move into `folder` together at the end, or disappear.

    names : patterns of what the work writes: of these, what an earlier run left and this one does not write is removed,
        so that a folder is of one run
    """
    target = Path(folder).resolve()  # "." has no name to put a temporary one beside
    if target.is_dir():  # inside: beside it may be another disk, or one may not write there
        temporary = _temporary(target / (target.name or "output"))
    else:
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = _temporary(target)
    temporary.mkdir()
    try:
        yield temporary
        target.mkdir(exist_ok=True)
        new = sorted(temporary.iterdir())
        for file in new:
            os.replace(file, target / file.name)
        written = {file.name for file in new}
        for file in list(target.iterdir()):
            if file.is_file() and file.name not in written and is_one_of(file.name, names):
                file.unlink()
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def remove(path: Path) -> None:
    """A file or a folder, gone; also where there is none."""
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _temporary(target: Path) -> Path:
    """A hidden name beside `target` that says whose it is; those of processes that are gone are removed."""
    host = "".join(letter for letter in platform.node() if letter.isalnum())[:32]
    for left in target.parent.glob(f".{glob.escape(host)}-*-*-{glob.escape(target.name)}"):
        owner = left.name.removeprefix(f".{host}-").partition("-")[0]
        if owner.isdecimal() and _is_gone(int(owner)):
            with contextlib.suppress(OSError):
                remove(left)
    return target.with_name(f".{host}-{os.getpid()}-{uuid.uuid4().hex[:8]}-{target.name}")


def _is_gone(process: int) -> bool:
    """Whether there is no such process on this machine; where that cannot be asked, there may be."""
    if os.name != "posix":  # elsewhere signal 0 is one
        return False
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return True
    except OSError:
        return False
    return False


def _to_the_disk(file: Path) -> None:
    """The name must not come before the content when the power fails."""
    with file.open("rb+") as opened:
        os.fsync(opened.fileno())


def is_zarr_folder(path: Path) -> bool:
    return any((path / name).is_file() for name in ("zarr.json", ".zarray", ".zgroup"))


def write_text(path: PathLike, text: str) -> None:
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_bytes(path: PathLike, content: bytes) -> None:
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def signature(path: PathLike) -> dict[str, Any]:
    """What tells a file, or the description of a zarr folder, from others: name, size, time of change."""
    path = Path(path)
    each = path / "zarr.json" if (path / "zarr.json").is_file() else path
    told = each.stat()
    return {"name": path.name, "bytes": told.st_size, "changed_ns": told.st_mtime_ns}


def write_json(path: PathLike, data: Any) -> None:
    """JSON without NaN: a number that is not known is null."""
    write_text(path, json.dumps(plain(data), indent=1, allow_nan=False) + "\n")


def write_table(path: PathLike, table: pd.DataFrame) -> None:
    with replacing(path) as temporary:
        table.to_csv(temporary, index=False)


def read_json(path: PathLike, what: str = "JSON") -> Any:
    """The content of a JSON file; raises `MufasaError` where there is none, naming what it should be, and for a key
    that one object has twice."""
    path = Path(path)
    if not path.exists():
        raise MufasaError(f"no file {path}: give the path of {what}")
    if not path.is_file():
        raise MufasaError(f"{path} is not readable: it is no file; give the path of {what}")
    try:
        if path.stat().st_size > MOST_JSON_BYTES:
            raise MufasaError(f"{path} is larger than {checks.size(MOST_JSON_BYTES)}: this is not {what}")
        return json.loads(path.read_text(encoding="utf-8-sig"), object_pairs_hook=_once)
    except MufasaError:
        raise
    except RecursionError:
        raise MufasaError(f"{path} is not readable JSON (nested too deep): write it anew") from None
    except (OSError, ValueError) as error:
        raise MufasaError(f"{path} is not readable JSON ({error}): write it anew") from None


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """A JSON object; of a key that is there twice nobody knows which value is meant."""
    found = dict(pairs)
    if len(found) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"{next(key for key in keys if keys.count(key) > 1)!r} is given twice")
    return found


def plain(value: Any) -> Any:
    """Numpy to plain Python; not-a-number and infinity to null."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [plain(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
