"""The Model step: where the believed model comes from, every parameter, effects on and off, what follows from it."""

from __future__ import annotations

from napari_mufasa.widgets.parts.effects import EffectsList
from napari_mufasa.widgets.parts.forms import DerivedValues, PartEditor
from napari_mufasa.widgets.parts.model_edit import ModelEdit
from napari_mufasa.widgets.parts.panel import Panel
from napari_mufasa.widgets.parts.pieces import section
from napari_mufasa.widgets.turns.live import LiveLine

PARTS = ("acquisition", "fluorophore", "excitation", "optics", "camera", "sample")


class ModelPanel(Panel):
    """Sources, effects, all parameters in folding sections, derived values; nothing is run."""

    def build(self) -> None:
        self.source = ModelEdit(session=self.session)
        self.derived, self.live = DerivedValues(self.session), LiveLine(self.session)
        self.effects = EffectsList(self.session)
        self.parts = {part: PartEditor(self.session, part) for part in PARTS}
        self.run_bar.hide()
        self.add(self.source.native, self.live)
        self.add(section("What follows", self.derived, True), section("Effects", self.effects, True))
        self.add(*(section(part.capitalize(), editor) for part, editor in self.parts.items()))
        self.column.addStretch(1)
