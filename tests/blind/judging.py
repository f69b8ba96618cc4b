"""What the rows of a trial say: counts for each line of what is asked, from raw rows alone."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from scipy import stats

from . import forms
from .bases import APART, base_model

Row = dict[str, Any]
AT_FLOOR = 1.25  # floors
SEEN = 1.5  # times the strength that the report says it would have seen
INSIDE = float(stats.norm.isf(0.025))  # of a stated sd
NOT_SURE = 2 / 3  # what the report calls names that take away less of the error which is beyond the floor without them
SIGNLESS = {"log_ratio"}  # its sign goes with the axis, which may be told either way
ALONE = ("single", "faint", "strong")
KNOWN_ONLY = (*ALONE, "pair", "several")  # groups in which all that is hidden is in the catalogue


@dataclass(frozen=True)
class Line:
    """A count, and the bound that is asked for it ("" where none is)."""

    what: str
    hits: int
    of: int
    asked: str = ""

    @property
    def bound(self) -> float:
        """The share that is asked for: "≥ 97 % of ≥ 200" → 0.97."""
        found = re.search(r"([\d.]+) %", self.asked)
        return float(found[1]) / 100 if found else 1.0

    @property
    def met(self) -> str:
        """Is what is `asked` what was counted: "yes" or "no"?"""
        share = self.hits / self.of
        enough = self.of >= int(re.search(r"of ≥ (\d+)|$", self.asked)[1] or 0)
        return "yes" if enough and (share <= self.bound if "≤" in self.asked else share >= self.bound) else "no"

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % interval of the share (Wilson, J. Am. Stat. Assoc. 22, 209, 1927)."""
        found = stats.binomtest(self.hits, self.of).proportion_ci(0.95, "wilson")
        return float(found.low), float(found.high)


def asked(rows: Sequence[Row]) -> list[Line]:
    """The lines of what a simulated trial can answer."""
    known = [row for row in rows if row["group"] == "single" and is_known(row)]
    unseen = [row for row in rows if row["group"] == "single" and not is_known(row)]
    faint, strong, many, off = (group(rows, name) for name in ("faint", "strong", "several", "several_off"))
    missed = [row for row in faint if not right(row)]
    at_floor = [row for row in many if at_the_floor(row)]
    said = [pull for pull in pulls(rows) if pull.same_form]
    sets = credible_sets(rows)
    return [
        *_named("visible, known form", known, ("≥ 97 %", "≥ 95 %", "≥ 95 %")),
        *_named("visible, unseen form", unseen, ("≥ 92 %", "≥ 88 %", "≥ 85 %")),
        *_named("strong", strong, ("≥ 95 %", "≥ 92 %", "≥ 90 %")),
        _count("faint: a wrong name", faint, lambda row: bool(wrong(row)), "≤ 5 %"),
        _count(f"faint: missed, within {SEEN} × the strength said to be seen", missed, missed_as_said, "all"),
        _shares("three to five: effects found", many, right, hidden, "≥ 85 %"),
        _shares("three to five: wrong names of those given", many, wrong, _chosen, "≤ 5 %"),
        _count(f"three to five: error after ≤ {AT_FLOOR} floors", many, at_the_floor, "≥ 80 %"),
        _count(f"three to five: `missing_effect` at ≤ {AT_FLOOR} floors", at_floor, missing_effect, "all"),
        _count("… beside one off the catalogue: `unexplained`", off, unexplained, "≥ 80 %"),
        _shares("… beside one off the catalogue: effects found", off, right, hidden, "≥ 75 %"),
        _count("nothing hidden: `adequate`", group(rows, "null"), adequate, "≥ 97 % of ≥ 200"),
        Line("stated 95 % intervals that cover", sum(pull.inside for pull in said), len(said), "≥ 92 %"),
        Line("credible sets that hold the truth", sum(holds for holds, _ in sets), len(sets), "≥ 95 %"),
    ]  # fmt: skip


def beside(rows: Sequence[Row]) -> list[Line]:
    """Counted, too, but with no bound."""
    near = [row for row in rows if row["group"] == "single" and is_near(row)]
    faint = group(rows, "faint")
    missed = [row for row in faint if not right(row)]
    other = [pull for pull in pulls(rows) if not pull.same_form]
    pairs, off = group(rows, "pair"), group(rows, "several_off")
    return [
        Line("faint: seen", len(faint) - len(missed), len(faint)),
        _count("faint: missed, and the report says no strength", missed, lambda row: not row_says(row)),
        _count("visible, known form with other constants: exactly right", near, exact),
        _count("two at once: exactly both", pairs, exact),
        _count("one off the catalogue alone: `unexplained`", group(rows, "off"), unexplained),
        _shares("… beside one off the catalogue: wrong names of those given", off, wrong, _chosen),
        *_by_share(rows),
        Line("intervals that cover where another form was chosen", sum(pull.inside for pull in other), len(other)),
        _count("diagnoses that crashed", rows, crashed),
    ]  # fmt: skip


def of_planned_bases(rows: Iterable[Row]) -> list[Row]:
    """The rows of movies for whose molecules the generator's strengths are made: where each is lit but once, or
    shortly, or where there are few, a drift of the stage or unequal brightness may show nothing."""
    return [row for row in rows if row["base"] not in APART]


# One movie ----------------------------------------------------------------------------------------------------
def group(rows: Iterable[Row], name: str) -> list[Row]:
    return [row for row in rows if row["group"] == name]


def hidden(row: Row) -> set[str]:
    return {kind for kind, _ in row["effects"]}


def right(row: Row) -> set[str]:
    return hidden(row) & set(row["chosen"])


def wrong(row: Row) -> set[str]:
    return set(row["chosen"]) - hidden(row)


