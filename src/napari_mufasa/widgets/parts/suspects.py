"""Which effects an investigation considers: a list to tick, folded away until it is wanted."""

from __future__ import annotations

from qtpy.QtWidgets import QHBoxLayout, QVBoxLayout, QWidget

from napari_mufasa.effects import catalogue
from napari_mufasa.errors import MufasaError
from napari_mufasa.widgets.parts.panel import boxed, button
from napari_mufasa.widgets.parts.tables import TICKED, EffectTicks
from napari_mufasa.widgets.turns.session import Session


class Suspects(QWidget):
    """Effects that suit the believed model; all are considered unless some are unticked."""

    def __init__(self, session: Session) -> None:
        super().__init__()
        self.session = session
        self._unticked: set[str] = set()
        self.list = EffectTicks("Effects to consider", 140)
        self.list.ticked.connect(self._on_ticked)
        self.all_button = button(
            "All", lambda: self._tick(True), "Consider every effect of the catalogue that suits the camera"
        )
        self.none_button = button(
            "None", lambda: self._tick(False), "Untick all, to choose a few: fewer suspects are examined sooner"
        )
        layout = QVBoxLayout(self)
        layout.setContentsMargins(4, 2, 4, 4)
        layout.addWidget(boxed((self.all_button, self.none_button), QHBoxLayout()))
        layout.addWidget(self.list)
        session.model_changed.connect(self.refresh)
        self.refresh()

    def refresh(self) -> None:
        model = self.session.model
        known = {effect.kind for effect in model.effects}
        shown = {k: e for k, e in catalogue().items() if e.suits(model) and k not in known}
        if list(self.list.rows) != list(shown):
            self.list.fill(shown, set(shown) - self._unticked)

    def chosen(self) -> tuple[str, ...] | None:
        """The ticked effects; None when all are. Raises `MufasaError` when none is."""
        kinds = list(self.list.rows)
        ticked = tuple(kind for kind in kinds if kind not in self._unticked)
        if not ticked:
            raise MufasaError("no effect is ticked as a suspect: open Suspects and tick some, or press All")
        return None if len(ticked) == len(kinds) else ticked

    def _tick(self, ticked: bool) -> None:
        for item in self.list.rows.values():
            item.setCheckState(TICKED[ticked])

    def _on_ticked(self, kind: str, on: bool) -> None:
        (self._unticked.discard if on else self._unticked.add)(kind)
