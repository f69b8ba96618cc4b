"""Figures of a diagnosis: errors, evidence, curves, z-scores, strengths."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from napari_mufasa.report.plots import parts
from napari_mufasa.report.plots.themes import palette
from napari_mufasa.report.words import effect_title, in_text, number, p_value_text, parameter_label

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

    from napari_mufasa.discover.result import Candidate, Curve, Report

SLANTING = 20  # characters a line of names that slant


def staircase(ax: Axes, report: Report) -> None:
    """The held-out error falling step by step to its floor; beside it the best effects that were not added, instead of
    the first one or, where the model as it stands was asked what it lacks, on top of the last."""
    p = palette()
    steps = [float(step["error"]) for step in report.history]
    names = ["base model", *("+ " + effect_title(str(step.get("added", ""))) for step in report.history[1:])]
    x = np.arange(len(steps))
    ax.step(np.append(x - 0.5, x[-1] + 0.5), [*steps, steps[-1]], where="post", color=p.after, lw=1.2, alpha=0.6)
    ax.plot(x, steps, "o", color=p.after, ms=7, zorder=3)
    ax.plot(0, steps[0], "o", color=p.before, ms=7, zorder=4)
    for xi, error in zip(x, steps, strict=True):
        ax.annotate(f"{error:.2f}", (xi, error), (0, 7), textcoords="offset points", ha="center", va="bottom")
    wrong = [c for c in report.ranking if c.effect not in report.chosen and c.error_after is not None][:3]
    if wrong:
        on_top = bool(report.chosen) and not any(c.effect in report.chosen for c in report.ranking)
        at = len(steps) - 1 if on_top else min(1, len(steps) - 1)
        errors = [float(c.error_after or 0.0) for c in wrong]
        names_of_them = ", ".join(in_text(c.effect) for c in wrong)
        long, short = ("on top of it", "best further effects") if on_top else ("instead", "best other effects")
        label = short if parts.fit(ax) < 60 else f"{long}: {names_of_them}"
        ax.plot([at + 0.22] * len(wrong), errors, "x", color=p.muted, ms=6, label=label)
    floor = report.error.get("floor")
    if floor is not None:
        ax.axhline(floor, color=p.floor, ls="--", lw=1.2, label=f"floor {floor:.2f}: noise alone")
    wide = parts.fit(ax, len(steps))
    if max(len(word) for name in names for word in name.split()) <= wide:
        ax.set_xticks(x, [textwrap.fill(name, wide) for name in names])
    else:  # words would be broken
        slanting = [textwrap.fill(name, SLANTING) for name in names]
        ax.set_xticks(x, slanting, rotation=35, ha="right", rotation_mode="anchor")
    ax.set_xlim(-0.5, len(steps) - 0.5)
    ax.set_ylim(0, max([*steps, floor or 0.0, *(float(c.error_after or 0) for c in wrong)]) * 1.22)
    ax.set_ylabel("error on held-out data")
    parts.title(ax, _course(steps, floor))
    parts.legend(ax)


def _course(errors: Sequence[float], floor: float | None) -> str:
    """What the error did, in words."""
    if len(errors) < 2:
        return "Error and its floor"
    if errors[-1] >= errors[0]:
        return "The error does not fall"
    return "The error falls to its floor" if floor is not None and errors[-1] < 1.25 * floor else "The error falls"


def evidence(ax: Axes, ranking: Sequence[Candidate], threshold: float | None = None, top: int = 8) -> None:
    """Bars of evidence per effect; the best and those that cannot be told from it stand out."""
    p = palette()
    shown = list(ranking[: min(top, parts.fitting_rows(ax))])[::-1]
    if not shown:
        return parts.empty(ax, "no effect was tried")
    best = ranking[0]
    alike = {best.effect, *best.indistinguishable_from}
    rival = [c.effect in alike and c is not best for c in shown]
    colours = [p.after if c is best else p.before if r else p.muted for c, r in zip(shown, rival, strict=True)]
    values = [max(float(c.evidence), 0.0) for c in shown]
    ax.axvline(0, color=p.muted, lw=0.8)
    bars = ax.barh(range(len(shown)), values, color=colours, height=0.4)
    for bar, candidate in zip(bars, shown, strict=True):
        ax.annotate(
            f" {p_value_text(candidate.p_value)}", (bar.get_width(), bar.get_y() + bar.get_height() / 2),
            va="center", fontsize=7, color=p.text,
        )  # fmt: skip
    parts.rows(ax, [effect_title(c.effect) for c in shown])
    ax.set_xlim(0, max([*values, threshold or 0.0, 1e-9]) * 1.3)
    if threshold is not None:
        ax.axvline(threshold, color=p.bad, ls="--", lw=1.2, zorder=0, label="needed for an alarm")
    if any(rival):
        ax.barh([0], [0], color=p.before, label="cannot be told from the best")
    ax.set_xlabel("evidence over “nothing missing”")
    parts.title(ax, "What explains the misfit")
    parts.legend(ax, loc="lower right")


def curve(ax: Axes, shown: Curve, legend: bool = True) -> None:
    """An observable: measured points against the base model and the completed model, bands of ± 2 sd."""
    p = palette()
    for y, sd, colour, label in (
        (shown.before, shown.before_sd, p.before, "base model"),
        (shown.after, shown.after_sd, p.after, "completed model"),
    ):
        ax.fill_between(shown.x, y - 2 * sd, y + 2 * sd, color=colour, alpha=0.22, lw=0)
        ax.plot(shown.x, y, color=colour, label=label)
    ax.plot(shown.x, shown.measured, "o", ms=3.2, color=p.measured, label="measured", zorder=3)
    ax.set_xlabel(shown.x_label)
    ax.set_ylabel(shown.y_label)
    parts.title(ax, shown.title)
    if legend:
        parts.legend(ax)


def curves(parent: Figure | SubFigure, shown: Sequence[Curve], columns: int = 2) -> None:
    """Several observables on one sheet with one legend."""
    axes = parts.sheet(parent, len(shown), columns)
    for ax, each in zip(axes, shown, strict=False):
        curve(ax, each, legend=False)
    parts.common_legend(parent, axes)


def z_scores(ax: Axes, observables: pd.DataFrame, top: int = 10, also: str = "") -> None:
    """The observables the base model misses most, and in any case `also`: their distance in sd before and after."""
    p = palette()
    top = min(top, parts.fitting_rows(ax))
    order = list(observables["z_before"].abs().sort_values(ascending=False).index)
    asked = [row for row in order[top:] if observables.loc[row, "observable"] == also]
    table = observables.loc[[*order[: top - len(asked)], *asked][::-1]]
    if table.empty:
        return parts.empty(ax, "no observables")
    y = np.arange(len(table))
    before, after = table["z_before"].to_numpy(float), table["z_after"].to_numpy(float)
    ax.axvspan(-3, 3, color=p.muted, alpha=0.22, lw=0, label="as expected (± 3 sd)")
    ax.axvline(0, color=p.muted, lw=0.8, zorder=0)
    ax.plot(before, y, "o", color=p.before, ms=5, label="base model")
    if not np.array_equal(before, after):  # nothing was added yet: one model only
        ax.hlines(y, before, after, color=p.muted, lw=1, zorder=1)
        ax.plot(after, y, "o", color=p.after, ms=5, label="completed model")
    parts.rows(ax, [str(title)[:1].upper() + str(title)[1:] for title in table["title"]])
    if np.nanmax(np.abs(before)) > 50:
        ax.set_xscale("symlog", linthresh=5)
    ax.set_xlabel("measured − model (sd)")
    parts.title(ax, "Where the model fails")
    parts.common_legend(ax.get_figure(root=False), [ax])


def strengths(parent: Figure | SubFigure, candidate: Candidate) -> None:
    """Each fitted number of an effect with its 95 % interval, on the range of plausible values."""
    p = palette()
    ranges = _ranges(candidate)
    names = list(ranges)
    axes = parts.sheet(parent, len(names), 1)
    for ax, name in zip(axes, names, strict=True):
        low, high, log = ranges[name]
        value, sd = float(candidate.parameters[name]), candidate.parameters_sd.get(name)
        log = log and value > 0
        reach = 1.96 * sd if sd is not None and np.isfinite(sd) else 0.0
        ends = [max(value - reach, min(low, value) / 2) if log else value - reach, value + reach]
        ax.axvspan(low, high, color=p.grid, alpha=0.7, lw=0)
        ax.plot(ends, [0, 0], color=p.after, lw=3, solid_capstyle="round")
        ax.plot([value], [0], "o", color=p.after, ms=7)
        if log:
            ax.set_xscale("log")
        ax.set_ylim(-1, 1)
        ax.set_yticks([])
        ax.spines["left"].set_visible(False)
        label, unit = parameter_label(candidate.effect, name)
        parts.title(ax, f"{label} = {number(value, sd)} {unit}".strip())
    if len(axes):
        axes[-1].set_xlabel("grey: plausible range · bar: 95 % interval")


def count_strengths(candidate: Candidate) -> int:
    """How many numbers `strengths` has to draw."""
    return len(_ranges(candidate))


def _ranges(candidate: Candidate) -> dict[str, tuple[float, float, bool]]:
    """Plausible range of every number found, by name; empty for an effect that is not installed."""
    from napari_mufasa.effects import catalogue

    effect = catalogue().get(candidate.effect)
    found = effect.plausible() if effect is not None else {}
    return {name: found[name] for name, value in candidate.parameters.items() if name in found and value is not None}
