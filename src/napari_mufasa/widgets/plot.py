"""A canvas for the docks: figures of `napari_mufasa.plotting` in napari's theme, saved as picture or as data."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from qtpy.QtCore import QSize, Qt, QTimer
from qtpy.QtWidgets import QFileDialog, QHBoxLayout, QLabel, QSizePolicy, QToolButton, QVBoxLayout, QWidget

if TYPE_CHECKING:
    import pandas as pd
    from napari.viewer import Viewer

MIN_HEIGHT = 210
Draw = Callable[[Any], "pd.DataFrame | None"]


class PlotCanvas(QWidget):
    """One plot. ``draw(function)`` calls ``function(figure)``, which returns the data shown (or None).

    The function is kept, and called again when the theme or the size changes, because texts are wrapped to the size.
    """

    def __init__(self, viewer: Viewer, hint: str = "", height: int = MIN_HEIGHT) -> None:
        super().__init__()
        self._viewer = viewer
        self._draw: Draw | None = None
        self._canvas: Any = None
        self._height = height
        self.data: pd.DataFrame | None = None
        self.hint = QLabel(hint)
        self.hint.setWordWrap(True)
        self.hint.setAlignment(Qt.AlignmentFlag.AlignCenter)
        self.save_button = QToolButton()
        self.save_button.setText("Save …")
        self.save_button.setToolTip("Save the plot (PNG, SVG, PDF) or its data (CSV)")
        self.save_button.clicked.connect(self._ask_and_save)
        self.title = QLabel()
        self.title.setWordWrap(True)
        bar = QHBoxLayout()
        bar.addWidget(self.title, 1)
        bar.addWidget(self.save_button, 0, Qt.AlignmentFlag.AlignTop)
        self._layout = QVBoxLayout(self)
        self._layout.setContentsMargins(0, 0, 0, 0)
        self._layout.setSpacing(2)
        self._layout.addLayout(bar)
        self._layout.addWidget(self.hint, 1)
        # Stacked docks would squash a plot to a sliver.
        self.setMinimumHeight(height)
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Expanding)
        self.save_button.hide()
        self._repaint = QTimer(self)
        self._repaint.setSingleShot(True)
        self._repaint.setInterval(120)
        self._repaint.timeout.connect(self._paint)
        viewer.events.theme.connect(self._on_theme)

    def sizeHint(self) -> QSize:
        return QSize(380, self._height)

    def resizeEvent(self, event: Any) -> None:
        super().resizeEvent(event)
        if self._draw is not None:
            self._repaint.start()

    @property
    def drawn(self) -> bool:
        return self._draw is not None

    def draw(self, function: Draw, title: str = "") -> None:
        self._draw = function
        self.title.setText(title)
        self._paint()

    def clear(self, hint: str | None = None) -> None:
        self._draw, self.data = None, None
        self.title.clear()
        if hint is not None:
            self.hint.setText(hint)
        self.hint.show()
        self.save_button.hide()
        if self._canvas is not None:
            self._canvas.hide()

    def save(self, path: str) -> None:
        """PNG, SVG or PDF picture, or the data as CSV."""
        if Path(path).suffix == ".csv" and self.data is not None:
            from napari_mufasa.io import write_table

            write_table(path, self.data)
        elif self._canvas is not None:
            self._canvas.figure.savefig(path, dpi=200)

    def _paint(self) -> None:
        if self._draw is None:
            return
        from napari.utils.theme import get_theme

        from napari_mufasa import plotting

        theme = get_theme(self._viewer.theme)
        background = theme.background.as_hex()
        is_dark = sum(theme.background.as_rgb_tuple()[:3]) < 3 * 128
        canvas = self._canvas or self._make_canvas()
        self.hint.hide()
        self.save_button.show()
        canvas.show()
        figure = canvas.figure
        with plotting.style("dark" if is_dark else "light"):
            figure.clear()
            self.data = self._draw(figure)
        figure.set_facecolor(background)
        for axes in figure.axes:
            axes.set_facecolor(background)
        canvas.draw_idle()

    def _make_canvas(self) -> Any:
        # Imported at the first plot: matplotlib takes half a second.
        from matplotlib.backends.backend_qtagg import FigureCanvasQTAgg
        from matplotlib.figure import Figure

        canvas: Any = FigureCanvasQTAgg
        self._canvas = canvas(Figure(figsize=(self.width() / 100, self._height / 100), layout="constrained"))
        self._canvas.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Expanding)
        self._canvas.setMinimumHeight(self._height - 50)
        self._layout.addWidget(self._canvas, 1)
        return self._canvas

    def _on_theme(self, _event: Any = None) -> None:
        try:
            self._repaint.start()
        except RuntimeError:  # the panel is gone, the viewer is not
            self._draw = None

    def _ask_and_save(self) -> None:
        path, _ = QFileDialog.getSaveFileName(
            self, "Save plot", "plot.png", filter="Picture (*.png *.svg *.pdf);;Data (*.csv)"
        )
        if path:
            self.save(path)
