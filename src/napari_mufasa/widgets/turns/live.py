"""The distance between the model as it is being edited and the measured traces; one for all panels of a viewer."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from qtpy.QtCore import Signal  # type: ignore[attr-defined]

from napari_mufasa.report.lines import live_line
from napari_mufasa.widgets.parts.pieces import Words
from napari_mufasa.widgets.parts.preferences import preference
from napari_mufasa.widgets.turns.jobs import WhenSeen
from napari_mufasa.widgets.turns.session import Session

if TYPE_CHECKING:
    from napari_mufasa.compare.quick import QuickDistance

WAIT_MS = 250
NOT_YET = "Distance to the measurement: extract traces (step Molecules) or compare once to see it live."


def live_of(session: Session) -> LiveDistance:
    """The one live distance of a session, made when it is first asked for."""
    return session.findChild(LiveDistance) or LiveDistance(session)


class LiveDistance(WhenSeen):
    """Follows the session's model and traces; works only while someone looks.

    ``changed`` when `distance`, `problem` or `busy` are new.
    """

    changed = Signal()

    def __init__(self, session: Session) -> None:
        super().__init__(WAIT_MS, session, self._measuring)
        self.session = session
        self.distance: QuickDistance | None = None
        self.problem = ""
        self._known: Any = None  # what is worked out once for all models, of the traces there are
        self.arrived.connect(self._on_arrived)
        session.model_changed.connect(self.renew)
        session.traces_changed.connect(self._on_traces)

    def _measuring(self) -> Any:
        traces, model, known = self.session.traces, self.session.model, self._known
        if traces is None or not preference("picture.live_distance"):
            return None

        def work(cancel: Any) -> QuickDistance:
            from napari_mufasa.compare.quick import quick_distance

            return quick_distance(traces, model, known=known, cancel=cancel)

        return work

    def request(self, work: Any) -> None:
        super().request(work)
        self.changed.emit()

    def _on_traces(self) -> None:
        self._known = self.distance = None
        self.problem = ""
        self.drop()  # what is worked out is of other traces
        self.renew()
        self.changed.emit()

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
        live.watch(self)
        live.changed.connect(self.show_words)
        self.show_words()

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
