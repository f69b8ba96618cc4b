"""A warning where the movie chosen and the dark frames or the model believed cannot belong together."""

from __future__ import annotations

from typing import Any

from qtpy.QtWidgets import QWidget

from napari_mufasa.errors import MufasaError
from napari_mufasa.files.layers import instrument_of
from napari_mufasa.report.lines import mismatch_line
from napari_mufasa.widgets.parts.pieces import Words
from napari_mufasa.widgets.turns.jobs import Outcome, WhenSeen
from napari_mufasa.widgets.turns.session import Session

WAIT_MS = 400


class Doubts(Words):
    """Compares movie, dark frames and model anew, in a thread, when one of them changes and the panel is seen; takes no
    room while there is nothing to say."""

    def __init__(self, session: Session, panel: QWidget) -> None:
        super().__init__("")
        self.session = session
        self._latest = WhenSeen(WAIT_MS, self, self._comparing, panel)
        self._latest.arrived.connect(self._tell)
        session.movie_changed.connect(self._latest.renew)
        session.model_changed.connect(self._latest.renew)

    def _comparing(self) -> Any:
        model, layer = self.session.model, self.session.movie_layer
        try:
            measured = self.session.measurement().recorded()
        except MufasaError:  # no movie, or none that a camera recorded
            self._latest.drop()
            self.say("")
            return None

        def compared(_cancel: Any) -> Any:
            from napari_mufasa.propose import mismatches

            return mismatches(measured.movie, model, measured.dark, instrument_of(layer))

        return compared

    def _tell(self, outcome: Outcome) -> None:
        if outcome.error is None:
            self.say(mismatch_line(self.session.model_origin, outcome.value), error=True)
        else:
            self.say(str(outcome.error) if isinstance(outcome.error, MufasaError) else "", error=True)
