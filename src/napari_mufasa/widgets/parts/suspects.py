"""Which effects an investigation considers: a list to tick, folded away until it is wanted."""

from __future__ import annotations

from typing import Any

from qtpy.QtCore import Qt
from qtpy.QtWidgets import QHBoxLayout, QListWidget, QListWidgetItem, QPushButton, QVBoxLayout, QWidget

from napari_mufasa.effects import catalogue
from napari_mufasa.errors import MufasaError
from napari_mufasa.widgets.turns.jobs import Quiet
from napari_mufasa.widgets.turns.session import Session

KIND = Qt.ItemDataRole.UserRole


class Suspects(QWidget):
    """Effects that suit the believed model; all are considered unless some are unticked."""

    def __init__(self, session: Session) -> None:
        super().__init__()
        self.session = session
        self._unticked: set[str] = set()
        self._quiet = Quiet(self)
        self.list = QListWidget()
        self.list.setMaximumHeight(140)
        self.list.setAccessibleName("Effects to consider")
        self.list.itemChanged.connect(self._on_ticked)
        self.all_button, self.none_button = QPushButton("All"), QPushButton("None")
        self.all_button.setToolTip("Consider every effect of the catalogue that suits the camera")
        self.none_button.setToolTip("Untick all, to choose a few: fewer suspects are examined sooner")
        self.all_button.clicked.connect(lambda: self._tick(True))
        self.none_button.clicked.connect(lambda: self._tick(False))
        row = QHBoxLayout()
        row.addWidget(self.all_button)
        row.addWidget(self.none_button)
        row.addStretch(1)
        layout = QVBoxLayout(self)
        layout.setContentsMargins(4, 2, 4, 4)
        layout.addLayout(row)
        layout.addWidget(self.list)
        session.model_changed.connect(self.refresh)
        self.refresh()

    def refresh(self) -> None:
        model = self.session.model
        known = {effect.kind for effect in model.effects}
        shown = {k: e for k, e in catalogue().items() if e.suits(model) and k not in known}
        if [self._kind(i) for i in range(self.list.count())] == list(shown):
            return
        with self._quiet:
            self.list.clear()
            for kind, effect in shown.items():
                item = QListWidgetItem(effect.title or kind)
                item.setData(KIND, kind)
                item.setToolTip(effect.what_it_does)
                item.setFlags(item.flags() | Qt.ItemFlag.ItemIsUserCheckable)
                item.setCheckState(Qt.CheckState.Unchecked if kind in self._unticked else Qt.CheckState.Checked)
                self.list.addItem(item)

    def chosen(self) -> list[str] | None:
        """The ticked effects; None when all are. Raises `MufasaError` when none is."""
        kinds = [self._kind(i) for i in range(self.list.count())]
        ticked = [kind for kind in kinds if kind not in self._unticked]
        if not ticked:
            raise MufasaError("no effect is ticked as a suspect: open Suspects and tick some, or press All")
        return None if len(ticked) == len(kinds) else ticked

    def _kind(self, row: int) -> str:
        item: Any = self.list.item(row)
        return str(item.data(KIND))

    def _tick(self, ticked: bool) -> None:
        for row in range(self.list.count()):
            item: Any = self.list.item(row)
            item.setCheckState(Qt.CheckState.Checked if ticked else Qt.CheckState.Unchecked)

    def _on_ticked(self, item: QListWidgetItem) -> None:
        if self._quiet:
            return
        kind = str(item.data(KIND))
        if item.checkState() == Qt.CheckState.Checked:
            self._unticked.discard(kind)
        else:
            self._unticked.add(kind)
