"""The distance between the model as it is being edited and the measured traces; one for all panels of a viewer."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from qtpy.QtCore import QObject, Signal  # type: ignore[attr-defined]
from qtpy.QtWidgets import QLabel

from napari_mufasa.report.lines import live_line
from napari_mufasa.widgets.parts.preferences import preference
from napari_mufasa.widgets.turns.latest import Latest
from napari_mufasa.widgets.turns.session import Session

if TYPE_CHECKING:
    from napari_mufasa.compare.quick import QuickDistance

WAIT_MS = 250
NOT_YET = "Distance to the measurement: extract traces (step Molecules) or compare once to see it live."


def live_of(session: Session) -> LiveDistance:
    """The one live distance of a session, made when it is first asked for."""
    return session.findChild(LiveDistance) or LiveDistance(session)


class LiveDistance(QObject):
    """Follows the session's model and traces; works only while someone looks.

    ``changed`` when `distance`, `words` or `busy` are new.
    """

    changed = Signal()

    def __init__(self, session: Session) -> None:
        super().__init__(session)
        self.session = session
        self.distance: QuickDistance | None = None
        self.problem = ""
        self._traces: Any = None
        self._known: Any = None
        self._stale = True
        self._lookers: list[QLabel] = []
        self._latest = Latest(WAIT_MS, self)
        self._latest.arrived.connect(self._on_arrived)
        session.model_changed.connect(self._on_change)
        session.result_changed.connect(self._on_result)
        self._take_traces()

    @property
    def busy(self) -> bool:
        return self._latest.busy

    def join(self, looker: QLabel) -> None:
        self._lookers.append(looker)
        looker.destroyed.connect(lambda: self._lookers.remove(looker) if looker in self._lookers else None)

    def refresh(self) -> None:
        """Work out the distance if it is not known and someone looks."""
        if not preference("picture.live_distance"):
            return
        if not self._stale or not any(looker.isVisible() for looker in self._lookers):
            return
        self._stale = False
        if self._traces is None:
            self.distance = None
            self.changed.emit()
            return
        traces, model, known = self._traces, self.session.model, self._known

        def work(cancel: Any) -> QuickDistance:
            from napari_mufasa.compare.quick import quick_distance

            return quick_distance(traces, model, known=known, cancel=cancel)

        self._latest.request(work)
        self.changed.emit()

    def words(self) -> str:
        """The distance in a line."""
        if not preference("picture.live_distance"):
            return ""
        if self._traces is None:
            return NOT_YET
        if self.problem:
            return f"Distance to the measurement: {self.problem}"
        if self.distance is None:
            return "Distance to the measurement: …"
        return live_line(self.distance.w1, self.distance.floor, self.busy)

    def _on_change(self) -> None:
        self._stale = True
        self.refresh()

    def _on_result(self, name: str) -> None:
        if name in ("traces", "comparison"):
            self._take_traces(name)
            self._on_change()

    def _take_traces(self, newest: str = "traces") -> None:
        traces = self.session.results.get("traces")
        comparison = self.session.results.get("comparison")
        compared = comparison.measured if comparison is not None else None
        self._traces = (compared or traces) if newest == "comparison" else (traces or compared)
        self._known = None

    def _on_arrived(self, outcome: Any) -> None:
        self.problem = "" if outcome.error is None else str(outcome.error)
        if outcome.error is None:
            self.distance = outcome.value
            self._known = outcome.value.known
        self.changed.emit()


class LiveLine(QLabel):
    """The distance as a line of text."""

    def __init__(self, session: Session) -> None:
        super().__init__()
        self.live = live_of(session)
        self.setWordWrap(True)
        self.setToolTip(
            "From about 64 simulated molecules and some frames of the movie, for the eye while a value is changed. "
            "Step Compare gives the number to quote."
        )
        self.live.join(self)
        self.live.changed.connect(self.show_words)
        self.show_words()

    def showEvent(self, event: Any) -> None:
        super().showEvent(event)
        self.live.refresh()

    def show_words(self) -> None:
        self.setText(self.live.words())
