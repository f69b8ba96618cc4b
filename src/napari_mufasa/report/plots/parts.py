"""What figures of all kinds are made of: titles, rows, legends, sheets of small multiples."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.report.plots.themes import palette

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure


def cycle() -> tuple[str, ...]:
    p = palette()
    return p.measured, p.after, p.floor, p.before, p.bad


def fit(ax: Axes, columns: int = 1) -> int:
    """About how many characters fit side by side under (or over) the Axes."""
    parent: Any = ax.get_figure(root=False)
    width_in = float(parent.bbox.width) / float(ax.figure.dpi) * ax.get_position().width
    return max(8, int(width_in * 15 / columns))


def fitting_rows(ax: Axes) -> int:
    """How many rows with their names above them fit the height."""
    parent: Any = ax.get_figure(root=False)
    return max(3, int((float(parent.bbox.height) / float(ax.figure.dpi) - 0.9) / 0.27))


def title(ax: Axes, text: str) -> None:
    ax.set_title(textwrap.fill(text, fit(ax)) if text else "")


def legend(ax: Axes, loc: Any = "best") -> None:
    handles, labels = ax.get_legend_handles_labels()
    if handles:
        ax.legend(handles, [textwrap.fill(label, max(24, fit(ax) * 2 // 3)) for label in labels], loc=loc)


def rows(ax: Axes, labels: Sequence[str]) -> None:
    """Names above their bars, inside the Axes, where they fit at any width."""
    p = palette()
    ground = ax.figure.get_facecolor()  # in the viewer it is napari's, not the palette's
    box = {"facecolor": ground, "edgecolor": "none", "alpha": 0.75, "pad": 0.4}
    for y, label in enumerate(labels):
        ax.annotate(
            " " + label, (0, y + 0.24), xycoords=ax.get_yaxis_transform(), va="bottom", fontsize=7.5,
            color=p.text, bbox=box, zorder=1.5,
        )  # fmt: skip
    ax.set_yticks([])
    ax.spines["left"].set_visible(False)
    ax.set_ylim(-0.6, len(labels) - 0.25)


def common_legend(parent: Any, axes: Any) -> None:
    if len(axes):
        handles, labels = max((ax.get_legend_handles_labels() for ax in axes), key=lambda pair: len(pair[1]))
        width_in = parent.bbox.width / parent.figure.dpi
        parent.legend(handles, labels, loc="outside lower center", ncols=max(2, int(width_in / 1.3)))


def empty(ax: Axes, words: str) -> None:
    ax.set_axis_off()
    ax.annotate(words, (0.5, 0.5), xycoords="axes fraction", ha="center", color=palette().muted)


def draw_image(ax: Axes, picture: NDArray[Any], low: float, high: float) -> Any:
    ax.set_xticks([])
    ax.set_yticks([])
    for spine in ax.spines.values():
        spine.set_visible(False)
    return ax.imshow(picture, vmin=low, vmax=high if high > low else low + 1, interpolation="nearest")


def sheet(parent: Figure | SubFigure, count: int, columns: int, **shared: Any) -> Any:
    """`count` Axes in rows of `columns`; the rest of the last row stays empty."""
    if count == 0:
        empty(parent.add_subplot(), "nothing to show")
        return np.array([])
    columns = min(columns, count)
    axes = parent.subplots(-(-count // columns), columns, squeeze=False, **shared).ravel()
    for ax in axes[count:]:
        ax.set_axis_off()
    return axes[:count]
