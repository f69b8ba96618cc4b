"""Lists of effects: those of the believed model, to switch on, off and edit; those that an investigation considers."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from magicgui.widgets import ComboBox
from qtpy.QtCore import Qt, Signal  # type: ignore[attr-defined]
from qtpy.QtWidgets import QListWidget, QListWidgetItem, QWidget
from superqt.utils import signals_blocked

from napari_mufasa.effects import Effect, catalogue
from napari_mufasa.errors import MufasaError
from napari_mufasa.widgets.parts.forms import PartForm, dress_one
from napari_mufasa.widgets.parts.pieces import KEY, Words, button, column, row
from napari_mufasa.widgets.turns.session import Session

TICKED = {True: Qt.CheckState.Checked, False: Qt.CheckState.Unchecked}


class EffectTicks(QListWidget):
    """Effects with check marks; ``ticked(kind, on)`` when the user sets one."""

    ticked = Signal(str, bool)

    def __init__(self, accessible_name: str, height: int) -> None:
        super().__init__(maximumHeight=height, accessibleName=accessible_name)  # type: ignore[call-arg]
        self.itemChanged.connect(lambda item: self.ticked.emit(item.data(KEY), item.checkState() == TICKED[True]))

    def fill(self, effects: Iterable[type[Effect]], on: Iterable[str]) -> None:
        """Show these effects; nobody is told. The one that was selected stays so."""
        selected, on = self.kind, set(on)
        with signals_blocked(self):
            self.clear()
            for effect in effects:
                item = QListWidgetItem(effect.title or effect.kind)
                item.setData(KEY, effect.kind)
                item.setToolTip(effect.what_it_does)
                item.setCheckState(TICKED[effect.kind in on])
                self.addItem(item)
                if effect.kind == selected:
                    self.setCurrentItem(item)

    @property
    def kind(self) -> str:
        """The effect that is selected, empty when there is none."""
        item = self.currentItem()
        return str(item.data(KEY)) if item is not None else ""

    @property
    def rows(self) -> dict[str, Any]:
        """The rows by effect."""
        rows: list[Any] = [self.item(number) for number in range(self.count())]
        return {str(item.data(KEY)): item for item in rows}

    @property
    def on(self) -> list[str]:
        """The effects that are ticked."""
        return [kind for kind, item in self.rows.items() if item.checkState() == TICKED[True]]


class Suspects(QWidget):
    """Effects that suit the believed model; ticked at first are those that a diagnosis considers unasked."""

    def __init__(self, session: Session) -> None:
        super().__init__()
        self.session = session
        self._said: dict[str, bool] = {}  # what the user ticked and unticked
        self.list = EffectTicks("Effects to consider", 140)
        self.list.ticked.connect(lambda kind, on: self._said.update({kind: on}))
        self.all_button = button("All", lambda: self._tick(True), "Consider every effect that suits the camera")
        self.none_button = button("None", lambda: self._tick(False), "Untick all; fewer suspects are examined sooner")
        column(self, row(self.all_button, self.none_button), self.list, margins=(4, 2, 4, 4))
        session.model_changed.connect(self.refresh)
        self.refresh()

    def refresh(self) -> None:
        model = self.session.model
        known = {effect.kind for effect in model.effects}
        shown = {k: e for k, e in catalogue().items() if e.suits(model) and k not in known}
        ticked = [kind for kind in shown if self._said.get(kind, self._unasked(kind))]
        if (list(self.list.rows), self.list.on) != (list(shown), ticked):
            self.list.fill(shown.values(), ticked)

    def chosen(self) -> tuple[str, ...] | None:
        """The ticked effects; None when they are those considered unasked. Raises `MufasaError` when none is."""
        ticked = self.list.on
        if not ticked:
            raise MufasaError("no effect is ticked as a suspect: open Suspects and tick some, or press All")
        return None if ticked == [kind for kind in self.list.rows if self._unasked(kind)] else tuple(ticked)

    def _unasked(self, kind: str) -> bool:
        return catalogue()[kind].common_in(self.session.model)

    def _tick(self, ticked: bool) -> None:
        for item in self.list.rows.values():
            item.setCheckState(TICKED[ticked])


class EffectsList(QWidget):
    """Ticked effects are in the model; an unticked one keeps its parameters for later."""

    def __init__(self, session: Session) -> None:
        super().__init__()
        self.session = session
        self._off: dict[str, Effect] = {}
        self.list = EffectTicks("Effects in the model", 84)
        self.list.ticked.connect(lambda kind, on: self.add(kind) if on else self._switch_off(kind))
        self.list.currentItemChanged.connect(lambda *_: self._show_form())
        self.kinds: Any = dress_one(ComboBox(label="Effect to add", tooltip="Effects that make sense for this model"))
        self.add_button = button("Add", lambda: self.add(str(self.kinds.value)))
        self.remove_button = button("Remove", self._remove)
        self.words = Words()
        self.form: PartForm | None = None
        chooser = row(self.kinds.native, self.add_button, self.remove_button)
        self._layout = column(self, self.list, chooser, self.words, margins=(4, 2, 4, 4))
        session.model_changed.connect(self.refresh)
        self.refresh()

    def refresh(self) -> None:
        model = self.session.model
        on = self._on
        self._off = {kind: effect for kind, effect in self._off.items() if kind not in on}
        self.list.fill((type(effect) for effect in (*model.effects, *self._off.values())), on)
        self.kinds.choices = [(e.title or k, k) for k, e in catalogue().items() if e.suits(model) and k not in on]
        self._show_form()

    def add(self, kind: str) -> None:
        """Put an effect into the model, as it was or with its default parameters."""
        effect = self._off.pop(kind, None) or catalogue()[kind]()
        self.session.set_model(self.session.model.with_effects(effect))
        self.list.setCurrentItem(self.list.rows[kind])

    @property
    def effect(self) -> Any:
        """The effect that is selected, in the model or switched off."""
        return (self._on | self._off).get(self.list.kind)

    @property
    def _on(self) -> dict[str, Effect]:
        return {effect.kind: effect for effect in self.session.model.effects}

    def _switch_off(self, kind: str) -> None:
        found = self._on
        if kind in found:
            self._off[kind] = found.pop(kind)
            self.session.set_model(self.session.model.model_copy(update={"effects": tuple(found.values())}))

    def _remove(self) -> None:
        kind = self.list.kind
        self._switch_off(kind)
        self._off.pop(kind, None)
        self.refresh()

    def _show_form(self) -> None:
        effect = self.effect
        if self.form is not None:
            self._layout.removeWidget(self.form.native)
            self.form.native.deleteLater()
        self.form = None
        self.words.say(f"{effect.what_it_is} {effect.what_it_does}" if effect is not None else "")
        if effect is not None:
            self.form = PartForm(type(effect), take=self._take)
            self.form.show_values(effect)
            self._layout.addWidget(self.form.native)
            self._show_rows(effect)

    def _take(self, name: str, value: Any) -> None:
        effect = self.effect
        changed = type(effect).model_validate(dict(effect) | {name: value})
        if effect.kind in self._off:
            self._off[effect.kind] = changed
            self._show_rows(changed)
        else:
            self.session.set_model(self.session.model.with_effects(changed))

    def _show_rows(self, effect: Effect) -> None:
        """Only what matters in the effect's form."""
        for widget in self.form or ():
            widget.visible = effect.matters(widget.name)
