"""What effects, parameters and numbers are called, in figures, reports, the terminal and the viewer. No Qt here."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_mufasa.discover.rules import DOUBTFUL

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from napari_mufasa.discover.result import Candidate, Curve, Report
    from napari_mufasa.model.model import Model


FAINT_SD = 3.5  # well below what traces ask for: visits scatter, and of many the longest does more
MOST_OFF = 3  # observables that are told as still off
NEEDLESS = 0.05  # p-value beyond which the data do not ask for an effect that was added by hand


# effects, parameters, numbers ------------------------------------------------------------------------------
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
    from napari_mufasa.calibrate.value import Value

    known = sd is not None and np.isfinite(sd) and sd > 0
    return str(Value(value, float(sd))) if known else f"{value:.3g}"  # type: ignore[arg-type]


def p_value_text(p_value: float | None) -> str:
    """p = …, or nothing where it is not known."""
    if p_value is None or not np.isfinite(p_value):
        return ""
    return f"p = {p_value:.2g}" if p_value >= 1e-4 else "p < 0.0001"


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


# a model ---------------------------------------------------------------------------------------------------
def derived_values(model: Model) -> list[tuple[str, str, str]]:
    """(name, value with unit, explanation) of what a model implies: its `Prediction` in an experimenter's words."""
    from napari_mufasa.design.predict import predict

    told = predict(model)
    rows = [
        ("Excitation rate k01", f"{_short(told.k01_per_s)} /s", "from ε, power density and wavelength"),
        (
            "Photons emitted",
            f"{_short(told.emitted_photons_per_frame)} per frame",
            "by one molecule that is on for the whole frame",
        ),
        (
            "Photons collected",
            f"{_short(told.collected_photons_per_frame)} per frame",
            "of those, what reaches the detector",
        ),
        ("Brightest pixel", f"{_short(told.peak_pixel_e)} e⁻", "photoelectrons of one molecule in its centre pixel"),
        ("Signal to noise", _ratio(told.snr_peak_pixel), "brightest pixel, one frame"),
        ("Signal to noise, whole spot", _ratio(told.snr_spot), "the PSF fitted to one frame, as traces are made"),
    ]
    if told.on_time_s is not None and told.on_time_s < model.acquisition.frame_length_s:
        share = told.on_time_s / model.acquisition.frame_length_s
        why = f"it lasts {_short(100 * share)} % of a frame: hardly a frame is as bright as those above"
        rows.append(("Signal to noise, bright visit", _ratio(told.snr_visit), why))
    if told.bleaching_time_s is not None:
        frames = told.bleaching_time_s / model.acquisition.interval_s
        rows.append(
            (
                "Bleaching after",
                f"{_short(told.bleaching_time_s)} s ({_short(frames)} frames)",
                "mean time until a molecule bleaches, its dark times included",
            )
        )
    rows.append(("Movie length", f"{_short(told.movie_s)} s", "number of frames × frame interval"))
    return rows


def hardly_seen(model: Model) -> str:
    """One line where traces will find few of a movie's molecules, or none, or too little of their light; nothing where
    they stand out and the camera holds them."""
    from napari_mufasa.design.predict import SATURATES, predict

    told = predict(model)
    stands_out = told.detection_sd
    if told.headroom_sd < SATURATES:
        return (
            f"The brightest pixel of a bright molecule comes to {_short(told.peak_pixel_adu)} counts on average, the "
            f"camera holds {model.camera.adc_max} (effects not counted): it is cut off, and traces are too dim; "
            "`design` tells how much light is not too much."
        )
    if stands_out >= FAINT_SD:
        return ""
    return (
        f"Its molecules stand out by {_ratio(stands_out)} sd of the noise (effects not counted), and traces ask for 6: "
        "they may miss most of them, or all; `design` tells what more light, more or longer frames or less noise do."
    )


def _short(value: float) -> str:
    if value == 0 or not np.isfinite(value):
        return f"{value:g}"
    if abs(value) >= 1e5 or abs(value) < 1e-2:
        return f"{value:.2e}"
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def _ratio(value: float) -> str:
    return f"{value:.2g}" if np.isfinite(value) else "∞"


