"""What all step panels have in common: a viewer, its session, a run bar, a heading in words."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from qtpy.QtCore import Qt
from qtpy.QtGui import QKeySequence, QShortcut  # type: ignore[attr-defined]
from qtpy.QtWidgets import (
    QFormLayout,
    QHBoxLayout,
    QLabel,
    QSizePolicy,
    QSpinBox,
    QTabWidget,
    QVBoxLayout,
    QWidget,
)

from napari_mufasa.widgets.parts.layers import LayerCombo
from napari_mufasa.widgets.parts.preferences import preference
from napari_mufasa.widgets.turns.jobs import RunBar, Work, guarded
from napari_mufasa.widgets.turns.session import Session, session_of, unwrapped

if TYPE_CHECKING:
    from napari.viewer import Viewer


class MovieChooser(QWidget):
    """Which layers are the movie and its dark frames; one choice for all panels of the viewer."""

    def __init__(self, session: Session, dark: bool = True) -> None:
        super().__init__()
        self.session = session
        viewer = session.viewer
        self.movie = LayerCombo(viewer)
        self.movie.setToolTip("The movie, an Image layer (frame, y, x)")
        self.movie.chosen.connect(session.set_movie)
        form = QFormLayout(self)
        form.setContentsMargins(0, 0, 0, 0)
        form.addRow("Movie", self.movie)
        self.dark: LayerCombo | None = None
        if dark:
            self.dark = LayerCombo(viewer, none_label="none")
            self.dark.setToolTip("Frames without light, recorded with the same camera settings")
            self.dark.chosen.connect(session.set_dark)
            form.addRow("Dark frames", self.dark)
        session.movie_changed.connect(self.refresh)
        if session.movie_layer is None and self.movie.layer() is not None:
            session.set_movie(self.movie.layer())
        self.refresh()

    def refresh(self) -> None:
        if self.session.movie_layer is not None:
            self.movie.choose(self.session.movie_layer)
        if self.dark is not None:
            self.dark.choose(self.session.dark_layer)


class Panel(QWidget):
    """A step: `words` say what it does; `run_bar` runs it in the background."""

    title = ""
    words = ""
    run_label = "Run"

    def __init__(self, viewer: Viewer) -> None:
        super().__init__()
        self.viewer = unwrapped(viewer)
        self.session = session_of(self.viewer)
        self.column = QVBoxLayout(self)
        self.column.setContentsMargins(6, 6, 6, 6)
        self.column.setSpacing(6)
        if self.words:
            label = QLabel(self.words)
            label.setWordWrap(True)
            self.column.addWidget(label)
        self.run_bar = RunBar(self.run_label)
        self.run_bar.clicked.connect(self.run)
        self.run_bar.run_button.setToolTip(f"{self.words} (Ctrl+Return)".strip())
        shortcut(self, "Ctrl+Return", self.run_bar.run_button.click)
        shortcut(self, "Escape", self.run_bar.cancel)
        self.build()

    def build(self) -> None:
        """Fill `column`."""
        raise NotImplementedError(f"{type(self).__name__} has no build()")

    def run(self) -> None:
        """What the Run button does; bad input becomes a notification."""
        guarded(self.run_bar, self.prepare)

    def prepare(self) -> None:
        """Read the settings and start the work with `start`."""
        raise NotImplementedError(f"{type(self).__name__} has no prepare()")

    def start(self, title: str, work: Work, done: Any) -> None:
        self.run_bar.start(title, work, done)


def shortcut(owner: QWidget, keys: str, action: Callable[[], Any]) -> None:
    """A key that works while the keyboard is anywhere within `owner`."""
    made = QShortcut(QKeySequence(keys), owner)
    made.setContext(Qt.ShortcutContext.WidgetWithChildrenShortcut)
    made.activated.connect(action)


class Tabs(QTabWidget):
    """Tabs that take what height there is: their pages' wishes would make the panel scroll."""

    def __init__(self, at_least: int) -> None:
        super().__init__()
        takes_the_rest(self, at_least)

    def hasHeightForWidth(self) -> bool:
        return False


def takes_the_rest(widget: QWidget, at_least: int) -> None:
    """Let a part of a panel have the height that is left, and scroll only below `at_least` pixels."""
    widget.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Ignored)
    widget.setMinimumHeight(at_least)


def seed_row() -> tuple[QSpinBox, QHBoxLayout]:
    """A seed and its label in a row."""
    seed = QSpinBox()
    seed.setRange(0, 2**31 - 1)
    seed.setValue(int(preference("steps.seed")))
    seed.setToolTip("The same seed gives the same answer")
    label = QLabel("Seed")
    label.setBuddy(seed)
    row = QHBoxLayout()
    row.addWidget(label)
    row.addWidget(seed)
    row.addStretch(1)
    return seed, row
