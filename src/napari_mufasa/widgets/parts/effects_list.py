"""The effects of the believed model as a list: switch on, off, edit, add, remove."""

from __future__ import annotations

from typing import Any

from qtpy.QtCore import Qt
from qtpy.QtWidgets import (
    QComboBox,
    QHBoxLayout,
    QLabel,
    QListWidget,
    QListWidgetItem,
    QPushButton,
    QVBoxLayout,
    QWidget,
)

from napari_mufasa.effects import Effect, catalogue
from napari_mufasa.widgets.parts.fields import Form
from napari_mufasa.widgets.parts.layers import slim
from napari_mufasa.widgets.turns.jobs import Quiet
from napari_mufasa.widgets.turns.session import Session

KIND = Qt.ItemDataRole.UserRole


class EffectsList(QWidget):
    """Ticked effects are in the model; an unticked one keeps its parameters for later."""

    def __init__(self, session: Session) -> None:
        super().__init__()
        self.session = session
        self._off: dict[str, Effect] = {}
        self._quiet = Quiet(self)
        self.list = QListWidget()
        self.list.setMaximumHeight(84)
        self.list.setAccessibleName("Effects in the model")
        self.list.itemChanged.connect(self._on_ticked)
        self.list.currentItemChanged.connect(lambda *_: self._show_form())
        self.kinds = QComboBox()
        self.kinds.setAccessibleName("Effect to add")
        slim(self.kinds)
        self.kinds.setToolTip("Effects that make sense for this model")
        self.add_button, self.remove_button = QPushButton("Add"), QPushButton("Remove")
        self.add_button.clicked.connect(lambda: self.add(self.kinds.currentData()))
        self.remove_button.clicked.connect(self._remove)
        self.words = QLabel()
        self.words.setWordWrap(True)
        self.problem = QLabel()
        self.problem.setWordWrap(True)
        self.problem.setStyleSheet("QLabel { color: #e0605e; }")
        self.form: Form | None = None
        row = QHBoxLayout()
        row.addWidget(self.kinds, 1)
        row.addWidget(self.add_button)
        row.addWidget(self.remove_button)
        self._layout = QVBoxLayout(self)
        self._layout.setContentsMargins(4, 2, 4, 4)
        self._layout.addWidget(self.list)
        self._layout.addLayout(row)
        self._layout.addWidget(self.words)
        self._layout.addWidget(self.problem)
        session.model_changed.connect(self.refresh)
        self.refresh()

    def refresh(self) -> None:
        model = self.session.model
        on = {effect.kind: effect for effect in model.effects}
        self._off = {kind: effect for kind, effect in self._off.items() if kind not in on}
        selected = self._selected()
        with self._quiet:
            self.list.clear()
            for kind, effect in {**on, **self._off}.items():
                item = QListWidgetItem(type(effect).title or kind)
                item.setData(KIND, kind)
                item.setToolTip(type(effect).what_it_does)
                item.setFlags(item.flags() | Qt.ItemFlag.ItemIsUserCheckable)
                item.setCheckState(Qt.CheckState.Checked if kind in on else Qt.CheckState.Unchecked)
                self.list.addItem(item)
                if kind == selected:
                    self.list.setCurrentItem(item)
            chosen = self.kinds.currentData()
            self.kinds.clear()
            for kind, effect_class in catalogue().items():
                if effect_class.suits(model) and kind not in on:
                    self.kinds.addItem(effect_class.title or kind, kind)
            self.kinds.setCurrentIndex(max(0, self.kinds.findData(chosen)))
        self._show_form()

    def add(self, kind: str) -> None:
        """Put an effect with its default parameters into the model."""
        effect = self._off.pop(kind, None) or catalogue()[kind]()
        self.session.set_model(self.session.model.with_effects(effect))
        for i in range(self.list.count()):
            item: Any = self.list.item(i)
            if item.data(KIND) == kind:
                self.list.setCurrentRow(i)

    def _selected(self) -> str | None:
        item = self.list.currentItem()
        return str(item.data(KIND)) if item is not None else None

    def _effect(self, kind: str) -> Effect | None:
        return next((e for e in self.session.model.effects if e.kind == kind), self._off.get(kind))

    def _without(self, kind: str) -> None:
        model = self.session.model
        self.session.set_model(model.model_copy(update={"effects": tuple(e for e in model.effects if e.kind != kind)}))

    def _remove(self) -> None:
        kind = self._selected()
        if kind is not None:
            self._off.pop(kind, None)
            self._without(kind)
            self.refresh()

    def _on_ticked(self, item: QListWidgetItem) -> None:
        if self._quiet:
            return
        kind = str(item.data(KIND))
        effect = self._effect(kind)
        if effect is None:
            return
        if item.checkState() == Qt.CheckState.Checked:
            self._off.pop(kind, None)
            self.session.set_model(self.session.model.with_effects(effect))
        else:
            self._off[kind] = effect
            self._without(kind)

    def _show_form(self) -> None:
        if self._quiet:
            return
        kind = self._selected()
        effect = self._effect(kind) if kind is not None else None
        if self.form is not None:
            self._layout.removeWidget(self.form)
            self.form.deleteLater()
            self.form = None
        self.problem.setVisible(False)
        self.words.setVisible(effect is not None)
        if effect is None:
            return
        self.words.setText(f"{effect.what_it_is} {effect.what_it_does}")
        self.form = Form(type(effect))
        self.form.show_values(effect)
        _show_rows(self.form, effect)
        self.form.edited.connect(self._on_edited)
        self._layout.addWidget(self.form)

    def _on_edited(self, name: str) -> None:
        kind = self._selected()
        effect: Any = self._effect(kind) if kind is not None else None
        if effect is None or self.form is None:
            return
        try:
            values = {n: getattr(effect, n) for n in type(effect).model_fields} | {name: self.form.value(name)}
            changed = type(effect).model_validate(values)
        except ValueError as error:
            self.form.mark(name, True)
            first = error.errors()[0]["msg"] if hasattr(error, "errors") else str(error)
            self.problem.setText(f"{name}: {first}")
            self.problem.setVisible(True)
            return
        if kind in self._off:
            self._off[kind] = changed
            _show_rows(self.form, changed)
        else:
            self.session.set_model(self.session.model.with_effects(changed))


def _show_rows(form: Form, effect: Effect) -> None:
    """Only what matters in the effect's form."""
    for name in form.editors:
        form.show_row(name, effect.matters(name))
