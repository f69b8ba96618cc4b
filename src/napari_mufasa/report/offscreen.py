"""Figures drawn in any thread, without a window: what the viewer shows as a picture."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

Draw = Callable[[Any], Any]
# matplotlib's style is global: one figure at a time.
_DRAWING = threading.Lock()


def drawing(name: str, *args: Any, whole: bool = False, **options: Any) -> Draw:
    """A function of `napari_mufasa.report.plots` on these values, for one pair of axes or the whole figure."""

    def draw(figure: Any) -> None:
        from napari_mufasa.report import plots as plotting

        getattr(plotting, name)(figure if whole else figure.subplots(), *args, **options)

    return draw


def with_figure(draw: Draw, size_px: tuple[int, int], dpi: float, background: str, is_dark: bool, *, then: Draw) -> Any:
    """What `then(figure)` gives, of a figure of so many (width, height) of its own pixels that `draw` has drawn."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from napari_mufasa.report import plots as plotting

    width, height = size_px
    with _DRAWING, plotting.style("dark" if is_dark else "light"):
        figure = Figure(figsize=(width / dpi, height / dpi), dpi=dpi, layout="constrained")
        canvas: Any = FigureCanvasAgg
        canvas(figure)
        figure.set_facecolor(background)
        draw(figure)
        for axes in figure.axes:
            axes.set_facecolor(background)
        return then(figure)


def rgba(figure: Any) -> tuple[int, int, bytes]:
    """Columns, rows and pixels (red, green, blue, alpha) of a figure."""
    figure.canvas.draw()
    return (*figure.canvas.get_width_height(), bytes(figure.canvas.buffer_rgba()))
