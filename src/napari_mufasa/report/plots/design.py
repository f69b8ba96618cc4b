"""Figures of predictions: curves over one value, maps over two; the power to see an effect over its strength."""

from __future__ import annotations

from numbers import Real
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_mufasa.report.fields import told
from napari_mufasa.report.plots.parts import empty, legend, sheet, title
from napari_mufasa.report.plots.themes import palette
from napari_mufasa.report.words import effect_title, parameter_label

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import pandas as pd
    from matplotlib.axes import Axes

#: What a plan is judged by, drawn where nothing else is asked for.
JUDGED_BY = (
    "snr_spot", "collected_photons_per_frame", "frames_before_bleaching", "localisation_nm", "on_time_s", "duty_cycle",
)  # fmt: skip
FEW = 6  # values of an axis that are its ticks
WIDE = 20.0  # from which ratio of largest to smallest on an axis is logarithmic


def predictions(
    parent: Any, table: pd.DataFrame, varied: Sequence[str], shown: Sequence[str] = JUDGED_BY,
    targets: Mapping[str, float] | None = None,
) -> None:  # fmt: skip
    """Small multiples of the quantities `shown` of a table by `design.design`, over the one or two values `varied`."""
    there = [name for name in shown if table[name].notna().any()]
    if not there or not 1 <= len(varied) <= 2:
        return empty(parent.add_subplot(), "vary one value or two")
    if any(not (isinstance(value, Real) and value == value) for name in varied for value in table[name]):
        return empty(parent.add_subplot(), "vary numbers: words have no place on an axis")
    axes = sheet(parent, len(there), min(3, len(there)))
    for ax, name in zip(axes, there, strict=True):
        target = (targets or {}).get(name)
        if len(varied) == 1:
            _curve(ax, table, varied[0], name, target)
        else:
            _map(ax, table, varied[0], varied[1], name, target)
        title(ax, told(name))
    return None


def power_curve(parent: Any, table: pd.DataFrame, kind: str) -> None:
    """In what share of movies an effect is seen, and promises most of all, over its strength: rows of `Power`."""
    ax, strength = parent.add_subplot(), str(table.columns[0])
    table = table.sort_values(strength)
    x, seen = table[strength].to_numpy(float), table["power"].to_numpy(float)
    around = [seen - table["power_low"].to_numpy(float), table["power_high"].to_numpy(float) - seen]
    ax.errorbar(x, seen, np.clip(around, 0, None), fmt="o-", ms=4, capsize=3, color=palette().after, label="seen")
    ax.plot(x, table["first"].to_numpy(float), "s--", ms=4, color=palette().measured, label="seen, and first of all")
    if _wide(x):
        ax.set_xscale("log")
    label, unit = parameter_label(kind, strength)
    ax.set_xlabel(f"{label} [{unit}]" if unit else label)
    ax.set_ylabel("share of movies")
    ax.set_ylim(-0.04, 1.04)
    title(ax, effect_title(kind))
    legend(ax)


def _curve(ax: Axes, table: pd.DataFrame, varied: str, name: str, target: float | None) -> None:
    x, y = table[varied].to_numpy(float), table[name].to_numpy(float)
    order = np.argsort(x)
    ax.plot(x[order], y[order], "o-", ms=3, color=palette().after)
    if target is not None:
        ax.axhline(target, ls=":", color=palette().before)
    for values, scale in ((x, ax.set_xscale), (y[np.isfinite(y)], ax.set_yscale)):
        if _wide(values):
            scale("log")
    ax.set_xlabel(told(varied.split(".")[-1]))


def _map(ax: Axes, table: pd.DataFrame, across: str, up: str, name: str, target: float | None) -> None:
    from matplotlib.colors import LogNorm

    grid = table.pivot_table(index=up, columns=across, values=name, dropna=False).astype(float)
    x, y, z = grid.columns.to_numpy(float), grid.index.to_numpy(float), grid.to_numpy()
    norm = LogNorm() if _wide(z[np.isfinite(z)]) else None
    drawn = ax.pcolormesh(_edges(x), _edges(y), np.ma.masked_invalid(z), norm=norm, cmap="viridis")
    ax.figure.colorbar(drawn, ax=ax, shrink=0.85)
    if target is not None and min(z.shape) > 1:
        ax.contour(x, y, np.ma.masked_invalid(z), levels=[target], colors="white")
    for values, scale, axis in ((x, ax.set_xscale, ax.xaxis), (y, ax.set_yscale, ax.yaxis)):
        if _wide(values):
            scale("log")
        elif len(values) <= FEW:  # the edges of their cells, below 0 perhaps, were not asked for
            axis.set_ticks(values)
    ax.set_xlabel(told(across.split(".")[-1]))
    ax.set_ylabel(told(up.split(".")[-1]))


def _edges(values: Any) -> Any:
    """The edges of the cells about values, halfway between them on their axis."""
    if len(values) == 1:
        return np.array([0.9, 1.1]) * values if values[0] else np.array([-0.5, 0.5])
    by, back = (np.log, np.exp) if _wide(values) else (np.asarray, np.asarray)
    at = by(values)
    middle = (at[1:] + at[:-1]) / 2
    return back(np.concatenate([[2 * at[0] - middle[0]], middle, [2 * at[-1] - middle[-1]]]))


def _wide(values: Any) -> bool:
    return len(values) > 1 and values.min() > 0 and values.max() > WIDE * values.min()
