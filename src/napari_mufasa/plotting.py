"""Every figure of the project: functions that draw on given Axes, in a dark or a light theme.

Used by the reports and by the viewer's widgets, which own their figures:

    with plotting.style("dark"):
        figure = plotting.figure(3.5, 2.5)
        plotting.staircase(figure.add_subplot(), report)

Nothing here computes physics; arrays and reports come in, ink goes out. pyplot is not used, so that no window
system and no global figure is involved.
"""

from __future__ import annotations

import contextlib
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from io import BytesIO
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.wording import effect_title, in_text, number, p_value_text, parameter_label

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

    from napari_mufasa.compare.distributions import Distribution
    from napari_mufasa.discover.result import Candidate, Curve, Report

Theme = Literal["dark", "light"]


@dataclass(frozen=True)
class Palette:
    """Colours by meaning. `before` and `after` also differ in lightness, for readers who do not see hue."""

    background: str
    text: str
    muted: str
    grid: str
    measured: str
    before: str
    after: str
    floor: str
    bad: str


PALETTES: dict[str, Palette] = {
    "light": Palette("#ffffff", "#1d2430", "#7b8494", "#e3e6eb", "#1d2430", "#e07b00", "#0b6fb8", "#2e8b57", "#c0392b"),
    "dark": Palette("#262930", "#e8eaee", "#8b93a1", "#3a3f49", "#f2f3f5", "#ffa94d", "#4fb3ff", "#63d297", "#ff7b72"),
}
_palette: ContextVar[Palette] = ContextVar("palette", default=PALETTES["light"])


@contextlib.contextmanager
def style(theme: Theme | str = "light") -> Iterator[Palette]:
    """Everything drawn inside has this theme's colours and the project's type sizes."""
    from matplotlib import rc_context

    palette = PALETTES["dark" if theme == "dark" else "light"]
    token = _palette.set(palette)
    try:
        with rc_context(_rc(palette)):  # type: ignore[arg-type,unused-ignore]
            yield palette
    finally:
        _palette.reset(token)


def _rc(palette: Palette) -> dict[str, Any]:
    plain = {f"{kind}tick.color": palette.muted for kind in "xy"} | {
        f"{kind}tick.labelcolor": palette.text for kind in "xy"
    }
    return plain | {
        "figure.facecolor": palette.background, "savefig.facecolor": palette.background,
        "axes.facecolor": palette.background, "axes.edgecolor": palette.muted, "axes.labelcolor": palette.text,
        "text.color": palette.text, "axes.titlesize": 9, "axes.titlelocation": "left", "axes.titleweight": "bold",
        "axes.labelsize": 8, "xtick.labelsize": 7.5, "ytick.labelsize": 7.5, "legend.fontsize": 7.5,
        "font.size": 8, "axes.spines.top": False, "axes.spines.right": False, "axes.linewidth": 0.8,
        "legend.frameon": False, "legend.handlelength": 1.6, "lines.linewidth": 1.4,
        "axes.formatter.limits": (-3, 4), "axes.formatter.use_mathtext": True,
        "image.cmap": "magma", "svg.hashsalt": "napari-mufasa",
    }  # fmt: skip


def figure(width_in: float = 6.4, height_in: float = 3.6) -> Figure:
    """An empty figure in the current style whose parts keep clear of each other."""
    from matplotlib.figure import Figure

    made = Figure(figsize=(width_in, height_in), dpi=100, layout="constrained")
    made.set_facecolor(_palette.get().background)
    return made


