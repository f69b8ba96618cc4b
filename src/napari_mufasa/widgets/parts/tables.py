"""Tables of rows to choose one from, and lists of effects to tick."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from qtpy.QtCore import Qt, Signal  # type: ignore[attr-defined]
from qtpy.QtWidgets import QHeaderView, QListWidget, QListWidgetItem, QTableWidget, QTableWidgetItem

from napari_mufasa.effects import Effect

KEY = Qt.ItemDataRole.UserRole
TICKED = {True: Qt.CheckState.Checked, False: Qt.CheckState.Unchecked}


class RowTable(QTableWidget):
    """A table of rows to choose one from, each with a key; the first column takes the room."""

    def __init__(self, headers: list[str], accessible_name: str) -> None:
        super().__init__(0, len(headers))
        self.setHorizontalHeaderLabels(headers)
        self.setAccessibleName(accessible_name)
        self.setSelectionBehavior(QTableWidget.SelectionBehavior.SelectRows)
        self.setSelectionMode(QTableWidget.SelectionMode.SingleSelection)
        self.setEditTriggers(QTableWidget.EditTrigger.NoEditTriggers)
        self.setTextElideMode(Qt.TextElideMode.ElideRight)
        self.setMinimumHeight(120)
        rows: Any = self.verticalHeader()
        rows.setVisible(False)
        rows.setDefaultSectionSize(24)
        header: Any = self.horizontalHeader()
        header.setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
        header.setSectionResizeMode(0, QHeaderView.ResizeMode.Stretch)

    def fill(self, rows: Iterable[tuple[str, list[str], str]]) -> None:
        """Show these rows, each (key, cells, tooltip), and choose the first; nobody is told."""
        blocked = self.blockSignals(True)
        self.setRowCount(0)
        for row, (key, cells, tip) in enumerate(rows):
            self.insertRow(row)
            for column, text in enumerate(cells):
                item = QTableWidgetItem(text)
                item.setToolTip(tip)
                item.setData(KEY, key)
                if column:
                    item.setTextAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
                self.setItem(row, column, item)
        if self.rowCount():
            self.selectRow(0)
        self.blockSignals(blocked)

    @property
    def key(self) -> str:
        """The key of the row that is chosen, empty when there is none."""
        items: Any = self.selectedItems()
        return str(items[0].data(KEY)) if items else ""


class EffectTicks(QListWidget):
    """Effects with check marks; ``ticked(kind, on)`` when the user sets one."""

    ticked = Signal(str, bool)

    def __init__(self, accessible_name: str, height: int) -> None:
        super().__init__()
        self.setMaximumHeight(height)
        self.setAccessibleName(accessible_name)
        self.itemChanged.connect(self._on_changed)

    def fill(self, effects: dict[str, type[Effect]], on: Iterable[str]) -> None:
        """Show these effects; nobody is told. The one that was selected stays so."""
        selected, on = self.kind, set(on)
        blocked = self.blockSignals(True)
        self.clear()
        for kind, effect in effects.items():
            item = QListWidgetItem(effect.title or kind)
            item.setData(KEY, kind)
            item.setToolTip(effect.what_it_does)
            item.setFlags(item.flags() | Qt.ItemFlag.ItemIsUserCheckable)
            item.setCheckState(TICKED[kind in on])
            self.addItem(item)
            if kind == selected:
                self.setCurrentItem(item)
        self.blockSignals(blocked)

    @property
    def kind(self) -> str | None:
        """The effect that is selected."""
        item = self.currentItem()
        return str(item.data(KEY)) if item is not None else None

    @property
    def rows(self) -> dict[str, Any]:
        """The rows by effect."""
        rows: list[Any] = [self.item(row) for row in range(self.count())]
        return {str(item.data(KEY)): item for item in rows}

    def _on_changed(self, item: QListWidgetItem) -> None:
        self.ticked.emit(str(item.data(KEY)), item.checkState() == TICKED[True])