# a diagnosis -----------------------------------------------------------------------------------------------
def verdict_text(report: Report) -> tuple[str, str]:
    """The verdict in plain words: one line, and one sentence on the error behind it."""
    before, after, floor = (report.error.get(key) for key in ("before", "after", "floor"))
    if report.verdict == "adequate":
        line = "The model explains this measurement."
        return line, f"Its error on held-out data is {_two(before)}; noise alone gives {_two(floor)}."
    fall = f"The error on held-out data falls from {_two(before)} to {_two(after)}; noise alone gives {_two(floor)}."
    chosen = listed(in_text(kind) for kind in report.chosen)
    if report.verdict == "missing_effect" and not report.chosen:
        return _lead(report)
    if report.verdict == "missing_effect":
        return f"Missing from the model: {chosen}.", fall
    if report.chosen:
        share = f"{_percent(report.explained)} of the misfit" if report.explained else "Part of what is missing"
        none = "none of those that were considered" if report.suspects else "no known effect"
        if report.cut_short:
            none = f"nothing that the budget of {report.simulations['budget']} simulations left room to try"
        return f"{share} is explained by {chosen}; the rest by {none}.", fall
    none = "none of the effects considered" if report.suspects else "no known effect"
    line = f"Something is missing that {none} explains."
    if report.cut_short:
        line = (
            f"Something is missing; the budget of {report.simulations['budget']} simulations left no room to try what."
        )
    if report.ranking:
        line += f" It resembles {in_text(report.ranking[0].effect)} most."
    return line, f"The error on held-out data is {_two(before)}; noise alone gives {_two(floor)}."


def standing_lines(report: Report) -> list[str]:
    """How good the completed model is, what its names could also be, and what is still off in its own unit."""
    lines = []
    after, floor = report.error.get("after"), report.error.get("floor")
    if report.chosen and after is not None and floor:
        explained = f"{_percent(report.explained)} of the misfit is explained, to " if report.explained else ""
        lines.append(f"{explained}{after / floor:.2f} times the error that noise alone gives.")
    if report.credibility > 1.05:
        lines.append(
            f"With {report.credibility:.1f} times fewer molecules or frames nobody could tell model and movie apart"
            + (f" ({report.credibility_before:.0f} times for the model believed)." if report.chosen else ".")
        )
    elif report.chosen:
        lines.append("These data cannot tell the completed model and the movie apart.")
    if report.camera:
        lines.append(
            f"The movie contradicts the camera believed: {report.camera}. Measure it (`napari-mufasa calibrate`)."
        )
    named = {kinds[0] for kinds in report.alternatives}
    unsure = {kind: sure for kind, sure in report.inclusion.items() if sure < DOUBTFUL and kind not in named}
    if unsure:
        names = listed(f"{in_text(kind)} ({_percent(sure)})" for kind, sure in unsure.items())
        left = "What nothing explains is more than half of what each takes away"
        lines.append(f"Not sure: {names}. {left}, and may be what it stands in for.")
    for kinds in report.alternatives:
        lines.append(f"One of these, and the data cannot tell which: {listed((in_text(k) for k in kinds), 'or')}.")
    if report.chosen and report.remaining:
        lines.append(f"Still off: {'; '.join(_off(row) for row in report.remaining[:MOST_OFF])}.")
    return lines


def _off(row: dict[str, Any]) -> str:
    measured, simulated, unit = f"{row['measured']:.3g}", f"{row['simulated']:.3g}", _unit(row)
    return f"{row['title']}, {measured} measured, {simulated} simulated{unit} ({row['z']:+.0f} sd)"


def _unit(row: Any) -> str:
    """The unit of an observable, to stand behind its number; logarithms are told as such."""
    unit = str(row["unit"])
    if unit.split(" ")[0] == "ln":
        return f" (natural log{unit.removeprefix('ln').replace(' ', ' of ')})"
    return f" {unit}" if unit else ""


def listed(names: Iterable[str], word: str = "and") -> str:
    """ "a, b and c"."""
    *first, last = list(names) or [""]
    return f"{', '.join(first)} {word} {last}" if first else last


def _percent(share: float) -> str:
    """A share that is not all of it is not told as 100 %."""
    return f"{100 * share:.0f} %" if share < 0.99 else f"{min(np.floor(1000 * share) / 10, 99.9):.1f} %"


