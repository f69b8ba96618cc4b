"""Themes, palettes and type sizes of all figures; figures and their files."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from contextvars import ContextVar
from dataclasses import dataclass
from io import BytesIO
from typing import TYPE_CHECKING, Any, Literal

from napari_mufasa.provenance import made_by, version

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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


def palette() -> Palette:
    """The colours of the theme that is being drawn in."""
    return _palette.get()


@contextlib.contextmanager
def style(theme: Theme | str = "light") -> Iterator[Palette]:
    """Everything drawn inside has this theme's colours and the project's type sizes."""
    from matplotlib import rc_context

    colours = PALETTES["dark" if theme == "dark" else "light"]
    token = _palette.set(colours)
    try:
        with rc_context(_rc(colours)):  # type: ignore[arg-type,unused-ignore]
            yield colours
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
    made.set_facecolor(palette().background)
    return made


def image_bytes(made: Figure, kind: Literal["png", "svg"] = "png", dpi: int = 150) -> bytes:
    """The figure as a PNG or SVG file."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg(made)
    buffer = BytesIO()
    about = {"Software": f"napari-mufasa {version()}", "Comment": made_by()["command"] or "from Python"}
    made.savefig(buffer, format=kind, dpi=dpi, metadata={"Date": None} if kind == "svg" else about)
    return buffer.getvalue()
