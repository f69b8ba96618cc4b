"""The widget of a parameter that is a model: a preset, a model.json, or what the movie's metadata say."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from magicgui.types import Undefined
from magicgui.widgets import ComboBox, Container, PushButton
from magicgui.widgets.bases import ValuedContainerWidget
from qtpy.QtWidgets import QFileDialog, QSizePolicy

from napari_mufasa.errors import MufasaError
from napari_mufasa.model.model import Model
from napari_mufasa.model.presets import PRESETS, preset
from napari_mufasa.widgets.parts.pieces import Words
from napari_mufasa.widgets.turns.jobs import errors_reported
from napari_mufasa.widgets.turns.session import Session

FROM_FILE = "model.json …"
FROM_LAYER = "from the movie"


class ModelEdit(ValuedContainerWidget[Any]):
    """A `Model`, or None: the one in the movie's metadata. Set it to a model, its data, a preset's name or a path.

    `follow` makes it the model of a viewer's session.
    """

    def __init__(self, value: Any = Undefined, session: Session | None = None, **options: Any) -> None:
        self.session = Session()
        self.source: Any = ComboBox(choices=[FROM_LAYER, *PRESETS, FROM_FILE], tooltip="Where the model comes from")
        self.save_button = PushButton(text="Save …", tooltip="Write the model as model.json")
        self.save_button.native.setSizePolicy(QSizePolicy.Policy.Maximum, QSizePolicy.Policy.Fixed)
        row = Container(widgets=[self.source, self.save_button], layout="horizontal", labels=False)
        super().__init__(widgets=[row], labels=False, **options)
        row.margins = self.margins = (0, 0, 0, 0)
        self.origin = Words()
        self.native.layout().addWidget(self.origin)
        self.source.native.setAccessibleName("Model")
        self.source.native.activated.connect(self._on_chosen)
        self.save_button.changed.connect(self._save)
        self.follow(session or self.session)
        if value is not Undefined:
            self.value = value

    def follow(self, session: Session) -> None:
        """Take part in the session of a viewer."""
        self._leave()
        self.session = session
        session.model_changed.connect(self._show)
        self.native.destroyed.connect(self._leave)
        self._show()

    def get_value(self) -> Any:
        return self.session.model if self.session.model_chosen or self.session.has_viewer else None

    def set_value(self, value: Any) -> None:
        if value is None:
            self.session.forget_model()
        elif isinstance(value, (Model, Mapping)):
            self.session.set_model(value if isinstance(value, Model) else Model.from_dict(value), "as given")
        elif value in PRESETS:
            self.session.set_model(preset(value), f"preset {value}")
        elif isinstance(value, (str, os.PathLike)):
            self.session.set_model(Model.from_json(value), Path(value).name)
        else:
            raise MufasaError(f"model is a {type(value).__name__}: give a Model, a preset's name or a model.json")

    def reset_choices(self, *_: Any) -> None:
        """magicgui makes the list anew when a form is put somewhere; what it shows stays."""
        super().reset_choices()
        self._show()

    def _on_chosen(self, _index: int) -> None:
        name = self.source.value
        with errors_reported():
            if name == FROM_FILE:
                path, _ = QFileDialog.getOpenFileName(self.native, "Believed model", filter="Model (*.json)")
                if path:
                    self.set_value(Path(path))
            elif name == FROM_LAYER and self.session.has_viewer:
                self.session.take_model_of_movie()
            else:
                self.set_value(None if name == FROM_LAYER else name)
        self._show()

    def _save(self) -> None:
        with errors_reported():
            if self.value is None:
                raise MufasaError("no model is chosen: choose one first")
            path, _ = QFileDialog.getSaveFileName(self.native, "Save model", "model.json", filter="Model (*.json)")
            if path:
                self.value.to_json(path)

    def _leave(self, *_: Any) -> None:
        with contextlib.suppress(TypeError, RuntimeError):  # already gone
            self.session.model_changed.disconnect(self._show)

    def _show(self) -> None:
        """The source in the list, or in its place the words for one that is not in it; and what the model is."""
        model, words, shown = self.get_value(), "", FROM_LAYER
        combo, origin = self.source.native, self.session.model_origin
        if model is not None:
            effects = ", ".join((effect.title or effect.kind).lower() for effect in model.effects)
            words = f"{origin} · {model.protocol}, {model.camera.type}" + (f" · with {effects}" if effects else "")
            shown = FROM_LAYER if origin.startswith("metadata of") else origin.removeprefix("preset ")
            combo.setPlaceholderText(origin)
        blocked = combo.blockSignals(True)
        combo.setCurrentIndex(combo.findText(shown))  # -1 shows the placeholder
        combo.blockSignals(blocked)
        self.origin.say(words)
        self.changed.emit(model)
