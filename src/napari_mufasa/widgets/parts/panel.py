"""What all step panels have in common: a viewer, its session, a form, a run bar, a heading in words."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from html import escape
from pathlib import Path
from typing import Any, ClassVar

from magicgui.widgets import FunctionGui
from napari.layers import Layer
from napari.viewer import Viewer
from qtpy.QtWidgets import QFileDialog, QMessageBox, QPushButton, QVBoxLayout, QWidget

from napari_mufasa.widgets.parts.forms import shared
from napari_mufasa.widgets.parts.pieces import Words, button, shortcut
from napari_mufasa.widgets.turns.jobs import RunBar, errors_reported
from napari_mufasa.widgets.turns.session import session_of, unwrapped


class Panel(QWidget):
    """A step in a dock: `words` say what it does, `form` holds its function's parameters, `run_bar` runs it.

    Subclasses name the form's factory, fill the panel in `build`, and say in `take` what to do with the results.
    """

    words = ""
    run_label = "Run"
    running = "Running"  # what is said meanwhile
    form_factory: ClassVar[Callable[..., FunctionGui[..., Any]] | None] = None
    hidden: tuple[str, ...] = ("dark_frames",)  # parameters that are set elsewhere
    needs_counts = False  # a movie as the camera recorded it: without it the run is refused at once

    def __init__(self, viewer: Viewer) -> None:
        super().__init__()
        self.viewer = unwrapped(viewer)
        self.session = session_of(self.viewer)
        self.column = QVBoxLayout(self)
        self.column.setContentsMargins(6, 6, 6, 6)
        self.column.setSpacing(6)
        if self.words:
            self.add(Words(self.words))
        self.run_bar = RunBar(self.run_label, f"{self.words} (Ctrl+Return)".strip(), parent=self)
        self.run_bar.clicked.connect(lambda: self.guarded(self.prepare))
        shortcut(self, "Ctrl+Return", self.run_bar.run_button.click)
        shortcut(self, "Escape", self.run_bar.cancel)
        factory = type(self).form_factory
        self.form: Any = shared(factory(call_button=False), self.viewer) if factory is not None else None
        for name in self.hidden:
            if self.form is not None and name in self.form.asdict():
                self.form[name].visible = False
        self.build()

    def build(self) -> None:
        """Fill the panel: at least with the form and the run bar."""
        # Not abstract: Qt's metaclass leaves no room for that of ABC.
        raise NotImplementedError(f"{type(self).__name__} has no build()")

    def add(self, *widgets: QWidget, last: QWidget | None = None) -> None:
        """Put widgets below what there is; `last` takes the height that is left."""
        for widget in widgets:
            self.column.addWidget(widget)
        if last is not None:
            self.column.addWidget(last, 1)

    def prepare(self) -> None:
        """Check the settings and start the work; the step's function on the form's values, unless it is overridden."""
        if self.needs_counts:
            self.session.measurement().recorded()
        self.call(self.running, self.take)

    def take(self, result: Any) -> Any:
        """What is done with the result, in the interface's thread; a generator where there is much to do."""

    def call(self, title: str, done: Any, **changes: Any) -> None:
        """Run the step's function in the background on the form's values."""
        values, function = self.form.asdict() | changes, self.form.__wrapped__
        self.run_bar.start(title, lambda: function(**values), done)

    def whose(self, movie: Layer | None, name: str) -> str:
        """The words before a result of a movie of this name where another one is chosen, as HTML."""
        return "" if movie is self.session.movie_layer else f"Found on {escape(name)}, not on the movie chosen:<br>"

    def guarded(self, action: Callable[[], Any]) -> None:
        """Do something at once; what is refused becomes a notification and a line in the panel."""
        with errors_reported(partial(self.run_bar.say, error=True)):
            action()

    def saver(
        self, text: str, caption: str, save: Callable[[str], str], name: str = "",
        files: Callable[[], Sequence[str]] = tuple,
    ) -> QPushButton:  # fmt: skip
        """A button, for when there are results, that asks for a file to write, as `name`, or else a folder in which
        ``files()`` will be written; ``save(path)`` says what it wrote."""

        def ask() -> None:
            ask_for_file, ask_for_folder = QFileDialog.getSaveFileName, QFileDialog.getExistingDirectory
            path = ask_for_file(self, caption, name)[0] if name else ask_for_folder(self, caption)
            if path and self._may_replace(path, files()):
                self.guarded(lambda: self.run_bar.say(f"Written: {save(path)}"))

        return button(text, ask, enabled=False)

    def _may_replace(self, folder: str, names: Sequence[str]) -> bool:
        """Whether nothing of these names stands in a folder, or the user wants it replaced."""
        there = [name for name in names if (Path(folder) / name).exists()]
        if not there:
            return True
        question, answers = f"{folder} already holds {', '.join(there)}. Replace?", QMessageBox.StandardButton
        answer = QMessageBox.question(self, "Replace files", question, answers.Yes | answers.No, answers.No)
        return answer == answers.Yes
