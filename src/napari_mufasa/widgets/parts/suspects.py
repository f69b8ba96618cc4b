"""Which effects an investigation considers: a list to tick, folded away until it is wanted."""

from __future__ import annotations

from qtpy.QtWidgets import QHBoxLayout, QVBoxLayout, QWidget

from napari_mufasa.effects import catalogue
from napari_mufasa.errors import MufasaError
from napari_mufasa.widgets.parts.panel import boxed, button
from napari_mufasa.widgets.parts.tables import TICKED, EffectTicks
from napari_mufasa.widgets.turns.session import Session


class Suspects(QWidget):
    """Effects that suit the believed model; ticked at first are those that a diagnosis considers unasked."""

    def __init__(self, session: Session) -> None:
        super().__init__()
        self.session = session
        self._said: dict[str, bool] = {}  # what the user ticked and unticked
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
            self.list.fill(shown, self._ticked(list(shown)))

    def chosen(self) -> tuple[str, ...] | None:
        """The ticked effects; None when they are those considered unasked. Raises `MufasaError` when none is."""
        kinds, model = list(self.list.rows), self.session.model
        ticked = self._ticked(kinds)
        if not ticked:
            raise MufasaError("no effect is ticked as a suspect: open Suspects and tick some, or press All")
        unasked = {kind for kind in kinds if catalogue()[kind].considered_in(model)}
        return None if ticked == unasked else tuple(kind for kind in kinds if kind in ticked)

    def _ticked(self, kinds: list[str]) -> set[str]:
        model = self.session.model
        return {kind for kind in kinds if self._said.get(kind, catalogue()[kind].considered_in(model))}

    def _tick(self, ticked: bool) -> None:
        for item in self.list.rows.values():
            item.setCheckState(TICKED[ticked])

    def _on_ticked(self, kind: str, on: bool) -> None:
        self._said[kind] = on
