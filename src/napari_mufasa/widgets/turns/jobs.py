"""Long work in the background: real progress, a Cancel that acts at once, errors as notifications with the remedy.

The work runs beside the interface as any thread does. When Python collects its garbage meanwhile, all threads wait: a
full collection of napari's objects takes some 160 ms, and is left to come when it comes.
"""

from __future__ import annotations

import contextlib
import queue
import threading
from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Any

from qtpy.QtCore import Qt, QTimer, Signal  # type: ignore[attr-defined]
from qtpy.QtWidgets import QHBoxLayout, QLabel, QProgressBar, QPushButton, QVBoxLayout, QWidget

from napari_mufasa.errors import Cancelled, MufasaError
from napari_mufasa.widgets.turns.steering import Cancel, Progress

Work = Callable[[Progress, Cancel], Any]
POLL_S = 0.05
TWENTIETHS = 20  # steps of the progress bars: napari draws its own at each
BREATH_MS = 15


@dataclass(frozen=True)
class Outcome:
    """How a run ended: with a value or with an error."""

    value: Any = None
    error: BaseException | None = None


def _steps(work: Work, stop: Cancel) -> Generator[tuple[int, int], None, Outcome]:
    """Run `work` in a thread of its own, yield once per twentieth done, return the outcome.

    The library reports progress by callbacks, napari listens to a generator. The inner thread also lets Cancel act
    at once: the generator leaves, the work notices at its next look at `stop` and throws its result away.
    """
    news: queue.SimpleQueue[tuple[int, int] | Outcome] = queue.SimpleQueue()

    def run() -> None:
        try:
            outcome = Outcome(work(lambda done, total: news.put((done, total)), stop))
        except BaseException as error:  # handed to the interface, which tells the user
            outcome = Outcome(error=error)
        news.put(outcome)

    threading.Thread(target=run, daemon=True, name="mufasa-work").start()
    twentieths = 0
    while not stop():
        try:
            item = news.get(timeout=POLL_S)
        except queue.Empty:
            continue
        if isinstance(item, Outcome):
            return item
        done, total = item
        for _ in range(twentieths, min(TWENTIETHS, int(TWENTIETHS * done / max(total, 1)))):
            twentieths += 1
            yield done, total
    return Outcome(error=Cancelled())


