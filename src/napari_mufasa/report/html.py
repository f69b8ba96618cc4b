"""report.html: a diagnosis for readers, in one file without links to anything outside.

What the page says is put together here; how it looks is in ``report.html.j2``.
"""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from napari_mufasa.provenance import made_by, version
from napari_mufasa.report.figures import Drawing, diagnosis_drawings
from napari_mufasa.report.words import (
    check_lines,
    chosen_candidates,
    detectable_rows,
    effect_title,
    effect_words,
    p_value_text,
    parameter_lines,
    standing_lines,
    verdict_text,
)

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray

    from napari_mufasa.discover.result import Candidate, Report

MOST_ROWS, MOST_OFF = 40, 12
OPENING = ("error_staircase", "evidence", "curves")
OBSERVABLES_HEAD = ("Observable", "Where", "Measured", "Base", "Completed", "z before", "z after")


def export(folder: Path, report: Report, traces: NDArray[Any] | None = None, subtitle: str = "") -> None:
    """All files of a diagnosis: report.json, report.html, model.json, observables.csv and the figures."""
    from napari_mufasa import files

    files.write_json(folder / "report.json", report.to_dict())
    files.write_text(folder / "report.html", render(report, traces=traces, subtitle=subtitle))
    report.model.to_json(folder / "model.json")
    files.write_table(folder / "observables.csv", report.observables)
    for drawing in diagnosis_drawings(report, traces):
        (folder / f"{drawing.name}.png").write_bytes(drawing.render("light"))


def render(
    report: Report, *, title: str = "What is missing from the model", subtitle: str = "",
    traces: NDArray[Any] | None = None, extra: Sequence[tuple[str, str]] = (),
) -> str:  # fmt: skip
    """The whole page as text. `extra` are further (heading, plain text) sections at the end."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    line, sentence = verdict_text(report)
    figures = {drawing.name: drawing for drawing in diagnosis_drawings(report, traces)}
    effects = [
        (effect_words(candidate), _facts(candidate), figures.pop(f"strength_{candidate.effect}", None))
        for candidate in chosen_candidates(report)
    ]
    observables = report.observables
    off = observables[observables["z_after"].abs() > 3]
    # Autoescaping: names of files and observables are others' words.
    pages = Environment(
        loader=PackageLoader("napari_mufasa", "report"), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    return pages.get_template("report.html.j2").render(
        title=title, subtitle=subtitle, report=report, line=line, sentence=sentence, effects=effects, extra=extra,
        standing=standing_lines(report), check=check_lines(report.check),
        opening=[figures.pop(name) for name in OPENING if name in figures],
        observables_drawing=figures.pop("observables", None),
        observables_head=OBSERVABLES_HEAD,
        observables=_rows(observables, "z_before", MOST_ROWS), n_observables=len(observables),
        still_off=_rows(off, "z_after", MOST_OFF), n_off=len(off),
        ranking=[_ranked(candidate) for candidate in report.ranking],
        detectable=[tuple(cells) for _, cells, _ in detectable_rows(report)],
        closing=list(figures.values()),
        notes=[
            *report.notes, f"Error: {report.error.get('unit', '')}.", f"{report.seconds:.0f} s, seed {report.seed}.",
            f"Made by napari-mufasa {version()}: {made_by()['command'] or 'from Python'}.",
        ],
        model_json=json.dumps(report.model.to_dict(), indent=1),
        draw=_picture,
    )  # fmt: skip


def _picture(drawing: Drawing) -> dict[str, str]:
    """Both themes as data addresses; the reader's browser takes the one that fits."""
    mime = "image/svg+xml" if drawing.kind == "svg" else "image/png"
    return {
        theme: f"data:{mime};base64,{b64encode(drawing.render(theme, drawing.kind)).decode()}"
        for theme in ("light", "dark")
    }


def _facts(candidate: Candidate) -> str:
    share = f"{100 * candidate.share_explained:.0f} % of the removable error" if candidate.share_explained else ""
    return " · ".join(filter(None, (p_value_text(candidate.p_value), share)))


def _rows(observables: pd.DataFrame, by: str, most: int) -> list[tuple[str, ...]]:
    """The observables farthest off, as the cells of `OBSERVABLES_HEAD`."""
    order = observables[by].abs().sort_values(ascending=False).index[:most]
    return [
        (
            str(row["title"]), str(row["where"]),
            f"{row['measured']:.4g} ± {row['sd']:.2g} {row['unit'] or ''}".rstrip(),
            f"{row['before']:.4g}", f"{row['after']:.4g}", f"{row['z_before']:+.1f}", f"{row['z_after']:+.1f}",
        )
        for _, row in observables.loc[order].iterrows()
    ]  # fmt: skip


def _ranked(candidate: Candidate) -> tuple[str, ...]:
    after = "–" if candidate.error_after is None else f"{candidate.error_after:.2f}"
    told = effect_title(candidate.effect), p_value_text(candidate.p_value), f"{candidate.evidence:.1f}"
    return (*told, after, "; ".join(parameter_lines(candidate)))
