"""The distance between the model as it is being edited and the measured traces; one for all panels of a viewer."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from qtpy.QtCore import QObject, Signal  # type: ignore[attr-defined]

from napari_mufasa.report.lines import live_line
from napari_mufasa.widgets.parts.pieces import Words
from napari_mufasa.widgets.parts.preferences import preference
from napari_mufasa.widgets.turns.jobs import Latest
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

    ``changed`` when `distance`, `problem` or `busy` are new.
    """

    changed = Signal()

    def __init__(self, session: Session) -> None:
        super().__init__(session)
        self.session = session
        self.distance: QuickDistance | None = None
        self.problem = ""
        self.lookers: list[Words] = []
        self._known: Any = None  # what is worked out once for all models, of the traces there are
        self._stale = True
        self._latest = Latest(WAIT_MS, self)
        self._latest.arrived.connect(self._on_arrived)
        session.model_changed.connect(self._on_change)
        session.traces_changed.connect(self._on_traces)

    @property
    def busy(self) -> bool:
        return self._latest.busy

    def refresh(self) -> None:
        """Work out the distance if it is not known and someone looks."""
        watched = preference("picture.live_distance") and any(looker.isVisible() for looker in self.lookers)
        if not self._stale or not watched:
            return
        self._stale = False
        traces, model, known = self.session.traces, self.session.model, self._known
        if traces is None:
            return

        def work(cancel: Any) -> QuickDistance:
            from napari_mufasa.compare.quick import quick_distance

            return quick_distance(traces, model, known=known, cancel=cancel)

        self._latest.request(work)
        self.changed.emit()

    def _on_change(self) -> None:
        self._stale = True
        self.refresh()

    def _on_traces(self) -> None:
        self._known = None
        self._on_change()

    def _on_arrived(self, outcome: Any) -> None:
        self.problem = "" if outcome.error is None else str(outcome.error)
        if outcome.error is None:
            self.distance = outcome.value
            self._known = outcome.value.known
        self.changed.emit()


class LiveLine(Words):
    """The distance as a line of text."""

    def __init__(self, session: Session) -> None:
        super().__init__(NOT_YET)
        self.setToolTip(
            "From about 64 simulated molecules and some frames of the movie, for the eye while a value is changed. "
            "Step Compare gives the number to quote."
        )
        live = self.live = live_of(session)
        live.lookers.append(self)
        self.destroyed.connect(lambda: live.lookers.remove(self) if self in live.lookers else None)
        live.changed.connect(self.show_words)
        self.show_words()

    def showEvent(self, event: Any) -> None:
        super().showEvent(event)
        self.live.refresh()

    def show_words(self) -> None:
        live = self.live
        if not preference("picture.live_distance"):
            self.clear()
        elif live.session.traces is None:
            self.setText(NOT_YET)
        elif live.problem or live.distance is None:
            self.setText(f"Distance to the measurement: {live.problem or '…'}")
        else:
            self.setText(live_line(live.distance.w1, live.distance.floor, live.busy))
