"""report.html: a diagnosis for readers, in one file without links to anything outside."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from napari_mufasa.report.figures import Drawing, diagnosis_drawings
from napari_mufasa.report.words import (
    chosen_candidates,
    effect_title,
    in_text,
    p_value_text,
    parameter_lines,
    verdict_text,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from napari_mufasa.discover.result import Candidate, Report

MOST_ROWS = 40


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
    line, sentence = verdict_text(report)
    figures = {drawing.name: _picture(drawing) for drawing in diagnosis_drawings(report, traces)}
    opening = [figures.pop(name) for name in ("error_staircase", "evidence", "curves") if name in figures]
    chosen = chosen_candidates(report)
    parts = [
        f"<header class={report.verdict}><h1>{escape(line)}</h1><p class=lead>{escape(sentence)}</p>"
        f"<p class=quiet>{escape(subtitle)}</p></header>",
        *(_effect(candidate, figures.pop(f"strength_{candidate.effect}", "")) for candidate in chosen),
        *([] if chosen else [_nothing_added(report)]),
        *opening,
        "<h2>The observables</h2>",
        figures.pop("observables", ""),
        _observables(report),
        "<h2>What is still off</h2>",
        _still_off(report),
        _ranking(report),
        _detectable(report),
        *figures.values(),
        *(f"<h2>{escape(heading)}</h2><p>{escape(text)}</p>" for heading, text in extra),
        _notes(report),
        _model(report),
    ]
    return _PAGE.format(title=escape(title), style=_STYLE, body="\n".join(part for part in parts if part))


def _picture(drawing: Drawing) -> str:
    """Both themes in the page; the reader's browser takes the one that fits."""
    mime = "image/svg+xml" if drawing.kind == "svg" else "image/png"
    light, dark = (
        f"data:{mime};base64,{b64encode(drawing.render(theme, drawing.kind)).decode()}" for theme in ("light", "dark")
    )
    caption = escape(drawing.caption)
    return (
        f'<figure><picture><source srcset="{dark}" media="(prefers-color-scheme: dark)">'
        f'<img src="{light}" alt="{caption}"></picture><figcaption>{caption}</figcaption></figure>'
    )


def _effect(candidate: Candidate, figure: str) -> str:
    from napari_mufasa.effects import catalogue

    effect = catalogue().get(candidate.effect)
    told = ""
    if effect is not None:
        rows = (
            ("What it is", effect.what_it_is), ("What it does to the data", effect.what_it_does),
            ("How to check it at the microscope", effect.how_to_check),
        )  # fmt: skip
        told = "".join(f"<dt>{name}</dt><dd>{escape(text)}</dd>" for name, text in rows)
    values = "".join(f"<li>{escape(text)}</li>" for text in parameter_lines(candidate))
    doubt = ""
    if candidate.indistinguishable_from:
        names = ", ".join(in_text(kind) for kind in candidate.indistinguishable_from)
        by = f" What separates them: {effect.separated_by}." if effect is not None and effect.separated_by else ""
        doubt = f"<p class=doubt>These data cannot tell it from {escape(names)}.{escape(by)}</p>"
    share = f"{100 * candidate.share_explained:.0f} % of the removable error" if candidate.share_explained else ""
    facts = " · ".join(filter(None, (p_value_text(candidate.p_value), share)))
    return (
        f"<section class=card><h2>{escape(effect_title(candidate.effect))}</h2><p class=quiet>{escape(facts)}</p>"
        f"{doubt}<dl>{told}</dl><h3>Found in these data</h3><ul class=values>{values}</ul>{figure}</section>"
    )


def _nothing_added(report: Report) -> str:
    if report.verdict == "adequate":
        return "<p>Nothing needs to be added. Not seen is not absent: see below what these data would have shown.</p>"
    return "<p>No effect was added. The observables that stay off are the lead to follow.</p>"


_HEAD = "<tr><th>Observable<th>Where<th>Measured<th>Base<th>Completed<th>z before<th>z after</tr>"


def _observables(report: Report) -> str:
    order = report.observables["z_before"].abs().sort_values(ascending=False).index
    rows = [_row(row) for _, row in report.observables.loc[order[:MOST_ROWS]].iterrows()]
    more = f" (the {MOST_ROWS} farthest off)" if len(order) > MOST_ROWS else ""
    return (
        f"<details><summary>All {len(order)} observables{more}</summary><div class=wide><table>{_HEAD}"
        f"{''.join(rows)}</table></div></details>"
    )


def _row(row: Any) -> str:
    unit = f" {row['unit']}" if row["unit"] else ""
    cells = [
        escape(str(row["title"])), escape(str(row["where"])), f"{row['measured']:.4g} ± {row['sd']:.2g}{escape(unit)}",
        f"{row['before']:.4g}", f"{row['after']:.4g}", f"{row['z_before']:+.1f}", f"{row['z_after']:+.1f}",
    ]  # fmt: skip
    return "<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"


def _still_off(report: Report) -> str:
    off = report.observables[report.observables["z_after"].abs() > 3]
    if off.empty:
        return "<p>No observable of the completed model is more than 3 standard deviations from the measurement.</p>"
    order = off["z_after"].abs().sort_values(ascending=False).index
    rows = "".join(_row(row) for _, row in off.loc[order[:12]].iterrows())
    stay = "stays" if len(off) == 1 else "stay"
    return (
        f"<p>{len(off)} of {len(report.observables)} observables {stay} more than 3 standard deviations off.</p>"
        f"<div class=wide><table>{_HEAD}{rows}</table></div>"
    )