def headline(report: Report) -> tuple[str, str]:
    """`verdict_text` while effects are still being added by hand.

    Before anything was added it says what adding the best effect would do; after an addition that did not lower the
    error, that it can be taken out.
    """
    best = report.ranking[0] if report.ranking else None
    before, after, floor = (report.error.get(key) for key in ("before", "after", "floor"))
    added = report.chosen and report.verdict != "adequate"
    if added and before is not None and after is not None and (after >= before or _percent(report.explained) == "0 %"):
        what = "does not lower" if after >= before else "hardly lowers"
        return (
            f"{effect_title(report.chosen[-1])} {what} the error: Undo takes it out.",
            f"The error on held-out data was {_two(before)}, it is {_two(after)}; noise alone gives {_two(floor)}.",
        )
    may_lead = report.verdict != "adequate" and not report.chosen and before is not None
    if may_lead and best is not None and best.error_after is not None:
        return _lead(report)
    line, sentence = verdict_text(report)
    needless = [in_text(c.effect) for c in report.ranking if c.effect in report.chosen and c.p_value > NEEDLESS]
    if needless:
        sentence += f" The data do not ask for {listed(needless)}: Take out tells what the model is worth without."
    return line, sentence


def _lead(report: Report) -> tuple[str, str]:
    """What adding the best effect would do, where none was added."""
    best, before = report.ranking[0], report.error["before"]
    gives = f"noise alone gives {_two(report.error.get('floor'))}."
    if best.error_after is None or best.error_after >= before:
        return "Something is missing, and no effect tried lowers the error.", f"The error is {_two(before)}; {gives}"
    line = f"Something is missing. {effect_title(best.effect)} explains it best."
    if best.evidence <= (report.evidence_needed or 0.0):
        line = f"Something is missing, and no effect tried explains it: {in_text(best.effect)} comes nearest."
    return (
        line,
        f"Adding it brings the error on held-out data from {_two(before)} to {_two(best.error_after)}; {gives}",
    )


def chosen_candidates(report: Report) -> list[Candidate]:
    """The candidates that were added, in order."""
    by_kind = {candidate.effect: candidate for candidate in reversed(report.ranking)}
    return [by_kind[kind] for kind in report.chosen if kind in by_kind]


def summary(report: Report) -> list[str]:
    """A diagnosis in a few lines, for a terminal."""
    line, sentence = verdict_text(report)
    lines = [line, f"  {sentence}", *(f"  {told}" for told in standing_lines(report))]
    for candidate in chosen_candidates(report):
        lines += [f"  {candidate.effect}: {told}" for told in parameter_lines(candidate)]
        if candidate.indistinguishable_from:
            lines.append(f"  {candidate.effect}: not told from {', '.join(candidate.indistinguishable_from)}")
    return lines + [f"  {line}" for line in check_lines(report.check)]


def check_lines(check: dict[str, Any]) -> list[str]:
    """What data of the same set-up that a finding has not seen say of it; nothing where nobody asked."""
    if not check:
        return []
    both, parameters, error = check["both"], check["parameters"], check["error"]
    named = [*both, *check["only_here"], *check["only_there"]]
    none = "nothing is missing in either" if check["shared"] == 1 else "no effect is named in either"
    names = f"{len(both)} of {len(named)} effects are named in both" if named else none
    lines = [f"Checked on {check['against']}: {names}."]
    for where, kinds in (("here", check["only_here"]), ("there", check["only_there"])):
        if kinds:
            lines.append(f"Only {where}: {', '.join(in_text(kind) for kind in kinds)}.")
    if parameters:
        lines.append(f"{sum(row['agree'] for row in parameters)} of {len(parameters)} parameters agree (95 %).")
    for row in parameters:
        if not row["agree"]:
            label, unit = parameter_label(row["effect"], row["parameter"])
            here, there = (f"{number(row[side], row[f'{side}_sd'])} {unit}".rstrip() for side in ("here", "there"))
            lines.append(f"{effect_title(row['effect'])}, {label}: {here} here, {there} there.")
    lines.append(
        f"The model completed here has an error of {_two(error['carried'])} there, the one completed there "
        f"{_two(error['after'])}, the one believed {_two(error['before'])}; noise alone gives {_two(error['floor'])}."
    )
    return lines


@dataclass(frozen=True)
class EffectWords:
    """An effect's case in words; `alike` and `separated_by` say what these data cannot tell it from."""

    title: str
    what_it_is: str
    what_it_does: str
    how_to_check: str
    fitted: list[str]
    alike: str
    separated_by: str