def image_bytes(made: Figure, kind: Literal["png", "svg"] = "png", dpi: int = 150) -> bytes:
    """The figure as a PNG or SVG file."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg(made)
    buffer = BytesIO()
    made.savefig(buffer, format=kind, dpi=dpi, metadata={"Date": None} if kind == "svg" else None)
    return buffer.getvalue()


# --- a diagnosis -------------------------------------------------------------------------------------------


def staircase(ax: Axes, report: Report) -> None:
    """The held-out error falling step by step to its floor; beside each step, the best wrong effects."""
    p = _palette.get()
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
        at = min(1, len(steps) - 1)
        errors = [float(c.error_after or 0.0) for c in wrong]
        label = "best other effects" if _fit(ax) < 60 else "instead: " + ", ".join(in_text(c.effect) for c in wrong)
        ax.plot([at + 0.22] * len(wrong), errors, "x", color=p.muted, ms=6, label=label)
    floor = report.error.get("floor")
    if floor is not None:
        ax.axhline(floor, color=p.floor, ls="--", lw=1.2, label=f"floor {floor:.2f}: noise alone")
    ax.set_xticks(x, [textwrap.fill(name, _fit(ax, len(steps))) for name in names])
    ax.set_xlim(-0.5, len(steps) - 0.5)
    ax.set_ylim(0, max([*steps, floor or 0.0, *(float(c.error_after or 0) for c in wrong)]) * 1.22)
    ax.set_ylabel("error on held-out data")
    _title(ax, "The error falls to its floor" if report.chosen else "Error and its floor")
    _legend(ax)


def evidence(ax: Axes, ranking: Sequence[Candidate], threshold: float | None = None, top: int = 8) -> None:
    """Bars of evidence per effect; the best and those that cannot be told from it stand out."""
    p = _palette.get()
    shown = list(ranking[: min(top, _fitting_rows(ax))])[::-1]
    if not shown:
        return _empty(ax, "no effect was tried")
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
    _rows(ax, [effect_title(c.effect) for c in shown])
    ax.set_xlim(0, max([*values, threshold or 0.0, 1e-9]) * 1.3)
    if threshold is not None:
        ax.axvline(threshold, color=p.bad, ls="--", lw=1.2, zorder=0, label="needed for an alarm")
    if any(rival):
        ax.barh([0], [0], color=p.before, label="cannot be told from the best")
    ax.set_xlabel("evidence over “nothing missing”")
    _title(ax, "What explains the misfit")
    _legend(ax, loc="lower right")


def curve(ax: Axes, shown: Curve, legend: bool = True) -> None:
    """An observable: measured points against the base model and the completed model, bands of ± 2 sd."""
    p = _palette.get()
    for y, sd, colour, label in (
        (shown.before, shown.before_sd, p.before, "base model"),
        (shown.after, shown.after_sd, p.after, "completed model"),
    ):
        ax.fill_between(shown.x, y - 2 * sd, y + 2 * sd, color=colour, alpha=0.22, lw=0)
        ax.plot(shown.x, y, color=colour, label=label)
    ax.plot(shown.x, shown.measured, "o", ms=3.2, color=p.measured, label="measured", zorder=3)
    ax.set_xlabel(shown.x_label)
    ax.set_ylabel(shown.y_label)
    _title(ax, shown.title)
    if legend:
        _legend(ax)


def curves(parent: Figure | SubFigure, shown: Sequence[Curve], columns: int = 2) -> None:
    """Several observables on one sheet with one legend."""
    axes = _sheet(parent, len(shown), columns)
    for ax, each in zip(axes, shown, strict=False):
        curve(ax, each, legend=False)
    _common_legend(parent, axes)


def z_scores(ax: Axes, observables: pd.DataFrame, top: int = 10) -> None:
    """The observables the base model misses most: their distance in sd before and after."""
    p = _palette.get()
    top = min(top, _fitting_rows(ax))
    order = observables["z_before"].abs().sort_values(ascending=False).index[:top][::-1]
    table = observables.loc[order]
    if table.empty:
        return _empty(ax, "no observables")
    y = np.arange(len(table))
    before, after = table["z_before"].to_numpy(float), table["z_after"].to_numpy(float)
    ax.axvspan(-3, 3, color=p.grid, alpha=0.7, lw=0, label="as expected (± 3 sd)")
    ax.axvline(0, color=p.muted, lw=0.8, zorder=0)
    ax.hlines(y, before, after, color=p.muted, lw=1)
    ax.plot(before, y, "o", color=p.before, ms=5, label="base model")
    ax.plot(after, y, "o", color=p.after, ms=5, label="completed model")
    _rows(ax, [str(title)[:1].upper() + str(title)[1:] for title in table["title"]])
    if np.nanmax(np.abs(before)) > 50:
        ax.set_xscale("symlog", linthresh=5)
    ax.set_xlabel("measured − model (sd)")
    _title(ax, "Where the model fails")
    _common_legend(ax.get_figure(root=False), [ax])


def strengths(parent: Figure | SubFigure, candidate: Candidate) -> None:
    """Each fitted number of an effect with its 95 % interval, on the range of plausible values."""
    p = _palette.get()
    ranges = _ranges(candidate)
    names = list(ranges)
    axes = _sheet(parent, len(names), 1)
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
        _title(ax, f"{label} = {number(value, sd)} {unit}".strip())
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


# --- traces and comparison ---------------------------------------------------------------------------------


def trace(ax: Axes, photoelectrons: NDArray[Any], title: str = "", interval_s: float | None = None) -> None:
    """One molecule's signal over time."""
    p = _palette.get()
    x = np.arange(len(photoelectrons)) * (interval_s or 1)
    ax.plot(x, photoelectrons, color=p.after, lw=0.9)
    ax.axhline(0, color=p.grid, lw=0.8, zorder=0)
    ax.set_xlim(0, max(float(x[-1]), 1e-9) if len(x) else 1)
    ax.set_xlabel("time (s)" if interval_s else "frame")
    ax.set_ylabel("photoelectrons per frame")
    _title(ax, title)


