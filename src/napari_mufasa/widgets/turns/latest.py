"""Of many requests only the newest matters: plots while a window is resized, distances while a value is turned."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from typing import Any

from qtpy.QtCore import QObject, QTimer, Signal  # type: ignore[attr-defined]

from napari_mufasa.errors import Cancelled
from napari_mufasa.widgets.turns.jobs import Outcome

Work = Callable[[Callable[[], bool]], Any]


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
        self._work: Work | None = None
        self._running = False
        self._timer = QTimer(self)
        self._timer.setSingleShot(True)
        self._timer.setInterval(wait_ms)
        self._timer.timeout.connect(self._begin)
        self._came.connect(self._on_came)

    @property
    def busy(self) -> bool:
        """Whether the newest request is still without its answer."""
        return self._running or self._work is not None

    def request(self, work: Work) -> None:
        self._number += 1
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

        def run() -> None:
            try:
                outcome = Outcome(work(lambda: self._number != number))
            except BaseException as error:  # handed to the interface
                outcome = Outcome(error=error)
            with contextlib.suppress(RuntimeError):  # the panel is gone
                self._came.emit(number, outcome)

        threading.Thread(target=run, daemon=True, name="mufasa-latest").start()

    def _on_came(self, number: int, outcome: Outcome) -> None:
        self._running = False
        if number == self._number and not isinstance(outcome.error, Cancelled):
            self.arrived.emit(outcome)
        elif self._work is not None and not self._timer.isActive():
            self._begin()
