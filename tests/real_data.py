"""The real measurements beside the project: used from there, never copied; a test without them is skipped."""

from __future__ import annotations

from pathlib import Path

import pytest

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


def real_data(name: str) -> Path:
    """The path of a measurement listed in its INDEX.md; skips the test where it is not there."""
    path = DATA / name
    if not path.is_file():
        pytest.skip(f"no {path}")
    return path