def contact_sheet(
    parent: Figure | SubFigure, traces: NDArray[Any], labels: Sequence[object] | None = None,
    columns: int = 4, most: int = 20,
) -> None:  # fmt: skip
    """Traces (molecule, frame) as small multiples on common axes."""
    p = _palette.get()
    shown = np.asarray(traces)[:most]
    axes = _sheet(parent, len(shown), columns, sharex=True, sharey=True)
    for i, (ax, values) in enumerate(zip(axes, shown, strict=False)):
        ax.plot(values, color=p.after, lw=0.7)
        ax.axhline(0, color=p.muted, lw=0.5, zorder=0)
        name = labels[i] if labels is not None else i
        ax.annotate(f"{name}", (0.98, 0.96), xycoords="axes fraction", ha="right", va="top", fontsize=7, color=p.muted)
    more = f" ({len(shown)} of {len(traces)})" if len(traces) > len(shown) else ""
    parent.supxlabel("frame", fontsize=8)
    parent.supylabel("photoelectrons per frame", fontsize=8)
    parent.suptitle(f"Traces{more}", fontsize=9, fontweight="bold", x=0.02, ha="left")


def w1_bars(ax: Axes, w1: Mapping[str, Any]) -> None:
    """W1 of each model with the floor that no model can beat."""
    p = _palette.get()
    shown = [(label, float(w1[key])) for key, label in _MODELS.items() if w1.get(key) is not None][::-1]
    if not shown:
        return _empty(ax, "nothing to compare")
    colours = [p.after if label.startswith("this model") else p.muted for label, _ in shown]
    ax.barh(range(len(shown)), [value for _, value in shown], color=colours, height=0.4)
    _rows(ax, [label for label, _ in shown])
    for i, (_, value) in enumerate(shown):
        ax.annotate(f" {value:.3g}", (value, i), va="center", fontsize=7.5)
    if w1.get("floor") is not None:
        ax.axvline(
            float(w1["floor"]), color=p.floor, ls="--", lw=1.2, zorder=0, label=f"floor {float(w1['floor']):.3g}"
        )
    ax.set_xlim(0, max([value for _, value in shown] + [float(w1.get("floor") or 0), 1e-9]) * 1.25)
    ax.set_xlabel(textwrap.fill(f"W1 distance ({w1.get('unit', '')})", _fit(ax)))
    _title(ax, "Distance to the measurement")
    _legend(ax, loc="lower right")


