"""A canvas for the docks: figures of `napari_mufasa.report.plots` in napari's theme, saved as picture or as data.

matplotlib takes a tenth of a second or more for a figure. It draws in a thread; the interface only shows the picture.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from napari.viewer import Viewer
from qtpy.QtCore import QSize, Qt
from qtpy.QtGui import QImage, QPixmap
from qtpy.QtWidgets import QFileDialog, QLabel, QSizePolicy, QToolButton, QWidget

from napari_mufasa.report.offscreen import Draw, rgba, with_figure
from napari_mufasa.widgets.parts.pieces import column, made, row
from napari_mufasa.widgets.turns.jobs import WhenSeen, in_thread, report_error

if TYPE_CHECKING:
    import pandas as pd

MIN_HEIGHT = 210
DPI = 100


class PlotCanvas(QWidget):
    """One plot. ``draw(function, data)`` calls ``function(figure)`` in a thread; `data` is the table that it shows.

    The function is kept, and called again when the theme or the size changes, because texts are wrapped to the size.
    Until the next picture comes, the last one is scaled to the room there is. A plot that is not to be seen is not
    drawn until it is.
    """

    def __init__(self, viewer: Viewer, hint: str = "", height: int = MIN_HEIGHT) -> None:
        super().__init__()
        self._viewer = viewer
        self._draw: Draw | None = None
        self.data: pd.DataFrame | None = None
        self.title = made(QLabel, wordWrap=True)
        tip = "Save the plot (PNG, SVG, PDF) or its data (CSV)"
        self.save_button = made(QToolButton, text="Save …", toolTip=tip, clicked=self._ask_and_save, visible=False)
        self.picture = made(  # or the hint, while there is none
            QLabel, hint, wordWrap=True, scaledContents=True, minimumHeight=height - 50,
            alignment=Qt.AlignmentFlag.AlignCenter,
        )  # fmt: skip
        self.picture.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Ignored)
        column(self, row(self.title, self.save_button, shares=(1,)), self.picture, shares=(0, 1)).setSpacing(2)
        # Stacked docks would squash a plot to a sliver.
        self.setMinimumHeight(height)
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Expanding)
        self._latest = WhenSeen(60, self, self._rendering, self)
        self._latest.arrived.connect(self._on_drawn)
        viewer.events.theme.connect(self._on_theme)

    def sizeHint(self) -> QSize:
        return QSize(380, self.minimumHeight())

    def resizeEvent(self, event: Any) -> None:
        super().resizeEvent(event)
        self._latest.renew()

    @property
    def drawn(self) -> bool:
        """Whether there is something to show, drawn already or not yet."""
        return self._draw is not None

    @property
    def busy(self) -> bool:
        return self._latest.busy

    def draw(self, function: Draw, data: pd.DataFrame | None = None, title: str = "") -> None:
        if self._draw is None:
            self.picture.clear()
        self._draw, self.data = function, data
        self.title.setText(title)
        self.save_button.show()
        self._latest.renew()

    def clear(self, hint: str) -> None:
        """Show a hint instead of a plot."""
        self._draw, self.data = None, None
        self._latest.drop()
        self.title.clear()
        self.picture.setText(hint)
        self.save_button.hide()

    def save(self, path: str) -> None:
        """PNG, SVG or PDF picture, or the data as CSV."""
        if Path(path).suffix == ".csv" and self.data is not None:
            from napari_mufasa.files.whole import write_table

            write_table(path, self.data)
        elif self._draw is not None:
            width, height, _ = self._size()
            with_figure(self._draw, (width, height), DPI, *self._theme(), then=lambda f: f.savefig(path, dpi=2 * DPI))

    def _rendering(self) -> Any:
        if self._draw is None:
            return None
        function, size, theme = self._draw, self._size(), self._theme()
        return lambda _cancel: _render(function, size, theme)

    def _size(self) -> tuple[int, int, float]:
        """Width and height in pixels of the screen, and how many of them are one of Qt's."""
        layout: Any = self.layout()
        layout.activate()  # a new title may have taken room
        ratio, room = float(self.devicePixelRatioF()), self.picture.contentsRect()
        width, height = max(room.width(), 200), max(room.height(), 100)
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
            self.picture.setPixmap(QPixmap.fromImage(outcome.value))

    def _on_theme(self, _event: Any = None) -> None:
        try:
            self._latest.renew()
        except RuntimeError:  # the panel is gone, the viewer is not
            self._draw = None

    def _ask_and_save(self) -> None:
        path, _ = QFileDialog.getSaveFileName(
            self, "Save plot", "plot.png", filter="Picture (*.png *.svg *.pdf);;Data (*.csv)"
        )
        if path:
            in_thread("mufasa-save", lambda: self.save(path), lambda how: how.error and report_error(how.error))


def _render(function: Draw, size: tuple[int, int, float], theme: tuple[str, bool]) -> QImage:
    width, height, ratio = size
    columns, rows, pixels = with_figure(function, (width, height), DPI * ratio, *theme, then=rgba)
    return QImage(pixels, columns, rows, QImage.Format.Format_RGBA8888).copy()  # Qt does not keep the bytes
