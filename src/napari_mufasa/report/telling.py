"""Results in words, for the viewer's steps: a diagnosis, a comparison, a molecule. No Qt here."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.report.fields import number_text
from napari_mufasa.report.words import effect_title as title_of

if TYPE_CHECKING:
    from napari_mufasa.compare import Comparison
    from napari_mufasa.compare.wasserstein import Floor
    from napari_mufasa.discover.result import Candidate, Report

__all__ = [
    "comparison_table",
    "detectable_rows",
    "headline",
    "live_line",
    "map_line",
    "matching_curve",
    "molecule_line",
    "molecules_line",
    "title_of",
    "told",
    "words_of",
]  # fmt: skip


def words_of(candidate: Candidate) -> str:
    """What the effect is, its fitted numbers, what to check at the microscope."""
    from napari_mufasa.effects import catalogue
    from napari_mufasa.report.words import parameter_lines

    effect = catalogue().get(candidate.effect)
    lines = [f"{effect.what_it_is} {effect.what_it_does}"] if effect is not None else []
    fitted = parameter_lines(candidate)
    if fitted:
        lines.append(f"<b>Fitted:</b> {', '.join(fitted)}")
    if candidate.indistinguishable_from:
        others = ", ".join(title_of(kind).lower() for kind in candidate.indistinguishable_from)
        separate = f" To separate: {effect.separated_by}." if effect is not None and effect.separated_by else ""
        lines.append(f"<b>Cannot be told apart from:</b> {others}.{separate}")
    if effect is not None and effect.how_to_check:
        lines.append(f"<b>Check:</b> {effect.how_to_check}")
    return "<br>".join(lines)


def headline(report: Report) -> tuple[str, str]:
    """The verdict in words; before anything was added, what adding the best effect would do."""
    from napari_mufasa.report.words import lead_text, verdict_text

    best = report.ranking[0] if report.ranking else None
    before, after, floor = (report.error.get(name) for name in ("before", "after", "floor"))
    if report.chosen and report.verdict != "adequate" and before is not None and after is not None and after >= before:
        return (
            f"{title_of(report.chosen[-1])} does not lower the error: Undo takes it out.",
            f"The error on held-out data was {before:.2f}, it is {after:.2f}"
            + (f"; noise alone gives {floor:.2f}." if floor is not None else "."),
        )
    if report.verdict == "adequate" or report.chosen or best is None or best.error_after is None or before is None:
        return verdict_text(report)
    return lead_text(report)


def told(row: Any, completed: bool) -> str:
    """One observable in numbers; `completed` once an effect was added."""
    unit = f" {row['unit']}" if row["unit"] else ""
    model = f"model {row['before']:.3g} ± {row['sd']:.2g}{unit}"
    return f"<b>{row['title']}</b>: measured {row['measured']:.3g}, {model}" + (
        f" · now {row['after']:.3g}" if completed else ""
    )


def matching_curve(observable: str, curves: Any) -> Any:
    """The curve an observable belongs to: the one whose name it starts with (the longest such)."""
    fitting = [curve for curve in curves if observable.startswith(curve.name)]
    return max(fitting, key=lambda curve: len(curve.name), default=None)


def detectable_rows(report: Report) -> list[tuple[str, str, str, str]]:
    """(kind, title, smallest strength that would have shown, what it does) of each effect, those that show first."""
    from napari_mufasa.effects import catalogue
    from napari_mufasa.report.words import parameter_label

    rows = []
    for kind, strength in sorted(report.detectable.items(), key=lambda item: (item[1] is None, title_of(item[0]))):
        effect = catalogue().get(kind)
        words = "not at any plausible strength"
        if strength is not None and effect is not None:
            label, unit = parameter_label(kind, effect.strength)
            words = f"{label} {strength:.2g} {unit}".strip()
        rows.append((kind, title_of(kind), words, effect.what_it_does if effect is not None else ""))
    return rows


def comparison_table(comparison: Comparison) -> str:
    """Every model's distance to the measurement with its interval, and the floor, as HTML."""
    from napari_mufasa.report.plots.emission import MODELS

    rows = []
    for name in ("mufasa", "fitted", "poisson", "sofi"):
        if comparison.w1.get(name) is not None:
            low, high = comparison.w1_interval[name]
            words = f"{number_text(round(comparison.w1[name], 2))} ({low:.2f} … {high:.2f})"
            rows.append(f"<tr><td>{MODELS[name]}&nbsp;&nbsp;</td><td><b>{words}</b></td></tr>")
    floor, molecules = comparison.floor, len(comparison.samples["measured"].traces)
    rows.append(f"<tr><td>floor</td><td>{floor.value:.2f} ({floor.low:.2f} … {floor.high:.2f})</td></tr>")
    head = f"W1 distance in {comparison.w1['unit']}, {molecules} molecules (95 % interval)"
    return f"{head}<table>{''.join(rows)}</table>" + "".join(f"<br>{note}" for note in comparison.notes)


def molecule_line(row: Any) -> str:
    """A row of a table of molecules, as HTML."""
    verdict = "kept" if row["kept"] else f"rejected: {row['reason']}"
    bleached = int(row["bleaching_frame"])
    return (
        f"<b>Molecule {row['molecule']}</b> at y {row['y_px']:.1f}, x {row['x_px']:.1f} px · "
        f"{row['brightness']:.0f} e⁻ per frame, SNR {row['snr']:.1f} · "
        f"{f'bleached at frame {bleached}' if bleached >= 0 else 'not bleached'} · {verdict}"
    )


def map_line(layer: str, z: NDArray[Any], where: str) -> str:
    """What a map of misfit (in sd) shows; `where`: its worst stretch, if it has any."""
    off = float((np.abs(z) > 4).mean())
    return (
        f"Layer “{layer}”: measured − model in sd (green more, pink less); "
        f"{off:.1%} of the pixels are more than 4 sd off{where}."
    )


def molecules_line(layer: str, table: Any, number: str) -> str:
    """What a layer of molecules coloured by their misfit in a number (a column of `Places.molecules`) shows."""
    z = table[number].to_numpy(float)
    worst = table.iloc[int(np.argmax(np.abs(z)))]
    return (
        f"Layer “{layer}”: each molecule against the model's (green more, pink less); "
        f"{int((np.abs(z) > 3).sum())} of {len(z)} are more than 3 sd off, farthest at "
        f"y {worst['y_px']:.0f}, x {worst['x_px']:.0f} px."
    )


def live_line(w1: float, floor: Floor, busy: bool) -> str:
    """The distance of a model that is being edited, as HTML."""
    # A model at the floor scores anything up to about the largest distance of two halves.
    at = " – at the floor" if w1 <= floor.high else f" – {w1 / max(floor.value, 1e-9):.1f} × the floor"
    return f"W1 now <b>{w1:.2f}</b>, floor {floor.value:.2f} e⁻ per frame{at}{' …' if busy else ''}"
