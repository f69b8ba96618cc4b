"""The trial's tables, as Markdown, and its page docs/blind_trial.md."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from statistics import median

from . import forms, judging
from .bases import APART
from .cases import PLAN, trial_seed
from .judging import Line, Row

GROUPS = {
    "single": "one effect, clearly visible (strength 0.4, 0.6 or 0.8 of the generator's scale)",
    "faint": "one effect, × 0.35",
    "strong": "one effect, × 2.2, at most 1, where the generator's scale ends",
    "null": "nothing hidden",
    "several": "three to five effects of strength 0.5",
    "several_off": "three to five, and one disturbance off the catalogue",
    "off": "one disturbance off the catalogue",
    "pair": "two effects of strength 0.5",
}


def page(rows: Sequence[Row], command: str) -> str:
    """docs/blind_trial.md: which command wrote it, from how much of a trial and which code, and the tables."""
    states = ", ".join(sorted({row["state"] for row in rows}))
    others = [row for row in rows if row["base"] in APART]
    rows = judging.of_planned_bases(rows)
    return f"""# Blind trial

`{command}` wrote this page, from rows of `python -m tests.blind.trial`; a row is one movie of the independent
generator (`tests/blind`), diagnosed without its truth.
{how_many(rows)} Rows of several states of the code stand beside one another: {states}.

*First*: a hidden effect heads the ranking. *Exactly right*: all that is hidden is named, and nothing else.

{summary(rows)}
## The cases

{_groups(rows)}
{_bases(rows)}
## Single effects

{_each_effect(rows)}
## Several at once

{_each_movie(rows)}
## Parameters

Of known forms, where a parameter means the same in generator and catalogue and the form chosen is the one hidden.

{_parameters(rows)}{_apart(others) if others else ""}"""


def _apart(rows: Sequence[Row]) -> str:
    """The section of movies for whose molecules the generator's strengths are not made."""
    return f"""
## Blinking, STORM and PALM, few molecules and many

Counted apart: the generator's strengths are those of some fifty molecules that are lit all along. Where each is lit
but shortly, or once, or where there are but 15, a drift of the stage or unequal brightness may show nothing; what the
report says it would have seen is held against that. Of the 180 molecules on 96 × 96 pixels some merge. {how_many(rows)}

{_other_fields(rows)}
{_each_effect(rows)}"""


def how_many(rows: Sequence[Row]) -> str:
    """How many of the planned cases ran, and whether that is all."""
    plan = _plan(rows)
    ran, of = len(rows), sum(plan.values())
    if ran >= of:
        return f"All {ran} cases that were planned ran."
    missing = ", ".join(f"{name} {len(judging.group(rows, name))} of {n}" for name, n in plan.items())
    return f"**{ran} of {of} planned cases ran** ({missing})."


def summary(rows: Sequence[Row]) -> str:
    """What is asked of a simulated trial, and what else was counted."""
    sets = judging.credible_sets(rows)
    size = f"{sum(size for _, size in sets) / len(sets):.2f} names" if sets else "none"
    return (
        f"{_lines(judging.asked(rows), ('asked', 'met'))}\n"
        "Known forms are laws of the catalogue, too (`tests/blind/forms.py`). Intervals: where the form chosen is the\n"
        f"one hidden. A credible set is a name and what the report says it could also be (mean size: {size}).\n\n"
        f"{_lines(judging.beside(rows), ())}"
    )


def _lines(lines: Iterable[Line], more: tuple[str, ...]) -> str:
    table = [["what", "count", "share", "95 % interval", *more]]
    for line in lines:
        cells = [f"{line.hits} / {line.of}", "none ran", ""]
        if line.of:
            low, high = line.interval
            cells[1:] = [f"{100 * line.hits / line.of:.1f} %", f"{100 * low:.1f} … {100 * high:.1f} %"]
        table.append([line.what, *cells, *([line.asked, line.met if line.of else ""] if more else [])])
    return _table(table)


def _groups(rows: Sequence[Row]) -> str:
    table = [["group", "what", "ran", "planned", "processor time, median (largest)"]]
    for name, n in _plan(rows).items():
        ran = judging.group(rows, name)
        table.append([f"`{name}`", GROUPS[name], str(len(ran)), str(n), _time(ran)])
    return _table(table)


def _bases(rows: Sequence[Row]) -> str:
    """How it went on each base: singles, several, nulls."""
    table = [["base", "cases", "visible: exactly right", "three to five: found", "nothing: adequate"]]
    for base in sorted({row["base"] for row in rows}):
        mine = [row for row in rows if row["base"] == base]
        many = judging.group(mine, "several")
        table.append([
            f"`{base}`", str(len(mine)), _ratio(judging.group(mine, "single"), judging.exact),
            f"{sum(len(judging.right(row)) for row in many)} / {sum(len(judging.hidden(row)) for row in many)}",
            _ratio(judging.group(mine, "null"), judging.adequate),
        ])  # fmt: skip
    return _table(table)


