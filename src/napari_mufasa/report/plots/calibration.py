"""The picture of a calibration: photon transfer, histograms against their laws, neighbours' correlations."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from napari_mufasa.report.plots.parts import legend, title
from napari_mufasa.report.plots.themes import palette

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from napari_mufasa.calibrate.found import Calibration
    from napari_mufasa.calibrate.histogram import Fit


def calibration(parent: Any, found: Calibration) -> None:
    """Photon transfer and correlations above; below the histograms, dark and lit, each with its law."""
    axes = parent.subplots(2, 2)
    _transfer(axes[0, 0], found)
    _rows(axes[0, 1], found)
    for ax, fit in zip(axes[1], [*found.fits, None, None], strict=False):
        _histogram(ax, fit)


def _transfer(ax: Axes, found: Calibration) -> None:
    p = palette()
    signal, variance = found.curve
    ax.plot(signal, variance, "o", ms=3, color=p.measured, label="pixels of like mean")
    if len(signal):
        weights = np.array([1.0, *found.readout.kernel])
        power = np.sum((weights / weights.sum()) ** 2)
        x = np.array([0.0, signal.max()])
        for slope, line in zip((found.slope_adu.value, *found.slope_adu.interval), "-::", strict=True):
            ax.plot(x, x * slope * power, line, color=p.after, lw=1.2)
    ax.set_xlabel("signal (ADU)")
    ax.set_ylabel("variance (ADU²)")
    title(ax, f"{found.adu_per_photoelectron} ADU per photoelectron")
    legend(ax)


def _rows(ax: Axes, found: Calibration) -> None:
    p, readout = palette(), found.readout
    lags = np.arange(1, len(readout.row_correlations) + 1)
    ax.axhspan(-3 * readout.correlations_sd, 3 * readout.correlations_sd, color=p.grid, lw=0)
    ax.plot(lags, readout.row_correlations, "o-", ms=4, color=p.after, label="along rows")
    ax.plot(lags, readout.column_correlations, "s-", ms=3, color=p.muted, label="along columns")
    if readout.dark_row_correlations is not None:
        ax.plot(lags, readout.dark_row_correlations, "^--", ms=4, color=p.before, label="rows, dark")
    ax.set_xticks(lags)
    ax.set_xlabel("distance (px)")
    ax.set_ylabel("correlation of noise")
    title(ax, "Neighbours")
    legend(ax)


def _histogram(ax: Axes, fit: Fit | None) -> None:
    p = palette()
    if fit is None:
        ax.set_axis_off()
        return
    group = len(fit.histogram.edges) // 2
    edges = fit.histogram.edges[group]
    width, middle = np.diff(edges), (edges[1:] + edges[:-1]) / 2
    seen, law = fit.histogram.seen[group][1:-1] / width, fit.expected[group][1:-1] / width
    shown = seen > 0
    ax.plot(middle[shown], seen[shown], "o", ms=2.5, color=p.measured, label="counts")
    ax.plot(middle, law, color=p.after, label="law")
    ax.set_yscale("log")
    if shown.any():
        ax.set_ylim(0.5 * seen[shown].min(), 2 * seen.max())
        ax.set_xlim(edges[0], edges[:-1][shown].max() + width[shown][-1])
    ax.set_xlabel(f"{fit.name}: count − mean (ADU)")
    ax.set_ylabel("counts per ADU")
    title(ax, f"{100 * fit.distance:.2g} % elsewhere, p = {fit.p_value:.2g}")
    legend(ax)
