"""Long work in the background: real progress, a Cancel that acts at once, errors as notifications with the remedy.

The work runs beside the interface as any thread does. When Python collects its garbage meanwhile, all threads wait: a
full collection of napari's objects takes some 160 ms, and is left to come when it comes.
"""

from __future__ import annotations

import contextlib
import queue
import threading
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

from qtpy.QtCore import QEvent, QObject, Qt, Signal  # type: ignore[attr-defined]
from qtpy.QtWidgets import QProgressBar, QPushButton, QWidget

from napari_mufasa.errors import Cancelled, MufasaError, system_line
from napari_mufasa.widgets.parts.pieces import Words, button, column, made, row, timer
from napari_mufasa.widgets.turns.steering import Cancel, steered

Work = Callable[[], Any]
Asked = Callable[[Cancel], Any]
POLL_S = 0.05
TWENTIETHS = 20  # steps of the progress bars: napari draws its own at each
BREATH_MS = 15


@dataclass(frozen=True)
class Outcome:
    """How a run ended: with a value or with an error."""

    value: Any = None
    error: BaseException | None = None


def in_thread(name: str, work: Callable[[], Any], tell: Callable[[Outcome], Any]) -> None:
    """Start `work` in a thread of its own, which then tells how it ended."""

    def run() -> None:
        try:
            outcome = Outcome(work())
        except BaseException as error:  # handed to the interface, which tells the user
            outcome = Outcome(error=error)
        tell(outcome)

    threading.Thread(target=run, daemon=True, name=name).start()