def distribution(ax: Axes, shown: Distribution, w1: Mapping[str, Any] | None = None, legend: bool = True) -> None:
    """One distribution of measured and simulated traces; with `w1`, each model's distance in the legend."""
    p = _palette.get()
    density = shown.y_label == "density"
    for (name, y), colour in zip(_by_model(shown.curves), _cycle(), strict=False):
        distance = w1.get(name) if w1 else None
        label = _MODELS.get(name, name) + (f", W1 = {distance:.3g}" if isinstance(distance, float) else "")
        if not np.isfinite(y).any():
            continue
        if name == "measured" and density:
            ax.fill_between(shown.x, y, step="mid", color=p.muted, alpha=0.45, lw=0, label=label)
        else:
            width, order = (2.2, 1.9) if name == "measured" else (1.3, 2)
            drawstyle = "steps-mid" if density else "default"
            ax.plot(shown.x, y, color=colour, lw=width, label=label, drawstyle=drawstyle, zorder=order)
    if not ax.has_data():
        _empty(ax, f"no {shown.x_label.split(' (')[0]} seen")
        return
    ax.set_xlabel(textwrap.fill(shown.x_label, _fit(ax)))
    ax.set_ylabel(shown.y_label)
    _title(ax, shown.name.replace("_", " ").capitalize())
    if legend:
        _legend(ax)


def distributions(parent: Figure | SubFigure, shown: Sequence[Distribution], columns: int = 2) -> None:
    """Several distributions on one sheet with one legend."""
    axes = _sheet(parent, len(shown), columns)
    for ax, each in zip(axes, shown, strict=False):
        distribution(ax, each, legend=False)
    _common_legend(parent, axes)


_MODELS = {
    "measured": "measured", "mufasa": "this model", "fitted": "this model, fitted", "poisson": "Poisson",
    "sofi": "two-state (SOFI)",
}  # fmt: skip


def _by_model(curves: Mapping[str, NDArray[Any]]) -> list[tuple[str, NDArray[Any]]]:
    """In the order of `_MODELS`, so that a model has the same colour in every figure."""
    order = [*_MODELS, *curves]
    return sorted(curves.items(), key=lambda item: order.index(item[0]))


# --- movies ------------------------------------------------------------------------------------------------


def montage(parent: Figure | SubFigure, movie: Any, n: int = 6, unit: str = "ADU", title: str = "") -> None:
    """Frames spread over the movie at one common contrast."""
    count = min(n, movie.shape[0])
    numbers = np.unique(np.linspace(0, movie.shape[0] - 1, count).astype(int))
    frames = np.stack([np.asarray(movie[int(f)], dtype=float) for f in numbers])
    low, high = np.quantile(frames, [0.01, 0.998])
    axes = _sheet(parent, len(frames), min(len(frames), 3))
    drawn = None
    for ax, f, frame in zip(axes, numbers, frames, strict=False):
        drawn = _image(ax, frame, low, high)
        ax.set_title(f"frame {f}", fontsize=7.5, fontweight="normal")
    if drawn is not None:
        parent.colorbar(drawn, ax=list(axes), shrink=0.8, label=unit)
    if title:
        parent.suptitle(title, fontsize=9, fontweight="bold", x=0.02, ha="left")