def effect_words(candidate: Candidate) -> EffectWords:
    """What the effect is, its fitted numbers, what to check at the microscope. Empty where nothing is known."""
    from napari_mufasa.effects import catalogue

    effect = catalogue().get(candidate.effect)
    return EffectWords(
        title=effect_title(candidate.effect),
        what_it_is=effect.what_it_is if effect is not None else "",
        what_it_does=effect.what_it_does if effect is not None else "",
        how_to_check=effect.how_to_check if effect is not None else "",
        fitted=parameter_lines(candidate),
        alike=", ".join(in_text(kind) for kind in candidate.indistinguishable_from),
        separated_by=effect.separated_by if effect is not None else "",
    )


def words_of(candidate: Candidate) -> str:
    """`effect_words` as rich text for the viewer."""
    words = effect_words(candidate)
    lines = [escape(f"{words.what_it_is} {words.what_it_does}".strip())]
    if words.fitted:
        lines.append(f"<b>Fitted:</b> {escape(', '.join(words.fitted))}")
    if words.alike:
        separate = f" To separate: {words.separated_by}." if words.separated_by else ""
        lines.append(f"<b>Cannot be told apart from:</b> {escape(words.alike)}.{escape(separate)}")
    if words.how_to_check:
        lines.append(f"<b>Check:</b> {escape(words.how_to_check)}")
    return "<br>".join(line for line in lines if line)


def observable_text(row: Any, completed: bool) -> str:
    """One row of `Report.observables` in numbers, as rich text; `completed` once an effect was added."""
    model = f"model {row['before']:.3g} ± {row['sd']:.2g}{_unit(row)}"
    return f"<b>{escape(str(row['title']))}</b>: measured {row['measured']:.3g}, {escape(model)}" + (
        f" · now {row['after']:.3g}" if completed else ""
    )


def matching_curve(observable: str, curves: Sequence[Curve]) -> Curve | None:
    """The curve an observable belongs to: the one whose name it starts with (the longest such)."""
    fitting = [curve for curve in curves if observable.startswith(curve.name)]
    return max(fitting, key=lambda curve: len(curve.name), default=None)


def ranking_rows(report: Report) -> list[tuple[str, list[str], str]]:
    """(kind, cells of a table, `words_of`) of each effect that was added, and that could be missing, the best first."""
    rows = []
    for c in report.ranking:
        title = f"✓ {effect_title(c.effect)}" if c.effect in report.chosen else effect_title(c.effect)
        errors = ["–" if error is None else f"{error:.2f}" for error in (c.error_after, c.error_without)]
        rows.append((c.effect, [title, f"{c.evidence:.0f}", *errors, f"{c.p_value:.1g}"], words_of(c)))
    return rows


def failing_rows(report: Report) -> list[tuple[str, list[str], str]]:
    """(observable, cells of a table, words with its place) of each observable that the model misses."""
    rows = []
    for item in report.failing:
        title, now = str(item.get("title", item["observable"])), item.get("z_after")
        cells = [title, f"{item['z']:+.1f}", "" if now is None else f"{now:+.1f}"]
        rows.append((str(item["observable"]), cells, f"{title}\n{item.get('where') or ''}".strip()))
    return rows


def detectable_rows(report: Report) -> list[tuple[str, list[str], str]]:
    """(kind, [title, smallest strength that would have shown], what it does) of each effect, those that show first."""
    from napari_mufasa.effects import catalogue

    rows = []
    for kind, strength in sorted(report.detectable.items(), key=lambda item: (item[1] is None, effect_title(item[0]))):
        effect = catalogue().get(kind)
        words = "not at any plausible strength"
        if strength is not None:
            label, unit = parameter_label(kind, effect.strength) if effect is not None else ("strength", "")
            words = f"{label} ≥ {_short(strength)}"
            if effect is not None and strength > effect.null_value > effect.plausible()[effect.strength][0]:
                words += f" or ≤ {_short(2 * effect.null_value - strength)}"
            words = f"{words} {unit}".strip()
        rows.append((kind, [effect_title(kind), words], effect.what_it_does if effect is not None else ""))
    return rows


def _two(value: object) -> str:
    return f"{float(value):.2f}" if isinstance(value, (int, float)) else "unknown"
