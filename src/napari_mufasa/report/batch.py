"""summary.html: a batch for readers, in one file; how it looks is in ``batch.html.j2``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from napari_mufasa.provenance import made_by, version
from napari_mufasa.report.words import in_text

if TYPE_CHECKING:
    import pandas as pd

VERDICTS = {"adequate": "the model explains it", "missing_effect": "an effect is missing", "unexplained": "unexplained"}
HEAD = (
    ("movie", "Movie"), ("condition", "Condition"), ("verdict", "Verdict"), ("effects", "Effects"),
    ("strengths", "Strengths [95 %]"), ("error_over_floor", "Error over floor"), ("error_after", "Error with effects"),
    ("w1", "W1"), ("w1_floor", "W1, floor"), ("molecules", "Molecules"), ("brightness_e", "Photoelectrons"),
    ("snr", "SNR"), ("diffusion_px2_per_frame", "D (px² per frame)"), ("problem", "Problem"),
    ("doubts", "Does the model belong?"),
)  # fmt: skip


def render(
    title: str, movies: pd.DataFrame, conditions: pd.DataFrame, apart: pd.DataFrame, reports: dict[str, str]
) -> str:
    """The whole page as text. reports : folder of a movie → its report, relative to the page."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    pages = Environment(
        loader=PackageLoader("napari_mufasa", "report"), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    shown = [(name, words) for name, words in HEAD if name in movies and (movies[name].fillna("") != "").any()]
    rows = [
        {
            "verdict": row.get("verdict") or ("problem" if row.get("problem") else ""),
            "report": reports.get(str(row["folder"])),
            "cells": [_cell(name, row[name]) for name, _ in shown],
        }
        for row in movies.to_dict("records")
    ]
    differs = apart[apart["differs"]] if len(apart) else apart
    return pages.get_template("batch.html.j2").render(
        title=title, head=[words for _, words in shown], rows=rows,
        lines=[difference_line(row) for _, row in differs.iterrows()],
        nothing_told=nothing_told(apart),
        several=movies["condition"].nunique() > 1 if "condition" in movies else False,
        apart_head=list(apart.columns), apart=[[_cell("", v) for v in row] for row in apart.to_numpy(dtype=object)],
        conditions_head=list(conditions.columns),
        conditions=[[_cell("", v) for v in row] for row in conditions.to_numpy(dtype=object)],
        made=f"Made by napari-mufasa {version()}: {made_by()['command'] or 'from Python'}.",
    )  # fmt: skip


def nothing_told(apart: pd.DataFrame) -> str:
    """What is said of conditions of which no row of the table of differences differs."""
    if len(apart) and apart["p_adjusted"].isna().all():
        return "Too few movies to tell the conditions apart"
    return "Nothing tells the conditions apart beyond chance"


def difference_line(row: Any) -> str:
    """A row of the table of differences that differs, as a sentence."""
    values = [f"{name}: {row[name]}" for name in row.index if name not in ("what", "p_value", "p_adjusted", "differs")]
    what = in_text(row["what"]) if _is_effect(row["what"]) else row["what"].replace("_", " ")
    return f"{what} ({', '.join(values)}; p = {row['p_adjusted']:.2g})"


def _is_effect(name: str) -> bool:
    from napari_mufasa.effects import catalogue

    return name in catalogue()


def _cell(name: str, value: Any) -> str:
    if value is None or (isinstance(value, float) and not np.isfinite(value)):
        return "–"
    if name == "verdict":
        return VERDICTS.get(value, str(value))
    if name == "effects":
        return ", ".join(in_text(kind) for kind in value.split(", ") if kind)
    if isinstance(value, (bool, np.bool_)):
        return "yes" if value else "no"
    return f"{value:.3g}" if isinstance(value, float) else str(value)