def molecules(ax: Axes, picture: NDArray[Any], table: pd.DataFrame, title: str = "Molecules") -> None:
    """Where the molecules are on a (y, x) picture: kept ones, and rejected ones."""
    _image(ax, picture, *np.quantile(picture, [0.01, 0.998]))
    kept = table["kept"].to_numpy(bool) if "kept" in table else np.ones(len(table), bool)
    for chosen, colour, label in ((kept, "#5fd7ff", "kept"), (~kept, "#ff8a75", "rejected")):  # both on a dark image
        if chosen.any():
            ax.plot(
                table["x_px"][chosen], table["y_px"][chosen], "o", mfc="none", mec=colour, ms=10, mew=1.1,
                label=f"{label} ({int(chosen.sum())})",
            )  # fmt: skip
    _title(ax, title)
    if len(table):
        ax.legend(loc="upper left", bbox_to_anchor=(0, 0), ncols=2)


# --- helpers -------------------------------------------------------------------------------------


def _cycle() -> tuple[str, ...]:
    p = _palette.get()
    return p.measured, p.after, p.floor, p.before, p.bad


def _fit(ax: Axes, columns: int = 1) -> int:
    """About how many characters fit side by side under (or over) the Axes."""
    parent: Any = ax.get_figure(root=False)
    width_in = float(parent.bbox.width) / float(ax.figure.dpi) * ax.get_position().width
    return max(8, int(width_in * 15 / columns))


def _fitting_rows(ax: Axes) -> int:
    """How many rows with their names above them fit the height."""
    parent: Any = ax.get_figure(root=False)
    return max(3, int((float(parent.bbox.height) / float(ax.figure.dpi) - 0.9) / 0.27))


def _title(ax: Axes, text: str) -> None:
    ax.set_title(textwrap.fill(text, _fit(ax)) if text else "")


def _legend(ax: Axes, loc: Any = "best") -> None:
    handles, labels = ax.get_legend_handles_labels()
    if handles:
        ax.legend(handles, [textwrap.fill(label, max(24, _fit(ax) * 2 // 3)) for label in labels], loc=loc)


def _rows(ax: Axes, labels: Sequence[str]) -> None:
    """Names above their bars, inside the Axes, where they fit at any width."""
    p = _palette.get()
    box = {"facecolor": p.background, "edgecolor": "none", "alpha": 0.75, "pad": 0.4}
    for y, label in enumerate(labels):
        ax.annotate(
            " " + label, (0, y + 0.24), xycoords=ax.get_yaxis_transform(), va="bottom", fontsize=7.5,
            color=p.text, bbox=box, zorder=1.5,
        )  # fmt: skip
    ax.set_yticks([])
    ax.spines["left"].set_visible(False)
    ax.set_ylim(-0.6, len(labels) - 0.25)


def _common_legend(parent: Any, axes: Any) -> None:
    if len(axes):
        handles, labels = max((ax.get_legend_handles_labels() for ax in axes), key=lambda pair: len(pair[1]))
        width_in = parent.bbox.width / parent.figure.dpi
        parent.legend(handles, labels, loc="outside lower center", ncols=max(2, int(width_in / 1.3)))


def _empty(ax: Axes, words: str) -> None:
    ax.set_axis_off()
    ax.annotate(words, (0.5, 0.5), xycoords="axes fraction", ha="center", color=_palette.get().muted)


def _image(ax: Axes, picture: NDArray[Any], low: float, high: float) -> Any:
    ax.set_xticks([])
    ax.set_yticks([])
    for spine in ax.spines.values():
        spine.set_visible(False)
    return ax.imshow(picture, vmin=low, vmax=high if high > low else low + 1, interpolation="nearest")


def _sheet(parent: Figure | SubFigure, count: int, columns: int, **shared: Any) -> Any:
    """`count` Axes in rows of `columns`; the rest of the last row stays empty."""
    if count == 0:
        _empty(parent.add_subplot(), "nothing to show")
        return np.array([])
    columns = min(columns, count)
    axes = parent.subplots(-(-count // columns), columns, squeeze=False, **shared).ravel()
    for ax in axes[count:]:
        ax.set_axis_off()
    return axes[:count]
