"""What a refusal must be: one clear line that says what and what to do, exit code 2, nothing left behind."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.trust import broken_files
from tests.trust.broken_files import SHAPE, counts

import napari_mufasa as nm
from napari_mufasa.cli import main

#: A line that helps says what to do.
REMEDY = re.compile(
    r"\b(give|choose|needs?|use|export|copy|crop|write|make|see|set|lower|record|take|drop|add|save|unpack|open|allow"
    r"|vary|correct|did you mean|known keys|must|remove|check|should (be|have)|known effects|fill|clear|only)\b"
)
SMALL = {
    "acquisition.shape_px": SHAPE[1:], "acquisition.n_frames": SHAPE[0], "sample.n_molecules": 4,
    "excitation.power_density_w_per_cm2": 30,
}  # fmt: skip
MODEL = nm.preset("FF").with_values(SMALL)
PLAIN = MODEL.to_dict()


GOOD = counts()
SPOILT = GOOD.astype(float)
SPOILT[3, 4, 5] = np.nan
OBJECTS = np.array([[[broken_files.Boom()] * 16] * 16] * 4, dtype=object)
BAD_STACKS: dict[str, Any] = {
    "nothing": None, "a number": 5, "a path": "movie.tif", "a model": MODEL, "one axis": GOOD[0, 0],
    "four axes": GOOD[None],
    "colour": np.zeros((5, 32, 32, 3), np.uint8), "a colour image": np.zeros((32, 32, 3), np.uint8),
    "five axes": GOOD[None, None], "no frame": GOOD[:0], "no pixel": GOOD[:, :0], "unequal lists": [[[1, 2]], [[1]]],
    "text": GOOD.astype(str), "complex": GOOD.astype(complex), "yes and no": GOOD > 210, "objects": OBJECTS,
    "nan": SPOILT, "infinite": np.where(np.isnan(SPOILT), np.inf, SPOILT), "negative": GOOD.astype(int) - 1000,
    "masked": np.ma.masked_greater(GOOD, 230), "times": GOOD.astype("datetime64[s]"),
}  # fmt: skip


def check_line(told: str, word: str) -> None:
    assert "\n" not in told and "Traceback" not in told and told.isprintable(), told
    assert word in told, told
    assert REMEDY.search(told), f"says not what to do: {told}"


def everything(folder: Path) -> dict[str, bytes | None]:
    """Every file below a folder with its content, pipes and links without."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() and not path.is_symlink() else None
        for path in sorted(folder.rglob("*"))
    }


def refused(capfd: Any, place: Path, word: str, *arguments: object) -> None:
    before = everything(place)
    with pytest.raises(SystemExit) as left:
        main([str(argument) for argument in arguments])
    out, err = capfd.readouterr()
    assert left.value.code == 2, (left.value.code, err)
    assert err.endswith("\n") and err.startswith("napari-mufasa: ")
    check_line(err.removesuffix("\n"), word)
    assert out == ""
    assert everything(place) == before


def not_none(value: Any) -> Any:
    return 0 if value is None else value