def exact(row: Row) -> bool:
    return set(row["chosen"]) == hidden(row)


def first(row: Row) -> bool:
    return bool(row["ranking"]) and row["ranking"][0] in hidden(row)


def at_the_floor(row: Row) -> bool:
    error = row.get("error")
    return error is not None and bool(error["after"] <= AT_FLOOR * error["floor"])


def adequate(row: Row) -> bool:
    return bool(row["verdict"] == "adequate")


def missing_effect(row: Row) -> bool:
    return bool(row["verdict"] == "missing_effect")


def unexplained(row: Row) -> bool:
    return bool(row["verdict"] == "unexplained")


def crashed(row: Row) -> bool:
    return bool(row["verdict"] == "crash")


def is_known(row: Row) -> bool:
    """Of one effect: is its form a law of the catalogue?"""
    return forms.law(row["effects"][0][0], row["forms"][0]) is not None


def is_near(row: Row) -> bool:
    known = forms.law(row["effects"][0][0], row["forms"][0])
    return known is not None and known.near


def row_says(row: Row) -> bool:
    """Does the report say from which strength on it would have seen the effect, or that it would at none?"""
    return row["effects"][0][0] in row.get("detectable", {})


def missed_as_said(row: Row) -> bool:
    """Was an effect that is missed no stronger than what the report says it would have seen allows?"""
    if not row_says(row):
        return False
    truth = row["truth"][0]
    seen = row["detectable"][truth["kind"]]
    if seen is None:  # at no plausible strength
        return True
    strength = forms.hidden_strength(truth["kind"], truth["form"], truth["parameters"], _believed(row["base"]))
    return strength <= SEEN * abs(seen - forms.NOTHING.get(truth["kind"], 0.0))


# Parameters and sets -----------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Pull:
    """(found − true) / stated sd of a parameter that means the same here and there."""

    parameter: str
    pull: float
    same_form: bool

    @property
    def inside(self) -> bool:
        return abs(self.pull) <= INSIDE


def pulls(rows: Iterable[Row]) -> list[Pull]:
    """Of effects rightly added, known forms, and movies with nothing off the catalogue."""
    found = []
    for row in rows:
        for truth in row["truth"] if row["group"] in KNOWN_ONLY else ():
            kind = truth["kind"]
            law = forms.law(kind, truth["form"])
            if law is None or kind not in row["chosen"]:
                continue
            told = row["found"][kind]
            same = law.form is None or told["parameters"].get("form") == law.form
            for name, meaning in law.means.items():
                if told["sd"].get(name):
                    true = forms.value(meaning, truth["parameters"], _believed(row["base"]))
                    said = abs(told["parameters"][name]) if name in SIGNLESS else told["parameters"][name]
                    found.append(Pull(f"{kind}.{name}", (said - true) / told["sd"][name], same))
    return found


def credible_sets(rows: Iterable[Row]) -> list[tuple[bool, int]]:
    """Of each name given: does it, or what the report says it could also be, hold a hidden effect; how many are they.

    A set is the name, its alternatives, and what cannot be told apart from it.
    """
    found = []
    for row in rows:
        for kind in row["chosen"] if row["group"] in KNOWN_ONLY else ():
            names = {kind, *row["found"][kind]["rivals"]}
            for several in row["alternatives"]:
                names |= set(several) if several[0] == kind else set()
            found.append((bool(names & hidden(row)), len(names)))
    return found


def share_taken(row: Row, kind: str) -> float | None:
    """Of the error beyond the floor without an effect that was added, the share that it takes away, 0 … 1; None where
    the row does not say what the error is without."""
    without, error = row["found"][kind].get("error_without"), row["error"]
    if without is None:
        return None
    return float(np.clip((without - error["after"]) / max(without - error["floor"], 1e-9), 0.0, 1.0))


def median_pull(found: Sequence[Pull]) -> float:
    return float(np.median([each.pull for each in found]))


@cache
def _believed(base: str) -> dict[str, Any]:
    return base_model(base)


# Counting ----------------------------------------------------------------------------------------------------
def _chosen(row: Row) -> set[str]:
    return set(row["chosen"])


def _count(what: str, rows: Sequence[Row], test: Callable[[Row], bool], bound: str = "") -> Line:
    return Line(what, sum(test(row) for row in rows), len(rows), bound)


def _shares(
    what: str, rows: Sequence[Row], part: Callable[[Row], set[str]], whole: Callable[[Row], set[str]], bound: str = ""
) -> Line:
    return Line(what, sum(len(part(row)) for row in rows), sum(len(whole(row)) for row in rows), bound)


def _by_share(rows: Iterable[Row]) -> list[Line]:
    """Are names right that take away much of the error, and those that take away little?"""
    named = [(row, kind) for row in rows for kind in row["chosen"] if row["group"] != "null"]
    shares = [(share_taken(row, kind), kind in hidden(row)) for row, kind in named]
    sure = [is_right for share, is_right in shares if share is not None and share >= NOT_SURE]
    unsure = [is_right for share, is_right in shares if share is not None and share < NOT_SURE]
    what = "of the error beyond the floor without it: right"
    return [
        Line(f"names that take away two thirds and more {what}", sum(sure), len(sure)),
        Line(f"names that take away less {what}", sum(unsure), len(unsure)),
    ]


def _named(what: str, rows: Sequence[Row], bounds: tuple[str, str, str]) -> list[Line]:
    return [
        _count(f"{what}: first", rows, first, bounds[0]),
        _count(f"{what}: exactly right", rows, exact, bounds[1]),
        _count(f"{what}: error after ≤ {AT_FLOOR} floors", rows, at_the_floor, bounds[2]),
    ]