def _ranking(report: Report) -> str:
    if not report.ranking:
        return ""
    rows = []
    for c in report.ranking:
        after = "–" if c.error_after is None else f"{c.error_after:.2f}"
        cells = (
            effect_title(c.effect), p_value_text(c.p_value), f"{c.evidence:.1f}", after, "; ".join(parameter_lines(c))
        )  # fmt: skip
        rows.append("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in cells) + "</tr>")
    head = "<tr><th>Effect<th>p<th>Evidence<th>Error with it<th>Numbers</tr>"
    return (
        f"<details><summary>All effects that were tried</summary><div class=wide><table>{head}{''.join(rows)}</table>"
        "</div></details>"
    )


def _detectable(report: Report) -> str:
    if not report.detectable:
        return ""
    from napari_mufasa.effects import catalogue

    rows = []
    for kind, strength in report.detectable.items():
        effect = catalogue().get(kind)
        label, unit = ("strength", "")
        if effect is not None:
            from napari_mufasa.report.words import parameter_label

            label, unit = parameter_label(kind, effect.strength)
        told = "not with these data" if strength is None else f"{label} ≥ {strength:.3g} {unit}".rstrip()
        rows.append(f"<tr><td>{escape(effect_title(kind))}</td><td>{escape(told)}</td></tr>")
    return (
        "<h2>What these data would have shown</h2><p>The smallest strength of each effect that would have been seen "
        "with 80 % probability. Not seen is not absent.</p>"
        f"<details><summary>{len(rows)} effects</summary><table>{''.join(rows)}</table></details>"
    )


def _notes(report: Report) -> str:
    notes = [*report.notes, f"Error: {report.error.get('unit', '')}.", f"{report.seconds:.0f} s, seed {report.seed}."]
    return "<h2>Notes</h2><ul>" + "".join(f"<li>{escape(note)}</li>" for note in notes) + "</ul>"


def _model(report: Report) -> str:
    text = escape(json.dumps(report.model.to_dict(), indent=1))
    return (
        "<h2>The completed model</h2><p>Copy it into a file model.json and simulate: "
        "<code>napari-mufasa simulate --model model.json --out movie.ome.tif</code></p>"
        '<details><summary>model.json</summary><button onclick="navigator.clipboard.writeText('
        "document.getElementById('model').textContent)\">Copy</button>"
        f"<pre id=model>{text}</pre></details>"
    )


_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title><style>{style}</style></head><body><main>
{body}
</main></body></html>
"""
_STYLE = """
:root{color-scheme:light dark;--bg:#fff;--fg:#1d2430;--quiet:#5d6675;--line:#dfe3e9;--card:#f5f7fa;--ok:#2e8b57;
--alarm:#0b6fb8;--open:#b86200}
@media(prefers-color-scheme:dark){:root{--bg:#262930;--fg:#e8eaee;--quiet:#a4acb9;--line:#444a55;--card:#2e323a;
--ok:#63d297;--alarm:#4fb3ff;--open:#ffa94d}}
*{box-sizing:border-box}
body{margin:0;background:var(--bg);color:var(--fg);font:16px/1.55 system-ui,-apple-system,"Segoe UI",sans-serif}
main{max-width:46rem;margin:0 auto;padding:2.5rem 1.2rem 5rem}
header{border-left:.3rem solid var(--open);padding-left:1.1rem;margin-bottom:2rem}
header.adequate{border-color:var(--ok)}header.missing_effect{border-color:var(--alarm)}
h1{font-size:1.75rem;line-height:1.25;margin:0 0 .5rem}h2{font-size:1.2rem;margin:2.2rem 0 .5rem}
h3{font-size:1rem;margin:1.2rem 0 .3rem}.lead{font-size:1.1rem;margin:.2rem 0}.quiet,figcaption{color:var(--quiet)}
.card{background:var(--card);border-radius:.6rem;padding:.2rem 1.3rem 1rem;margin:1.4rem 0}.card h2{margin-top:1rem}
.card figure{border-radius:.4rem;overflow:hidden}
dt{font-weight:600;margin-top:.7rem}dd{margin:0}.doubt{border-left:.2rem solid var(--open);padding-left:.8rem}
.values{font-variant-numeric:tabular-nums}
figure{margin:1.6rem 0}img{width:100%;height:auto;display:block}figcaption{font-size:.88rem;margin-top:.3rem}
.wide{overflow-x:auto}table{border-collapse:collapse;font-size:.85rem;font-variant-numeric:tabular-nums;width:100%}
th,td{text-align:left;padding:.3rem .7rem .3rem 0;border-bottom:1px solid var(--line);vertical-align:top}
details{margin:1rem 0}summary{cursor:pointer;font-weight:600}
pre{background:var(--card);padding:1rem;border-radius:.5rem;overflow-x:auto;font-size:.8rem}
code{font-size:.88em}button{font:inherit;margin:.6rem 0;padding:.2rem .9rem;border-radius:.4rem;
border:1px solid var(--line);background:var(--card);color:inherit;cursor:pointer}
@media print{details>*{display:block}}
"""
