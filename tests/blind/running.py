"""One case of the blind trial: record the movie, diagnose it without its truth, keep both as a raw row.

`diagnose` gets the movie, the dark frames and the believed model only. Nothing is judged here (`judging.py`).
"""

from __future__ import annotations

import json
import subprocess
import time
import traceback
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import napari_mufasa as nm

from . import generator
from .cases import Case

ROOT = Path(__file__).parents[2]
Row = dict[str, Any]
CRASH = "crash"  # the verdict of a diagnosis that ended in an exception


def run(case: Case) -> Row:
    """The case's row: what was hidden, what the report says, and what it cost."""
    believed = generator.base_model(case["base"])
    hidden = generator.make(
        believed,
        effects=[tuple(e) for e in case["effects"]],
        seed=case["seed"],
        n_molecules=case["molecules"],
        form=case["form"],
        beside=[(case["off"], 0.5)] if case["off"] else (),
    )
    row = case | {
        "forms": [e["form"] for e in hidden.truth["effects"]],
        "truth": [e | {"parameters": _short(e["parameters"])} for e in hidden.truth["effects"]],
        "nuisance": hidden.truth["nuisance"],
        "state": state_of_the_code(),
    }
    began, worked = time.monotonic(), time.process_time()
    try:
        report = nm.diagnose(hidden.movie, nm.Model.from_dict(believed), hidden.dark, seed=case["seed"])
        row |= told(report)
    except Exception:
        row |= {"verdict": CRASH, "chosen": [], "ranking": [], "crash": traceback.format_exc().splitlines()[-4:]}
    return row | {
        "seconds": round(time.monotonic() - began, 2),
        "processor_seconds": round(time.process_time() - worked, 2),
    }


def told(report: nm.Report) -> Row:
    """What the report says, as plain data."""
    candidates = {c.effect: c for c in report.ranking}
    return {
        "verdict": report.verdict,
        "chosen": report.chosen,
        "ranking": [c.effect for c in report.ranking][:5],
        "error": {k: v for k, v in report.error.items() if k != "unit"},
        "history": report.history,
        "found": {kind: _found(candidates[kind]) for kind in report.chosen},
        "inclusion": report.inclusion,
        "alternatives": report.alternatives,
        "explained": report.explained,
        "credibility": report.credibility,
        "credibility_before": report.credibility_before,
        "detectable": report.detectable,
        "remaining": [{k: each[k] for k in ("observable", "z")} for each in report.remaining[:8]],
        "failing": [{k: each[k] for k in ("observable", "z")} for each in report.failing[:8]],
        "simulations": report.simulations,
    }


def _found(candidate: Any) -> dict[str, Any]:
    return {
        "parameters": _short(candidate.parameters),
        "sd": candidate.parameters_sd,
        "rivals": list(candidate.indistinguishable_from),
        "evidence": candidate.evidence,
        "error_without": candidate.error_without,
    }


def _short(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Without maps, courses and lists of molecules."""
    return {k: v for k, v in parameters.items() if isinstance(v, (int, float, str))}


@cache
def state_of_the_code() -> str:
    """The commit that ran, "+" behind it where files differ from it; as it was when the process began."""
    told = subprocess.run(
        ["git", "-C", str(ROOT), "describe", "--always", "--dirty=+"], capture_output=True, text=True, check=False
    )
    return told.stdout.strip() or f"version {nm.__version__}"


def append(path: Path, row: Row) -> None:
    """In one write, so that two processes may share a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("ab", buffering=0) as file:
        file.write((json.dumps(row) + "\n").encode())


def read(*paths: Path) -> list[Row]:
    """The rows of files; of those that are not there, none."""
    return [json.loads(line) for path in paths if path.exists() for line in path.read_text().splitlines() if line]
