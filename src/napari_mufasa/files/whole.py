"""Files that are whole or not there: everything is written to a temporary name and renamed."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_mufasa.errors import MufasaError

if TYPE_CHECKING:
    import pandas as pd

PathLike = str | os.PathLike[str]


@contextlib.contextmanager
def replacing(path: PathLike) -> Iterator[Path]:
    """A temporary path beside `path`, renamed to it at the end; removed when anything fails."""
    target = Path(path)
    if not target.parent.is_dir():
        raise MufasaError(f"no folder {target.parent}: make it first or choose another output path")
    if target.is_dir() and not _is_zarr_folder(target):
        raise MufasaError(f"{target} is a folder: choose a file name for the output")
    temporary = target.with_name(f".{os.getpid()}-{target.name}")
    try:
        yield temporary
        if target.is_dir():
            shutil.rmtree(target)
        os.replace(temporary, target)
    finally:
        if temporary.is_dir():
            shutil.rmtree(temporary)
        else:
            temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def filling(folder: PathLike) -> Iterator[Path]:
    """A temporary folder beside `folder`; its files move into it together at the end, or disappear."""
    target = Path(folder)
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
    try:
        yield temporary
        target.mkdir(exist_ok=True)
        for file in sorted(temporary.iterdir()):
            os.replace(file, target / file.name)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _is_zarr_folder(path: Path) -> bool:
    return any((path / name).is_file() for name in ("zarr.json", ".zarray", ".zgroup"))


def write_text(path: PathLike, text: str) -> None:
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: PathLike, data: Any) -> None:
    """JSON without NaN: a number that is not known is null."""
    write_text(path, json.dumps(_plain(data), indent=1, allow_nan=False) + "\n")


def write_table(path: PathLike, table: pd.DataFrame) -> None:
    with replacing(path) as temporary:
        table.to_csv(temporary, index=False)


def read_json(path: PathLike) -> Any:
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise MufasaError(f"{path} is not readable JSON ({error})") from None


def _plain(value: Any) -> Any:
    """Numpy to plain Python; not-a-number and infinity to null."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [_plain(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