def _steps(work: Work, stop: Cancel, compiles: Callable[[], object]) -> Generator[tuple[int, int], None, Outcome]:
    """Run `work` in a thread of its own, yield once per twentieth done, return the outcome.

    `compiles` is called, in whatever thread, when a loop is compiled for the first time on this machine.
    The library reports progress by callbacks, napari listens to a generator. The inner thread also lets Cancel act
    at once: the generator leaves, the work notices at its next look at `stop` and throws its result away.
    """
    news: queue.SimpleQueue[tuple[int, int] | Outcome] = queue.SimpleQueue()

    def run() -> Any:
        from napari_mufasa.compiled import told_of_compiling

        with steered(lambda done, total: news.put((done, total)), stop), told_of_compiling(compiles):
            return work()

    in_thread("mufasa-work", run, news.put)
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

    ``start(title, work, done)`` runs ``work()``, which may ask `steering()`, in the background and then calls
    ``done(result)`` in the interface's thread. Where `done` is a generator, the interface breathes at each ``yield``:
    what it has to do (a layer, another layer, a table) is done one thing at a time. ``finished`` is emitted after every
    run, however it ended. Other buttons that start a run here are `besides`: pressed meanwhile, they would do nothing.
    """

    clicked = Signal()
    finished = Signal()
    _compiles = Signal()

    def __init__(self, run_label: str, tooltip: str = "", parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.run_button = button(run_label, self.clicked.emit, tooltip)
        self.besides: list[QPushButton] = []
        self.cancel_button = button("Cancel", self.cancel, "Stop this run; nothing is kept of it")
        self.bar = made(QProgressBar, textVisible=False, maximumHeight=6)
        self.message = Words()
        self.message.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
        buttons = row(self.run_button, self.cancel_button, shares=(1,))
        column(self, buttons, self.bar, self.message).setSpacing(4)
        self.say = self.message.say
        self._title = ""
        self._compiles.connect(self._on_compiling)
        self._worker: Any = None
        self._done: Callable[[Any], Any] = lambda value: None
        self._outcome = Outcome()
        self._rest: Generator[None, None, None] | None = None  # what `done` still has to do
        self._breath = timer(self, BREATH_MS, self._go_on)
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
            _steps, work, lambda: bool(box) and box[0].abort_requested, self._tell_compiling,
            _progress={"total": TWENTIETHS, "desc": title}, _start_thread=False,
        )  # fmt: skip
        box.append(worker)
        self._worker, self._done, self._outcome = worker, done, Outcome(error=Cancelled())
        worker.yielded.connect(self._on_progress)
        worker.returned.connect(self._on_returned)
        worker.finished.connect(self._on_finished)
        # A closed dock must not leave work behind.
        self.destroyed.connect(worker.quit)
        self._title = title
        self.say(f"{title} …")
        self._show_running(True)
        worker.start()

    def cancel(self) -> None:
        """Stop the run; the panel is free again within a tenth of a second."""
        if self._worker is not None:
            self._worker.quit()
            self.say("Stopping …")

    def _show_running(self, running: bool) -> None:
        for starts in (self.run_button, *self.besides):
            starts.setEnabled(not running)
        self.cancel_button.setVisible(running)
        self.bar.setVisible(running)
        if running:
            self.bar.setRange(0, 0)  # busy, until the first news

    def _on_progress(self, news: tuple[int, int]) -> None:
        done, total = news
        self.bar.setRange(0, max(total, 1))
        self.bar.setValue(done)
        if self._worker is not None and not self._worker.abort_requested:
            self.say(f"{self._title} …")  # it may have been compiling

    def _tell_compiling(self) -> None:
        with contextlib.suppress(RuntimeError):  # the widget is gone
            self._compiles.emit()

    def _on_compiling(self) -> None:
        if self._worker is not None and not self._worker.abort_requested:
            self.say(f"{self._title} … (compiling, once for this machine)")

    def _on_returned(self, outcome: Outcome) -> None:
        self._outcome = outcome

    def _on_finished(self) -> None:
        worker, outcome, self._worker = self._worker, self._outcome, None
        with contextlib.suppress(TypeError, RuntimeError):  # already gone with the widget
            self.destroyed.disconnect(worker.quit)
        if isinstance(outcome.error, Cancelled):
            self.say("Cancelled.")
        elif outcome.error is not None:
            self.say(report_error(outcome.error), error=True)
        else:
            self.say("")
            self._rest = _in_turns(self._done, outcome.value)
            self._breath.start()  # napari's own end of a run comes first
            return
        self._end()

    def _go_on(self) -> None:
        """Do the next part of what follows a run."""
        if self._rest is None:
            return
        ended = True
        try:
            with errors_reported(partial(self.say, error=True)):
                ended = next(self._rest, True) is True
        finally:
            if ended:
                self._end()
            else:
                self._breath.start()

    def _end(self) -> None:
        self._rest, self._done, self._outcome = None, lambda value: None, Outcome()  # nothing of a run is kept
        self._show_running(False)
        self.finished.emit()


def _in_turns(done: Callable[[Any], Any], value: Any) -> Generator[None, None, None]:
    """`done` as a generator, which it may be or not."""
    parts = done(value)
    if isinstance(parts, Generator):
        yield from parts


class Latest(QObject):
    """``request(work)`` runs ``work(cancel)`` in a thread, once no newer request has come for `wait_ms`.

    One work runs at a time. ``arrived(outcome)`` comes in the interface's thread, and only for the newest request:
    what was overtaken is told to stop by `cancel`, and thrown away if it does not.
    """

    arrived = Signal(object)
    _came = Signal(int, object)

    def __init__(self, wait_ms: int, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self._number = 0
        self._work: Asked | None = None
        self._running = False
        self._timer = timer(self, wait_ms, self._begin)
        self._came.connect(self._on_came)

    @property
    def busy(self) -> bool:
        """Whether the newest request is still without its answer."""
        return self._running or self._work is not None

    def request(self, work: Asked) -> None:
        self.drop()
        self._work = work
        self._timer.start()

    def drop(self) -> None:
        """Forget what was asked for; what is running ends unheard."""
        self._number += 1
        self._work = None
        self._timer.stop()

    def _begin(self) -> None:
        if self._running or self._work is None:
            return
        number, work, self._work, self._running = self._number, self._work, None, True

        def tell(outcome: Outcome) -> None:
            with contextlib.suppress(RuntimeError):  # the panel is gone
                self._came.emit(number, outcome)

        in_thread("mufasa-latest", lambda: work(lambda: self._number != number), tell)

    def _on_came(self, number: int, outcome: Outcome) -> None:
        self._running = False
        if number == self._number and not isinstance(outcome.error, Cancelled):
            self.arrived.emit(outcome)
        elif self._work is not None and not self._timer.isActive():
            self._begin()


class WhenSeen(Latest):
    """``renew()`` requests the work that ``ask()`` gives, if it gives any; not before one of its lookers is seen."""

    def __init__(self, wait_ms: int, parent: QObject, ask: Callable[[], Asked | None], *lookers: QWidget) -> None:
        super().__init__(wait_ms, parent)
        self._ask, self._stale = ask, True
        self._lookers: list[QWidget] = []
        for looker in lookers:
            self.watch(looker)

    def watch(self, looker: QWidget) -> None:
        """Work for this widget, too."""
        self._lookers.append(looker)
        looker.installEventFilter(self)
        looker.destroyed.connect(lambda: self._lookers.remove(looker))

    def renew(self) -> None:
        self._stale = True
        work = self._ask() if any(looker.isVisible() for looker in self._lookers) else None
        if work is not None:
            self._stale = False
            self.request(work)

    def eventFilter(self, _looker: Any, event: Any) -> bool:
        if self._stale and event.type() == QEvent.Type.Show:
            self.renew()
        return False


@contextlib.contextmanager
def errors_reported(then: Callable[[str], Any] = lambda line: None) -> Iterator[None]:
    """Here a `MufasaError`, or one of the system's, becomes a notification, and ``then(line)`` tells it elsewhere."""
    try:
        yield
    except (MufasaError, OSError) as error:
        then(report_error(error))


def report_error(error: BaseException) -> str:
    """Tell napari's notifications; returns the line for the panel."""
    from napari.utils.notifications import ErrorNotification, notification_manager, show_error

    if isinstance(error, (MufasaError, OSError)):
        line = system_line(error) if isinstance(error, OSError) else str(error)
        show_error(line)
        return line
    notification_manager.dispatch(ErrorNotification(error))
    return f"Unexpected {type(error).__name__}: {error}. The notification has the details to report."
