"""Figures of movies and of the molecules in them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.report.plots import parts

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure


def montage(parent: Figure | SubFigure, movie: Any, n: int = 6, unit: str = "ADU", title: str = "") -> None:
    """Frames spread over the movie at one common contrast."""
    count = min(n, movie.shape[0])
    numbers = np.unique(np.linspace(0, movie.shape[0] - 1, count).astype(int))
    frames = np.stack([np.asarray(movie[int(f)], dtype=float) for f in numbers])
    low, high = np.quantile(frames, [0.01, 0.998])
    axes = parts.sheet(parent, len(frames), min(len(frames), 3))
    drawn = None
    for ax, f, frame in zip(axes, numbers, frames, strict=False):
        drawn = parts.draw_image(ax, frame, low, high)
        ax.set_title(f"frame {f}", fontsize=7.5, fontweight="normal")
    if drawn is not None:
        parent.colorbar(drawn, ax=list(axes), shrink=0.8, label=unit)
    if title:
        parent.suptitle(title, fontsize=9, fontweight="bold", x=0.02, ha="left")


def molecules(ax: Axes, picture: NDArray[Any], table: pd.DataFrame, title: str = "Molecules") -> None:
    """Where the molecules are on a (y, x) picture: kept ones, and rejected ones."""
    parts.draw_image(ax, picture, *np.quantile(picture, [0.01, 0.998]))
    kept = table["kept"].to_numpy(bool) if "kept" in table else np.ones(len(table), bool)
    for chosen, colour, label in ((kept, "#5fd7ff", "kept"), (~kept, "#ff8a75", "rejected")):  # both on a dark image
        if chosen.any():
            ax.plot(
                table["x_px"][chosen], table["y_px"][chosen], "o", mfc="none", mec=colour, ms=10, mew=1.1,
                label=f"{label} ({int(chosen.sum())})",
            )  # fmt: skip
    parts.title(ax, title)
    if len(table):
        ax.legend(loc="upper left", bbox_to_anchor=(0, 0), ncols=2)