def _other_fields(rows: Sequence[Row]) -> str:
    """How it went on each of their bases."""
    table = [[
        "base", "nothing hidden: adequate", "one effect: exactly right", "a wrong name", "nothing named",
        "… within 1.5 × the strength said to be seen", f"error after ≤ {judging.AT_FLOOR} floors", "crashed",
    ]]  # fmt: skip
    for base in APART:
        mine = [row for row in rows if row["base"] == base]
        single = judging.group(mine, "single")
        missed = [row for row in single if not row["chosen"] and not judging.crashed(row)]
        table.append([
            f"`{base}`", _ratio(judging.group(mine, "null"), judging.adequate), _ratio(single, judging.exact),
            _ratio(single, lambda row: bool(judging.wrong(row))), f"{len(missed)} / {len(single)}",
            _ratio(missed, judging.missed_as_said), _ratio(single, judging.at_the_floor), _ratio(mine, judging.crashed),
        ])  # fmt: skip
    return _table(table)


def _each_effect(rows: Sequence[Row]) -> str:
    table = [["hidden", "group", "forms (✶ unseen)", "chosen", "error before → after (floor)"]]
    for group in judging.ALONE:
        cases = defaultdict(list)
        for row in judging.group(rows, group):
            cases[row["effects"][0][0]].append(row)
        for kind in sorted(cases):
            mine = cases[kind]
            seen = Counter(row["forms"][0] + ("" if forms.law(kind, row["forms"][0]) else " ✶") for row in mine)
            chosen = Counter(_names(row["chosen"]) or row["verdict"] for row in mine)
            table.append([kind, group, _counted(seen), _counted(chosen), _errors(mine)])
    return _table(table)


def _each_movie(rows: Sequence[Row]) -> str:
    table = [["group", "base", "found", "missed", "wrong", "beside", "verdict", "error before → after (floor)"]]
    for group in ("several", "several_off", "pair", "off"):
        for row in judging.group(rows, group):
            missed = judging.hidden(row) - judging.right(row)
            table.append([
                group, row["base"], _names(sorted(judging.right(row))), _names(sorted(missed)),
                _names(sorted(judging.wrong(row))), row["off"] or "", row["verdict"], _errors([row]),
            ])  # fmt: skip
    return _table(table)


def _parameters(rows: Sequence[Row]) -> str:
    table = [["parameter", "intervals that cover", "median of (found − true) / sd"]]
    cases = defaultdict(list)
    for pull in judging.pulls(rows):
        if pull.same_form:
            cases[pull.parameter].append(pull)
    for name, mine in sorted(cases.items()):
        inside = sum(pull.inside for pull in mine)
        table.append([f"`{name}`", f"{inside} / {len(mine)}", f"{judging.median_pull(mine):+.2f}"])
    return _table(table)


def _plan(rows: Sequence[Row]) -> dict[str, int]:
    """Cases planned of each group, as the rows tell: the largest plan of each of the trial's seeds; of
    bases that are in no plan, for each of them."""
    told: dict[tuple[int, str], Counter[str]] = defaultdict(Counter)
    for row in rows:
        told[trial_seed(row), row["base"] if row["base"] in APART else ""] |= Counter(row["plan"])
    every = sum(told.values(), Counter[str]())
    return {name: every[name] for name in PLAN if every[name]}


def _ratio(rows: Sequence[Row], test: Callable[[Row], bool]) -> str:
    return f"{sum(test(row) for row in rows)} / {len(rows)}"


def _time(rows: Sequence[Row]) -> str:
    if not rows:
        return ""
    spent = [row["processor_seconds"] for row in rows]
    return f"{median(spent):.0f} s ({max(spent):.0f} s)"


def _errors(rows: Sequence[Row]) -> str:
    known = [row["error"] for row in rows if "error" in row]
    if not known:
        return ""
    before, after, floor = (sum(error[k] for error in known) / len(known) for k in ("before", "after", "floor"))
    return f"{before:.2f} → {after:.2f} ({floor:.2f})"


def _names(kinds: Iterable[str]) -> str:
    return " + ".join(kinds)


def _counted(counter: Counter[str]) -> str:
    return ", ".join(f"{name} {n}" if n > 1 else name for name, n in counter.most_common())


def _table(rows: Sequence[Sequence[str]]) -> str:
    head, *body = rows
    lines = [head, ["---"] * len(head), *body]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)
