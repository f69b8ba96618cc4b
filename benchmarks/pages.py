"""Tables in Markdown, and pages of docs/ that hold what a benchmark printed between two marks."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

DOCS = Path(__file__).resolve().parents[1] / "docs"
BEGIN, END = "<!-- benchmark begins -->", "<!-- benchmark ends -->"


def row(*cells: object) -> str:
    """A line of a table; what was not measured is left empty."""
    words = (("" if np.isnan(c) else f"{c:.2f}") if isinstance(c, float) else str(c) for c in cells)
    return "| " + " | ".join(words) + " |"


def header(*cells: str) -> list[str]:
    return [row(*cells), "|" + "---|" * len(cells)]


def write(page: str, title: str, section: str, titles: Iterable[str]) -> None:
    """Replace or append one section between the marks of a page; ``titles`` are all there may be, in order."""
    path = DOCS / page
    head, rest = path.read_text().split(BEGIN)
    body, tail = rest.split(END)
    parts = {part.partition("\n")[0].strip(): part.partition("\n")[2] for part in body.split("### ")[1:]}
    parts[title] = section.partition("\n")[2]
    text = "\n".join(f"### {name}\n{parts[name].rstrip()}\n" for name in titles if name in parts)
    path.write_text(f"{head}{BEGIN}\n{text}{END}{tail}")
