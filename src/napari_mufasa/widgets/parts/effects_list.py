"""The effects of the believed model as a list: switch on, off, edit, add, remove."""

from __future__ import annotations

from typing import Any

from magicgui.widgets import ComboBox
from qtpy.QtWidgets import QHBoxLayout, QVBoxLayout, QWidget

from napari_mufasa.effects import Effect, catalogue
from napari_mufasa.widgets.parts.forms import PartForm, dress_one
from napari_mufasa.widgets.parts.panel import boxed, button, wrapped
from napari_mufasa.widgets.parts.tables import EffectTicks
from napari_mufasa.widgets.turns.session import Session


class EffectsList(QWidget):
    """Ticked effects are in the model; an unticked one keeps its parameters for later."""

    def __init__(self, session: Session) -> None:
        super().__init__()
        self.session = session
        self._off: dict[str, Effect] = {}
        self.list = EffectTicks("Effects in the model", 84)
        self.list.ticked.connect(self._on_ticked)
        self.list.currentItemChanged.connect(lambda *_: self._show_form())
        self.kinds: Any = dress_one(ComboBox(label="Effect to add", tooltip="Effects that make sense for this model"))
        self.add_button = button("Add", lambda: self.add(str(self.kinds.value)))
        self.remove_button = button("Remove", self._remove)
        self.words, self.problem = wrapped(), wrapped(error=True)
        self.form: PartForm | None = None
        self._layout = QVBoxLayout(self)
        self._layout.setContentsMargins(4, 2, 4, 4)
        row = boxed((self.kinds.native, self.add_button, self.remove_button), QHBoxLayout())
        for widget in (self.list, row, self.words, self.problem):
            self._layout.addWidget(widget)
        session.model_changed.connect(self.refresh)
        self.refresh()

    def refresh(self) -> None:
        model = self.session.model
        on = {effect.kind: effect for effect in model.effects}
        self._off = {kind: effect for kind, effect in self._off.items() if kind not in on}
        self.list.fill({kind: type(effect) for kind, effect in {**on, **self._off}.items()}, on)
        self.kinds.choices = [(e.title or k, k) for k, e in catalogue().items() if e.suits(model) and k not in on]
        self._show_form()

    def add(self, kind: str) -> None:
        """Put an effect with its default parameters into the model."""
        effect = self._off.pop(kind, None) or catalogue()[kind]()
        self.session.set_model(self.session.model.with_effects(effect))
        self.list.setCurrentItem(self.list.rows[kind])

    def _effect(self, kind: str | None) -> Any:
        return next((e for e in self.session.model.effects if e.kind == kind), self._off.get(kind or ""))

    def _without(self, kind: str) -> None:
        model = self.session.model
        self.session.set_model(model.model_copy(update={"effects": tuple(e for e in model.effects if e.kind != kind)}))

    def _remove(self) -> None:
        kind = self.list.kind
        if kind is not None:
            self._off.pop(kind, None)
            self._without(kind)
            self.refresh()

    def _on_ticked(self, kind: str, on: bool) -> None:
        effect = self._effect(kind)
        if effect is not None and on:
            self._off.pop(kind, None)
            self.session.set_model(self.session.model.with_effects(effect))
        elif effect is not None:
            self._off[kind] = effect
            self._without(kind)

    def _show_form(self) -> None:
        effect = self._effect(self.list.kind)
        if self.form is not None:
            self._layout.removeWidget(self.form.native)
            self.form.native.deleteLater()
            self.form = None
        self.problem.setVisible(False)
        self.words.setVisible(effect is not None)
        if effect is None:
            return
        self.words.setText(f"{effect.what_it_is} {effect.what_it_does}")
        self.form = PartForm(type(effect))
        self.form.show_values(effect)
        self._layout.addWidget(self.form.native)
        _show_rows(self.form, effect)
        self.form.edited.connect(self._on_edited)

    def _on_edited(self, name: str) -> None:
        effect = self._effect(self.list.kind)
        if effect is None or self.form is None:
            return
        try:
            values = {n: getattr(effect, n) for n in type(effect).model_fields} | {name: self.form.read(name)}
            changed = type(effect).model_validate(values)
        except ValueError as error:
            self.form.mark(name, True)
            first = error.errors()[0]["msg"] if hasattr(error, "errors") else str(error)
            self.problem.setText(f"{name}: {first}")
            self.problem.setVisible(True)
            return
        if effect.kind in self._off:
            self._off[effect.kind] = changed
            _show_rows(self.form, changed)
        else:
            self.session.set_model(self.session.model.with_effects(changed))


def _show_rows(form: PartForm, effect: Effect) -> None:
    """Only what matters in the effect's form."""
    for widget in form:
        form.show_row(widget.name, effect.matters(widget.name))
