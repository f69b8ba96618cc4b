"""Figures of traces and of their comparison with models."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.report.plots import parts
from napari_mufasa.report.plots.themes import palette

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

    from napari_mufasa.compare.distributions import Distribution


def trace(ax: Axes, photoelectrons: NDArray[Any], title: str = "", interval_s: float | None = None) -> None:
    """One molecule's signal over time."""
    p = palette()
    x = np.arange(len(photoelectrons)) * (interval_s or 1)
    ax.plot(x, photoelectrons, color=p.after, lw=0.9)
    ax.axhline(0, color=p.grid, lw=0.8, zorder=0)
    ax.set_xlim(0, max(float(x[-1]), 1e-9) if len(x) else 1)
    ax.set_xlabel("time (s)" if interval_s else "frame")
    ax.set_ylabel("photoelectrons per frame")
    parts.title(ax, title)


def lit_trace(ax: Axes, photoelectrons: NDArray[Any], lit: NDArray[Any], bleached: int) -> None:
    """One molecule's signal, a bar where it is on, and the frame in which it bleaches (negative: in none)."""
    trace(ax, photoelectrons)
    p, frames, at_the_bottom = palette(), np.arange(len(photoelectrons)), ax.get_xaxis_transform()
    ax.fill_between(frames, 0, 0.025, where=lit, color=p.floor, linewidth=0, transform=at_the_bottom)
    if bleached >= 0:
        ax.axvline(bleached, color=p.bad, linewidth=1, linestyle="--")
    ax.set_xlabel("frame (green: on; dashed: bleached)")


def contact_sheet(
    parent: Figure | SubFigure, traces: NDArray[Any], labels: Sequence[object] | None = None,
    columns: int = 4, most: int = 20,
) -> None:  # fmt: skip
    """Traces (molecule, frame) as small multiples on common axes."""
    p = palette()
    shown = np.asarray(traces)[:most]
    axes = parts.sheet(parent, len(shown), columns, sharex=True, sharey=True)
    for i, (ax, values) in enumerate(zip(axes, shown, strict=False)):
        ax.plot(values, color=p.after, lw=0.7)
        ax.axhline(0, color=p.muted, lw=0.5, zorder=0)
        name = labels[i] if labels is not None else i
        ax.annotate(f"{name}", (0.98, 0.96), xycoords="axes fraction", ha="right", va="top", fontsize=7, color=p.muted)
    more = f" ({len(shown)} of {len(traces)})" if len(traces) > len(shown) else ""
    parent.supxlabel("frame", fontsize=8)
    parent.supylabel("photoelectrons per frame", fontsize=8)
    parent.suptitle(f"Traces{more}", fontsize=9, fontweight="bold", x=0.02, ha="left")


def side_by_side(
    parent: Figure | SubFigure, measured: NDArray[Any], simulated: NDArray[Any], name: str = "this model", most: int = 5
) -> None:
    """Measured traces (molecule, frame) on the left, as many simulated ones on the right, on common axes.

    Those shown are spread over the brightness of each side, brightest first.
    """
    p = palette()
    count = min(most, len(measured), len(simulated))
    axes = parts.sheet(parent, 2 * count, 2, sharex="col", sharey=True)
    for column, (values, colour, label) in enumerate(((measured, p.measured, "measured"), (simulated, p.after, name))):
        order = np.argsort(-np.asarray(values).mean(axis=1), kind="stable")
        chosen = order[np.linspace(0, len(order) - 1, count).astype(int)]
        for ax, i in zip(axes[column::2], chosen, strict=True):
            ax.plot(values[i], color=colour, lw=0.7)
            ax.axhline(0, color=p.muted, lw=0.5, zorder=0)
        if count:
            parts.title(axes[column], label[:1].upper() + label[1:])
    parent.supxlabel("frame", fontsize=8)
    parent.supylabel("photoelectrons per frame", fontsize=8)


def w1_bars(ax: Axes, w1: Mapping[str, Any]) -> None:
    """W1 of each model with the floor that no model can beat."""
    p = palette()
    shown = [(label, float(w1[key])) for key, label in MODELS.items() if w1.get(key) is not None][::-1]
    if not shown:
        return parts.empty(ax, "nothing to compare")
    colours = [p.after if label.startswith("this model") else p.muted for label, _ in shown]
    ax.barh(range(len(shown)), [value for _, value in shown], color=colours, height=0.4)
    parts.rows(ax, [label for label, _ in shown])
    for i, (_, value) in enumerate(shown):
        ax.annotate(f" {value:.3g}", (value, i), va="center", fontsize=7.5)
    if w1.get("floor") is not None:
        ax.axvline(
            float(w1["floor"]), color=p.floor, ls="--", lw=1.2, zorder=0, label=f"floor {float(w1['floor']):.3g}"
        )
    ax.set_xlim(0, max([value for _, value in shown] + [float(w1.get("floor") or 0), 1e-9]) * 1.25)
    ax.set_xlabel(textwrap.fill(f"W1 distance ({w1.get('unit', '')})", parts.fit(ax)))
    parts.title(ax, "Distance to the measurement")
    parts.legend(ax, loc="lower right")


def distribution(ax: Axes, shown: Distribution, w1: Mapping[str, Any] | None = None, legend: bool = True) -> None:
    """One distribution of measured and simulated traces; with `w1`, each model's distance in the legend."""
    p = palette()
    density = shown.y_label == "density"
    for (name, y), colour in zip(_by_model(shown.curves), parts.cycle(), strict=False):
        distance = w1.get(name) if w1 else None
        label = MODELS.get(name, name) + (f", W1 = {distance:.3g}" if isinstance(distance, float) else "")
        if not np.isfinite(y).any():
            continue
        if name == "measured" and density:
            ax.fill_between(shown.x, y, step="mid", color=p.muted, alpha=0.45, lw=0, label=label)
        else:
            width, order = (2.2, 1.9) if name == "measured" else (1.3, 2)
            drawstyle = "steps-mid" if density else "default"
            ax.plot(shown.x, y, color=colour, lw=width, label=label, drawstyle=drawstyle, zorder=order)
    if not ax.has_data():
        parts.empty(ax, f"no {shown.x_label.split(' (')[0]} seen")
        return
    ax.set_xlabel(textwrap.fill(shown.x_label, parts.fit(ax)))
    unit = shown.x_label.partition("(")[2].rstrip(")")
    ax.set_ylabel(f"density (1/{unit})" if density and unit else shown.y_label)
    parts.title(ax, TITLES.get(shown.name) or shown.name.replace("_", " ").capitalize())
    if legend:
        parts.legend(ax)


def distributions(parent: Figure | SubFigure, shown: Sequence[Distribution], columns: int = 2) -> None:
    """Several distributions on one sheet with one legend."""
    axes = parts.sheet(parent, len(shown), columns)
    for ax, each in zip(axes, shown, strict=False):
        distribution(ax, each, legend=False)
    parts.common_legend(parent, axes)


TITLES = {"counts": "Signal per frame", "survival": "Not yet bleached", "levels": "On levels"}
#: Names of the models of a comparison, in figures and tables.
MODELS = {
    "measured": "measured", "mufasa": "this model", "fitted": "this model, fitted", "poisson": "Poisson",
    "sofi": "two-state (SOFI)",
}  # fmt: skip


def _by_model(curves: Mapping[str, NDArray[Any]]) -> list[tuple[str, NDArray[Any]]]:
    """In the order of `MODELS`, so that a model has the same colour in every figure."""
    order = [*MODELS, *curves]
    return sorted(curves.items(), key=lambda item: order.index(item[0]))