class RunBar(QWidget):
    """A Run button, a Cancel button, progress, and one line about what happened.

    ``start(title, work, done)`` runs ``work(progress, cancel)`` in the background and then calls ``done(result)`` in
    the interface's thread. Where `done` is a generator, the interface breathes at each ``yield``: what it has to do
    (a layer, another layer, a table) is done one thing at a time. ``finished`` is emitted after every run, however it
    ended.
    """

    clicked = Signal()
    finished = Signal()

    def __init__(self, run_label: str, tooltip: str = "", parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.run_button = QPushButton(run_label)
        self.run_button.setToolTip(tooltip)
        self.cancel_button = QPushButton("Cancel")
        self.cancel_button.setToolTip("Stop this run; nothing is kept of it")
        self.bar = QProgressBar()
        self.bar.setTextVisible(False)
        self.bar.setMaximumHeight(6)
        self.message = QLabel()
        self.message.setWordWrap(True)
        self.message.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
        buttons = QHBoxLayout()
        buttons.addWidget(self.run_button, 1)
        buttons.addWidget(self.cancel_button)
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.setSpacing(4)
        layout.addLayout(buttons)
        layout.addWidget(self.bar)
        layout.addWidget(self.message)
        self.run_button.clicked.connect(self.clicked)
        self.cancel_button.clicked.connect(self.cancel)
        self._worker: Any = None
        self._rest: Generator[None, None, None] | None = None  # what `done` still has to do
        self._breath = QTimer(self)
        self._breath.setSingleShot(True)
        self._breath.setInterval(BREATH_MS)
        self._breath.timeout.connect(self._go_on)
        self._done: Callable[[Any], Any] | None = None
        self._outcome: Outcome | None = None
        self._show_running(False)

    @property
    def running(self) -> bool:
        return self._worker is not None or self._rest is not None

    def start(self, title: str, work: Work, done: Callable[[Any], Any]) -> None:
        """Run `work` in the background; ignored while a run is under way."""
        if self.running:
            return
        from napari.qt.threading import create_worker

        box: list[Any] = []
        worker: Any = create_worker(
            _steps, work, lambda: bool(box) and box[0].abort_requested,
            _progress={"total": TWENTIETHS, "desc": title}, _start_thread=False,
        )  # fmt: skip
        box.append(worker)
        self._worker, self._done, self._outcome = worker, done, None
        worker.yielded.connect(self._on_progress)
        worker.returned.connect(self._on_returned)
        worker.finished.connect(self._on_finished)
        # A closed dock must not leave work behind.
        self.destroyed.connect(worker.quit)
        self.say(f"{title} …")
        self._show_running(True)
        worker.start()

    def cancel(self) -> None:
        """Stop the run; the panel is free again within a tenth of a second."""
        if self._worker is not None:
            self._worker.quit()
            self.say("Stopping …")

    def say(self, text: str, error: bool = False) -> None:
        """One line below the buttons."""
        self.message.setText(text)
        self.message.setVisible(bool(text))
        self.message.setStyleSheet("QLabel { color: #e0605e; }" if error else "")

    def _show_running(self, running: bool) -> None:
        self.run_button.setEnabled(not running)
        self.cancel_button.setVisible(running)
        self.bar.setVisible(running)
        if running:
            self.bar.setRange(0, 0)  # busy, until the first news

    def _on_progress(self, news: tuple[int, int]) -> None:
        done, total = news
        self.bar.setRange(0, max(total, 1))
        self.bar.setValue(done)

    def _on_returned(self, outcome: Outcome) -> None:
        self._outcome = outcome

    def _on_finished(self) -> None:
        worker, done, outcome = self._worker, self._done, self._outcome
        self._worker = self._done = self._outcome = None
        with contextlib.suppress(TypeError, RuntimeError):  # already gone with the widget
            self.destroyed.disconnect(worker.quit)
        if outcome is None or isinstance(outcome.error, Cancelled):
            self.say("Cancelled.")
        elif outcome.error is not None:
            self.say(report_error(outcome.error), error=True)
        elif done is not None:
            self.say("")
            self._rest = _in_turns(done, outcome.value)
            self._breath.start()  # napari's own end of a run comes first
            return
        self._end()

    def _go_on(self) -> None:
        """Do the next part of what follows a run."""
        rest = self._rest
        if rest is None:
            return
        going_on = True
        try:
            going_on = next(rest, _END) is not _END
        except MufasaError as error:
            going_on = False
            self.say(report_error(error), error=True)
        except BaseException:
            self._end()
            raise
        if going_on:
            self._breath.start()
        else:
            self._end()

    def _end(self) -> None:
        self._rest = None
        self._show_running(False)
        self.finished.emit()


_END = object()


def _in_turns(done: Callable[[Any], Any], value: Any) -> Generator[None, None, None]:
    """`done` as a generator, which it may be or not."""
    parts = done(value)
    if isinstance(parts, Generator):
        yield from parts


def guarded(run_bar: RunBar, action: Callable[[], Any]) -> None:
    """Do something in the interface's thread; a `MufasaError` becomes a notification and a line in the panel."""
    try:
        action()
    except MufasaError as error:
        run_bar.say(report_error(error), error=True)


def report_error(error: BaseException) -> str:
    """Tell napari's notifications; returns the line for the panel."""
    from napari.utils.notifications import ErrorNotification, notification_manager, show_error

    if isinstance(error, MufasaError):
        show_error(str(error))
        return str(error)
    notification_manager.dispatch(ErrorNotification(error))
    return f"Unexpected {type(error).__name__}: {error}. The notification has the details to report."
