"""A canvas for the docks: figures of `napari_mufasa.report.plots` in napari's theme, saved as picture or as data.

matplotlib takes a tenth of a second or more for a figure. It draws in a thread; the interface only shows the picture.
"""

from __future__ import annotations

import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

from qtpy.QtCore import QSize, Qt
from qtpy.QtGui import QImage, QPainter
from qtpy.QtWidgets import QFileDialog, QHBoxLayout, QLabel, QSizePolicy, QToolButton, QVBoxLayout, QWidget

from napari_mufasa.report.offscreen import Draw, rgba, with_figure
from napari_mufasa.widgets.turns.latest import Latest

if TYPE_CHECKING:
    import pandas as pd
    from napari.viewer import Viewer

MIN_HEIGHT = 210
DPI = 100


class Picture(QWidget):
    """The last picture drawn, scaled to the room there is until the next one comes."""

    def __init__(self) -> None:
        super().__init__()
        self.image: QImage | None = None
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Expanding)

    def paintEvent(self, _event: Any) -> None:
        if self.image is not None:
            painter = QPainter(self)
            painter.setRenderHint(QPainter.RenderHint.SmoothPixmapTransform)
            painter.drawImage(self.rect(), self.image)
            painter.end()


class PlotCanvas(QWidget):
    """One plot. ``draw(function, data)`` calls ``function(figure)`` in a thread; `data` is the table that it shows.

    The function is kept, and called again when the theme or the size changes, because texts are wrapped to the size.
    A plot that is not to be seen is not drawn until it is.
    """

    def __init__(self, viewer: Viewer, hint: str = "", height: int = MIN_HEIGHT) -> None:
        super().__init__()
        self._viewer = viewer
        self._draw: Draw | None = None
        self._height = height
        self._stale = False
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
        self.picture = Picture()
        self.picture.setMinimumHeight(height - 50)
        self.picture.hide()
        bar = QHBoxLayout()
        bar.addWidget(self.title, 1)
        bar.addWidget(self.save_button, 0, Qt.AlignmentFlag.AlignTop)
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.setSpacing(2)
        layout.addLayout(bar)
        layout.addWidget(self.hint, 1)
        layout.addWidget(self.picture, 1)
        # Stacked docks would squash a plot to a sliver.
        self.setMinimumHeight(height)
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Expanding)
        self.save_button.hide()
        self._latest = Latest(60, self)
        self._latest.arrived.connect(self._on_drawn)
        viewer.events.theme.connect(self._on_theme)

    def sizeHint(self) -> QSize:
        return QSize(380, self._height)

    def resizeEvent(self, event: Any) -> None:
        super().resizeEvent(event)
        self._paint()

    def showEvent(self, event: Any) -> None:
        super().showEvent(event)
        if self._stale:
            self._paint()

    @property
    def drawn(self) -> bool:
        """Whether there is something to show, drawn already or not yet."""
        return self._draw is not None

    @property
    def busy(self) -> bool:
        return self._latest.busy

    def draw(self, function: Draw, data: pd.DataFrame | None = None, title: str = "") -> None:
        self._draw, self.data = function, data
        self.title.setText(title)
        self.hint.hide()
        self.save_button.show()
        self.picture.show()
        self._paint()

    def clear(self, hint: str | None = None) -> None:
        self._draw, self.data, self.picture.image = None, None, None
        self._latest.drop()
        self.title.clear()
        if hint is not None:
            self.hint.setText(hint)
        self.hint.show()
        self.save_button.hide()
        self.picture.hide()

    def save(self, path: str) -> None:
        """PNG, SVG or PDF picture, or the data as CSV."""
        if Path(path).suffix == ".csv" and self.data is not None:
            from napari_mufasa.files.whole import write_table

            write_table(path, self.data)
        elif self._draw is not None:
            width, height, _ = self._size()
            with_figure(self._draw, (width, height), DPI, *self._theme(), then=lambda f: f.savefig(path, dpi=2 * DPI))

    def _paint(self) -> None:
        if self._draw is None:
            return
        self._stale = not self.isVisible()
        if self._stale:
            return
        function, size, theme = self._draw, self._size(), self._theme()
        self._latest.request(lambda _cancel: _render(function, size, theme))

    def _size(self) -> tuple[int, int, float]:
        """Width and height in pixels of the screen, and how many of them are one of Qt's."""
        ratio = float(self.devicePixelRatioF())
        width, height = max(self.picture.width(), 200), max(self.picture.height(), self._height - 50)
        return round(width * ratio), round(height * ratio), ratio

    def _theme(self) -> tuple[str, bool]:
        from napari.utils.theme import get_theme

        theme = get_theme(self._viewer.theme)
        return theme.background.as_hex(), sum(theme.background.as_rgb_tuple()[:3]) < 3 * 128

    def _on_drawn(self, outcome: Any) -> None:
        if outcome.error is not None:
            self.clear(f"The plot failed: {outcome.error}")
            return
        if self._draw is not None:
            self.picture.image = outcome.value
            self.picture.update()

    def _on_theme(self, _event: Any = None) -> None:
        try:
            self._paint()
        except RuntimeError:  # the panel is gone, the viewer is not
            self._draw = None

    def _ask_and_save(self) -> None:
        path, _ = QFileDialog.getSaveFileName(
            self, "Save plot", "plot.png", filter="Picture (*.png *.svg *.pdf);;Data (*.csv)"
        )
        if path:
            threading.Thread(target=self.save, args=(path,), daemon=True, name="mufasa-save").start()


def _render(function: Draw, size: tuple[int, int, float], theme: tuple[str, bool]) -> QImage:
    width, height, ratio = size
    columns, rows, pixels = with_figure(function, (width, height), DPI * ratio, *theme, then=rgba)
    return QImage(pixels, columns, rows, QImage.Format.Format_RGBA8888).copy()  # Qt does not keep the bytes
