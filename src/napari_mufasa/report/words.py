"""What effects, parameters and numbers are called in figures, reports and the viewer."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from napari_mufasa.discover.result import Candidate, Report


def effect_title(kind: str) -> str:
    """What users call an effect; its identifier where it is not installed."""
    from napari_mufasa.effects import effect_class

    try:
        return effect_class(kind).title
    except ValueError:
        return kind.replace("_", " ")


def in_text(kind: str) -> str:
    """An effect's title inside a sentence: "EM" and other capitals stay."""
    title = effect_title(kind)
    return title if title[1:2].isupper() else title[:1].lower() + title[1:]


def parameter_label(kind: str, name: str) -> tuple[str, str]:
    """A parameter in words, and its unit: ("distance", "px")."""
    from napari_mufasa.effects import effect_class

    try:
        unit = effect_class(kind).unit(name)
    except (ValueError, KeyError):
        return name.replace("_", " "), ""
    suffix = {"1/s": "_per_s", "px²/frame": "_px2_per_frame", "%": "_percent"}.get(unit, f"_{unit}")
    return name.removesuffix(suffix).replace("_", " "), unit


def number(value: float, sd: float | None = None) -> str:
    """A value with as many digits as its uncertainty allows."""
    if sd is None or not np.isfinite(sd) or sd <= 0:
        return f"{value:.3g}"
    digits = int(np.clip(1 - np.floor(np.log10(sd)), 0, 8))
    return f"{value:.{digits}f} ± {sd:.{digits}f}"


def p_value_text(p_value: float | None) -> str:
    """p = …, or nothing where it is not known."""
    if p_value is None or not np.isfinite(p_value):
        return ""
    return f"p = {p_value:.2g}" if p_value >= 1e-4 else "p < 0.0001"


def verdict_text(report: Report) -> tuple[str, str]:
    """The verdict in plain words: one line, and one sentence on the error behind it."""
    before, after, floor = (report.error.get(key) for key in ("before", "after", "floor"))
    if report.verdict == "adequate":
        line = "The model explains this measurement."
        return line, f"Its error on held-out data is {_two(before)}; noise alone gives {_two(floor)}."
    fall = f"The error on held-out data falls from {_two(before)} to {_two(after)}; noise alone gives {_two(floor)}."
    chosen = " and ".join(in_text(kind) for kind in report.chosen)
    if report.verdict == "missing_effect" and not report.chosen:
        return lead_text(report)
    if report.verdict == "missing_effect":
        return f"Missing from the model: {chosen}.", fall
    if report.chosen:
        return f"Part of what is missing is {chosen}; the rest no known effect explains.", fall
    line = "Something is missing that no known effect explains."
    if report.ranking:
        line += f" It resembles {in_text(report.ranking[0].effect)} most."
    return line, f"The error on held-out data is {_two(before)}; noise alone gives {_two(floor)}."


def lead_text(report: Report) -> tuple[str, str]:
    """What adding the best effect would do, where none was added."""
    best, before = report.ranking[0], report.error["before"]
    gives = f"noise alone gives {_two(report.error.get('floor'))}."
    if best.error_after is None or best.error_after >= before:
        return "Something is missing, and no effect tried lowers the error.", f"The error is {_two(before)}; {gives}"
    return (
        f"Something is missing. {effect_title(best.effect)} explains it best.",
        f"Adding it brings the error on held-out data from {_two(before)} to {_two(best.error_after)}; {gives}",
    )


def chosen_candidates(report: Report) -> list[Candidate]:
    """The candidates that were added, in order."""
    by_kind = {candidate.effect: candidate for candidate in reversed(report.ranking)}
    return [by_kind[kind] for kind in report.chosen if kind in by_kind]


def parameter_lines(candidate: Candidate) -> list[str]:
    """Every parameter with value, sd and unit: "distance = 1.52 ± 0.04 px"."""
    lines = []
    for name, value in candidate.parameters.items():
        if name == "kind" or value == ():
            continue
        if isinstance(value, (tuple, list)):
            lines.append(f"{parameter_label(candidate.effect, name)[0]}: {len(value)} values, read off the movie")
            continue
        label, unit = parameter_label(candidate.effect, name)
        is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
        told = number(float(value), candidate.parameters_sd.get(name)) if is_number else str(value).replace("_", " ")
        lines.append(f"{label} = {told} {unit}".rstrip())
    return lines


def summary(report: Report) -> list[str]:
    """A diagnosis in a few lines, for a terminal."""
    line, sentence = verdict_text(report)
    lines = [line, f"  {sentence}"]
    for candidate in chosen_candidates(report):
        lines += [f"  {candidate.effect}: {told}" for told in parameter_lines(candidate)]
        if candidate.indistinguishable_from:
            lines.append(f"  {candidate.effect}: not told from {', '.join(candidate.indistinguishable_from)}")
    return lines


def _two(value: object) -> str:
    return f"{float(value):.2f}" if isinstance(value, (int, float)) else "unknown"
