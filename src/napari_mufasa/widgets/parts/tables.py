"""Tables of rows to choose one from."""

from __future__ import annotations

from typing import Any

from qtpy.QtCore import Qt
from qtpy.QtWidgets import QHeaderView, QTableWidget, QTableWidgetItem


def table(headers: list[str]) -> QTableWidget:
    """A table of rows to choose one from; the first column takes the room."""
    made: Any = QTableWidget(0, len(headers))
    made.setHorizontalHeaderLabels(headers)
    made.verticalHeader().setVisible(False)
    made.setSelectionBehavior(QTableWidget.SelectionBehavior.SelectRows)
    made.setSelectionMode(QTableWidget.SelectionMode.SingleSelection)
    made.setEditTriggers(QTableWidget.EditTrigger.NoEditTriggers)
    made.setTextElideMode(Qt.TextElideMode.ElideRight)
    made.setMinimumHeight(120)
    made.verticalHeader().setDefaultSectionSize(24)
    header = made.horizontalHeader()
    header.setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
    header.setSectionResizeMode(0, QHeaderView.ResizeMode.Stretch)
    return made  # type: ignore[no-any-return]


def add_row(made: QTableWidget, cells: list[str], tip: str, key: str) -> None:
    row = made.rowCount()
    made.insertRow(row)
    for column, text in enumerate(cells):
        item = QTableWidgetItem(text)
        item.setToolTip(tip)
        item.setData(Qt.ItemDataRole.UserRole, key)
        if column:
            item.setTextAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
        made.setItem(row, column, item)
