"""The folders that cases of bad input work in."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tests.trust.broken_files import counts, tiff
from tests.trust.refusal import MODEL

from napari_mufasa.files.traces import write_trace_file


@pytest.fixture
def place(tmp_path, monkeypatch) -> Path:
    """The folder that a case works in, with a good model and a good movie."""
    monkeypatch.chdir(tmp_path)
    for name in ("in", "good", "out"):
        (tmp_path / name).mkdir()
    MODEL.to_json(tmp_path / "good/model.json")
    tiff(tmp_path / "good", counts(), "movie.tif")
    tiff(tmp_path / "good", counts(1)[:8], "dark.tif")
    return tmp_path


@pytest.fixture
def more(place) -> Path:
    """Files that cases of the command line use."""
    for name in ("p.csv", "positions.csv"):
        (place / "in" / name).write_text("y_px,x_px\n1,2\n3,4\n")
    tiff(place / "in", counts()[:, :20], "other.tif")
    tiff(place / "in", counts()[:1], "one.tif")
    tiff(place / "in", counts()[:, :20, :20].copy(), "narrow.tif")
    tiff(place / "in", counts(2), "dark.tif")
    write_trace_file(place / "in/traces.csv", np.random.default_rng(0).normal(100, 5, (3, 20)))
    MODEL.with_values({"camera.adc_max": 205, "camera.baseline_adu": 100}).to_json(place / "in/eight.json")
    MODEL.with_values({"effects": [{"kind": "stage_drift"}]}).to_json(place / "in/drift.json")
    return place
