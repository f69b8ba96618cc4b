"""A warning where the movie chosen and the model believed cannot belong together."""

from __future__ import annotations

from typing import Any

from napari_mufasa.errors import MufasaError
from napari_mufasa.files.layers import instrument_of
from napari_mufasa.report.lines import mismatch_line
from napari_mufasa.widgets.parts.pieces import Words
from napari_mufasa.widgets.turns.jobs import Latest, Outcome
from napari_mufasa.widgets.turns.session import Session

WAIT_MS = 400


class Doubts(Words):
    """Looks again, in a thread, when movie or model change; takes no room while there is nothing to say.

    What is not to be seen is not looked at until it is.
    """

    def __init__(self, session: Session, panel: Any) -> None:
        super().__init__("")
        self.session, self._panel, self._stale = session, panel, True
        self._latest = Latest(WAIT_MS, self)
        self._latest.arrived.connect(self._tell)
        session.movie_changed.connect(self.look)
        session.model_changed.connect(self.look)

    @property
    def busy(self) -> bool:
        return self._latest.busy

    def look(self) -> None:
        """Compare movie and model anew, once the panel is to be seen."""
        self._stale = not self._panel.isVisible()
        if self._stale:
            return
        try:
            layer, measured = self.session.movie_layer, self.session.measurement().recorded()
        except MufasaError:  # no movie, or none that a camera recorded
            self._latest.drop()
            self.say("")
            return
        model = self.session.model

        def compared(_cancel: Any) -> Any:
            from napari_mufasa.propose import mismatches

            return mismatches(measured.movie, model, measured.dark, instrument_of(layer))

        self._latest.request(compared)

    def look_if_stale(self) -> None:
        """For the panel's showEvent."""
        if self._stale:
            self.look()

    def _tell(self, outcome: Outcome) -> None:
        found = outcome.value if outcome.error is None else []
        self.say(mismatch_line(self.session.model_origin, found), error=True)
