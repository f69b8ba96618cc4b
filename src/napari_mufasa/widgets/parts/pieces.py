"""Small pieces of Qt that panels and pages are put together from."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar

from qtpy.QtCore import QObject, Qt, QTimer
from qtpy.QtGui import QIcon, QKeySequence, QShortcut  # type: ignore[attr-defined]
from qtpy.QtWidgets import (
    QBoxLayout,
    QHBoxLayout,
    QHeaderView,
    QLabel,
    QPushButton,
    QScrollArea,
    QSizePolicy,
    QTableWidget,
    QTableWidgetItem,
    QTabWidget,
    QVBoxLayout,
    QWidget,
)  # fmt: skip
from superqt import QCollapsible
from superqt.utils import signals_blocked

T = TypeVar("T")
Layout = TypeVar("Layout", bound=QBoxLayout)
KEY = Qt.ItemDataRole.UserRole
ERROR_STYLE = "QLabel { border-left: 4px solid #e0605e; padding-left: 6px; }"  # the text is readable in every theme


class Tabs(QTabWidget):
    """Tabs that take what height there is: their pages' wishes would make the panel scroll."""

    def __init__(self, at_least: int, pages: dict[str, QWidget]) -> None:
        super().__init__()
        takes_the_rest(self, at_least)
        for name, page in pages.items():
            self.addTab(page, name)

    def hasHeightForWidth(self) -> bool:
        return False


class RowTable(QTableWidget):
    """A table of rows to choose one from, or `several`, each with a key; the first column takes the room."""

    def __init__(self, headers: list[str], accessible_name: str, several: bool = False) -> None:
        modes = QTableWidget.SelectionMode
        super().__init__(
            0, len(headers), accessibleName=accessible_name, minimumHeight=120,
            selectionBehavior=QTableWidget.SelectionBehavior.SelectRows,
            selectionMode=modes.ExtendedSelection if several else modes.SingleSelection,
            editTriggers=QTableWidget.EditTrigger.NoEditTriggers,
        )  # type: ignore[call-overload]  # fmt: skip
        self.setHorizontalHeaderLabels(headers)
        rows: Any = self.verticalHeader()
        rows.setVisible(False)
        rows.setDefaultSectionSize(24)
        header: Any = self.horizontalHeader()
        header.setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
        header.setSectionResizeMode(0, QHeaderView.ResizeMode.Stretch)

    def fill(self, rows: Iterable[tuple[str, list[str], str]]) -> None:
        """Show these rows, each (key, cells, tooltip), and choose the first; nobody is told."""
        with signals_blocked(self):
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
            self.selectRow(0)

    @property
    def key(self) -> str:
        """The key of the row that is chosen, empty when there is none."""
        return next(iter(self.keys), "")

    @property
    def keys(self) -> list[str]:
        """The keys of the rows that are chosen, from above."""
        return [str(self.item(row, 0).data(KEY)) for row in sorted({index.row() for index in self.selectedIndexes()})]  # type: ignore[union-attr]


def made(kind: Callable[..., T], *args: Any, **properties: Any) -> T:
    """An object of Qt's with properties and signals by name, as its Python bindings take them and their stubs do not
    know."""
    return kind(*args, **properties)


def shortcut(owner: QWidget, keys: str, action: Callable[[], Any]) -> None:
    """A key that works while the keyboard is anywhere within `owner`."""
    within = Qt.ShortcutContext.WidgetWithChildrenShortcut
    made(QShortcut, QKeySequence(keys), owner, context=within, activated=action)


def timer(owner: QObject, wait_ms: int, action: Callable[[], Any]) -> QTimer:
    """Does something once, `wait_ms` after it was last started."""
    return made(QTimer, owner, singleShot=True, interval=wait_ms, timeout=action)


def takes_the_rest(widget: QWidget, at_least: int) -> None:
    """Let a part of a panel have the height that is left, and scroll only below `at_least` pixels."""
    widget.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Ignored)
    widget.setMinimumHeight(at_least)


class Words(QLabel):
    """Text that is broken where the dock ends, and takes no room while there is none."""

    def __init__(self, text: str = "") -> None:
        super().__init__(text, wordWrap=True)  # type: ignore[call-overload]
        if not text:
            self.hide()

    def say(self, text: str, error: bool = False) -> None:
        """Show a text; only in a panel, for Qt would open a window for it elsewhere."""
        self.setText(text)
        self.setStyleSheet(ERROR_STYLE if error else "")
        self.setVisible(bool(text))


def into_view(widget: QWidget) -> None:
    """Scroll to a part of a panel, where it is in something that scrolls."""
    above: Any = widget.parentWidget()
    while above is not None and not isinstance(above, QScrollArea):
        above = above.parentWidget()
    if above is not None:
        above.ensureWidgetVisible(widget)


def button(text: str, action: Callable[[], Any], tooltip: str = "", enabled: bool = True) -> QPushButton:
    return made(QPushButton, text, clicked=lambda: action(), toolTip=tooltip, enabled=enabled)


def column(owner: QWidget, *items: QWidget, shares: Sequence[int] = (), margins: Any = (0, 0, 0, 0)) -> QVBoxLayout:
    """Put widgets into `owner`, one below the other; `shares` of the room that is left go to the first of them."""
    return _fill(QVBoxLayout(owner), items, shares, margins)


def row(*items: QWidget, shares: Sequence[int] = (), spacing: int = 6) -> QWidget:
    """A widget with others side by side."""
    owner = QWidget()
    _fill(made(QHBoxLayout, owner, spacing=spacing), items, shares, (0, 0, 0, 0))
    return owner


def _fill(layout: Layout, items: Sequence[QWidget], shares: Sequence[int], margins: Any) -> Layout:
    layout.setContentsMargins(*margins)
    for number, item in enumerate(items):
        layout.addWidget(item, shares[number] if number < len(shares) else 0)
    return layout


def section(title: str, content: QWidget, is_open: bool = False) -> QCollapsible:
    """A part of a panel that folds away."""
    folding = QCollapsible(f"▸ {title}", expandedIcon=QIcon(), collapsedIcon=QIcon())
    # Signs in the text have its colour; as icons they are black in every theme.
    folding.toggled.connect(lambda opened: folding.setText(f"{'▾' if opened else '▸'} {title}"))
    folding.setDuration(0)  # animations make the layout jump
    folding.addWidget(content)
    layout: Any = folding.layout()
    layout.setContentsMargins(0, 0, 0, 0)
    if is_open:
        folding.expand(animate=False)
    return folding
