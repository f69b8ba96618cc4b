"""What all step panels have in common: a viewer, its session, a form, a run bar, a heading in words."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, ClassVar

from qtpy.QtCore import Qt
from qtpy.QtGui import QKeySequence, QShortcut  # type: ignore[attr-defined]
from qtpy.QtWidgets import QFileDialog, QLabel, QPushButton, QSizePolicy, QTabWidget, QVBoxLayout, QWidget
from superqt import QCollapsible

from napari_mufasa.widgets.turns.jobs import RunBar, Work, guarded
from napari_mufasa.widgets.turns.session import Measurement, measurement_of, session_of, unwrapped
from napari_mufasa.widgets.turns.steering import steered

if TYPE_CHECKING:
    from magicgui.widgets import FunctionGui
    from napari.viewer import Viewer


class Panel(QWidget):
    """A step in a dock: `words` say what it does, `form` holds its function's parameters, `run_bar` runs it.

    Subclasses name the form's factory and say what to do with the results.
    """

    words = ""
    run_label = "Run"
    running = "Running"  # what is said meanwhile
    form_factory: ClassVar[Callable[..., FunctionGui[..., Any]] | None] = None
    hidden: tuple[str, ...] = ("dark_frames",)  # parameters that are set elsewhere
    needs = ""  # "movie", or its "counts": without it the run is refused at once

    def __init__(self, viewer: Viewer) -> None:
        super().__init__()
        self.viewer = unwrapped(viewer)
        self.session = session_of(self.viewer)
        self.column = QVBoxLayout(self)
        self.column.setContentsMargins(6, 6, 6, 6)
        self.column.setSpacing(6)
        if self.words:
            self.column.addWidget(wrapped(self.words))
        self.run_bar = RunBar(self.run_label, parent=self)
        self.run_bar.clicked.connect(self.run)
        self.run_bar.run_button.setToolTip(f"{self.words} (Ctrl+Return)".strip())
        shortcut(self, "Ctrl+Return", self.run_bar.run_button.click)
        shortcut(self, "Escape", self.run_bar.cancel)
        factory = type(self).form_factory
        self.form: Any = None
        if factory is not None:
            self.form = factory(self.viewer, call_button=False)
            for name in self.hidden:
                if name in self.form.asdict():
                    self.form[name].visible = False
        self.build()

    def build(self) -> None:
        """Fill `column`: at least with the form and the run bar."""
        self.add(self.form.native, self.run_bar)
        self.column.addStretch(1)

    def add(self, *widgets: QWidget) -> None:
        for widget in widgets:
            self.column.addWidget(widget)

    def run(self) -> None:
        """What the Run button does; bad input becomes a notification."""
        guarded(self.run_bar, self.prepare)

    def prepare(self) -> None:
        """Check the settings and start the work; the step's function on the form's values, unless it is overridden."""
        if self.needs:
            measurement = self.measurement()
            if self.needs == "counts":
                measurement.recorded()
        self.call(self.running, self.take)

    def take(self, result: Any) -> Any:
        """What is done with the result, in the interface's thread; a generator where there is much to do."""

    def call(self, title: str, done: Any, **changes: Any) -> None:
        """Run the step's function in the background on the form's values."""
        values = self.form.asdict() | changes
        function = self.form.__wrapped__

        def work(progress: Any, cancel: Any) -> Any:
            with steered(progress, cancel):
                return function(**values)

        self.start(title, work, done)

    def measurement(self) -> Measurement:
        """Movie and dark frames of the form; raises `MufasaError` that says what to choose."""
        return measurement_of(*(self.form.asdict().get(name) for name in ("movie", "dark", "dark_frames")))

    def start(self, title: str, work: Work, done: Any) -> None:
        self.run_bar.start(title, work, done)

    def ask_where(self, caption: str, save: Callable[[str], None], name: str = "") -> None:
        """Ask for a file to write, as `name`, or else for a folder, and save there."""
        path = QFileDialog.getSaveFileName(self, caption, name)[0] if name else ""
        path = path if name else QFileDialog.getExistingDirectory(self, caption)
        if path:
            guarded(self.run_bar, lambda: save(path))


class Tabs(QTabWidget):
    """Tabs that take what height there is: their pages' wishes would make the panel scroll."""

    def __init__(self, at_least: int, pages: dict[str, QWidget]) -> None:
        super().__init__()
        takes_the_rest(self, at_least)
        for name, page in pages.items():
            self.addTab(page, name)

    def hasHeightForWidth(self) -> bool:
        return False


def shortcut(owner: QWidget, keys: str, action: Callable[[], Any]) -> None:
    """A key that works while the keyboard is anywhere within `owner`."""
    made = QShortcut(QKeySequence(keys), owner)
    made.setContext(Qt.ShortcutContext.WidgetWithChildrenShortcut)
    made.activated.connect(action)


def takes_the_rest(widget: QWidget, at_least: int) -> None:
    """Let a part of a panel have the height that is left, and scroll only below `at_least` pixels."""
    widget.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Ignored)
    widget.setMinimumHeight(at_least)


def wrapped(text: str = "", error: bool = False) -> QLabel:
    """A line of text that is broken where the dock ends."""
    label = QLabel(text)
    label.setWordWrap(True)
    if error:
        label.setStyleSheet("QLabel { color: #e0605e; }")
    return label


def button(text: str, action: Callable[[], Any], tooltip: str = "", enabled: bool = True) -> QPushButton:
    made = QPushButton(text)
    made.setToolTip(tooltip)
    made.clicked.connect(lambda: action())
    made.setEnabled(enabled)
    return made


def boxed(items: Iterable[QWidget], layout: Any, margins: tuple[int, int, int, int] = (0, 0, 0, 0)) -> QWidget:
    """A widget with others in it, one after the other; the first takes the room of a row."""
    made = QWidget()
    layout.setContentsMargins(*margins)
    for item in items:
        layout.addWidget(item)
    made.setLayout(layout)
    return made


def section(title: str, content: QWidget, is_open: bool = False) -> QCollapsible:
    """A part of a panel that folds away."""
    folding = QCollapsible(title)
    folding.setDuration(0)  # animations make the layout jump
    folding.setCollapsedIcon("▸")
    folding.setExpandedIcon("▾")
    folding.addWidget(content)
    layout: Any = folding.layout()
    layout.setContentsMargins(0, 0, 0, 0)
    if is_open:
        folding.expand(animate=False)
    return folding
