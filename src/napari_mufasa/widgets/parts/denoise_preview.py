"""The live preview of the Denoise widget: the current frame, before and after, and what was taken away."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from qtpy.QtCore import Qt, QTimer
from qtpy.QtWidgets import QCheckBox, QHBoxLayout, QSlider, QVBoxLayout, QWidget

from napari_mufasa.errors import MufasaError
from napari_mufasa.files.movies import METADATA_KEY
from napari_mufasa.widgets.parts.edits import PLACE
from napari_mufasa.widgets.parts.layers import like
from napari_mufasa.widgets.parts.panel import boxed, wrapped
from napari_mufasa.widgets.turns.gently import NEXT_TURN_MS, gently
from napari_mufasa.widgets.turns.jobs import report_error
from napari_mufasa.widgets.turns.latest import Latest

if TYPE_CHECKING:
    from napari_mufasa.denoise.pipeline import Method
    from napari_mufasa.denoise.preview import Look, Preview
    from napari_mufasa.widgets.turns.session import Session

WAIT_MS = 40
SHOWN, TAKEN = "preview: before | after", "preview: taken away"


class PreviewBox(QWidget):
    """A switch, the place of the border between before and after, and the estimated gain in words."""

    def __init__(self, session: Session, settings: Callable[[], tuple[Method, bool]]) -> None:
        super().__init__()
        self.session, self.settings = session, settings
        self.look: Look | None = None
        self._ready: tuple[Any, Preview] | None = None
        self._latest = Latest(WAIT_MS, self)
        self._latest.arrived.connect(self._on_arrived)
        self._again = QTimer(self)
        self._again.setSingleShot(True)
        self._again.setInterval(NEXT_TURN_MS)
        self._again.timeout.connect(self._show)
        self.switch = QCheckBox("Preview on this frame")
        self.switch.setToolTip("Denoises the frame in view, and each one you go to")
        self.split = QSlider(Qt.Orientation.Horizontal)
        self.split.setRange(0, 100)
        self.split.setValue(50)
        self.split.setToolTip("Left of here the recorded frame, right of it the denoised one")
        self.split.setAccessibleName("Border between before and after")
        self.words = wrapped()
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addWidget(boxed((self.switch, self.split), QHBoxLayout()))
        layout.addWidget(self.words)
        self.split.hide()
        self.words.hide()
        self.switch.toggled.connect(self._on_switched)
        self.split.valueChanged.connect(self._show)
        self._dims = session.viewer.dims
        self._dims.events.current_step.connect(self.refresh)
        self.destroyed.connect(lambda: self._latest.drop())

    def refresh(self, _event: Any = None) -> None:
        """Ask for the frame in view, if the preview is on."""
        if not self.switch.isChecked():
            return
        if self._ready is not None and self.session.movie_layer is None:
            self.switch.setChecked(False)  # the movie was removed, or the viewer is closing
            return
        try:
            measurement = self.session.measurement().recorded()
        except MufasaError as error:
            self.switch.setChecked(False)
            report_error(error)
            return
        method, excess = self.settings()
        camera, movie = self.session.model.camera, measurement.movie
        frame = int(np.clip(self._dims.current_step[0] - measurement.first_frame, 0, movie.shape[0] - 1))
        key = (id(movie), movie.shape, measurement.first_frame, camera.model_dump_json(), method, excess)
        if self._ready is None or self._ready[0] != key:
            self.words.setText("Learning from the movie …")

        def work(cancel: Callable[[], bool]) -> tuple[Any, Preview, Look]:
            from napari_mufasa.denoise.preview import Preview

            ready = self._ready
            preview = ready[1] if ready is not None and ready[0] == key else None
            if preview is None:
                preview = Preview(movie, camera, method, excess, cancel)
            return key, preview, preview.look(frame)

        self._latest.request(work)

    def _on_arrived(self, outcome: Any) -> None:
        if not self.switch.isChecked():
            return
        if outcome.error is not None:
            self.switch.setChecked(False)
            report_error(outcome.error)
            return
        key, preview, self.look = outcome.value
        self._ready = (key, preview)
        gain = preview.gain_db
        self.words.setText(
            f"Estimated gain in PSNR: {gain:.1f} dB" if gain > 0 else "This method tells no estimate of its gain."
        )
        self._show()

    def _on_switched(self, on: bool) -> None:
        self.split.setVisible(on)
        self.words.setVisible(on)
        if on:
            self.refresh()
            return
        self._latest.drop()
        self.look = None
        layers = self.session.viewer.layers
        for name in (SHOWN, TAKEN):
            if name in layers:
                layers.remove(name)

    def _show(self, _value: int = 0) -> None:
        layer = self.session.movie_layer
        if self.look is None or layer is None:
            return
        picture, taken = self.look.split(self.split.value() / 100), self.look.residual
        layers = self.session.viewer.layers
        # Neither is ever offered as the movie, like the pictures of where a model fails.
        shared: dict[str, Any] = {key: tuple(value)[-2:] for key, value in like(layer).items()}
        shared |= {"metadata": {METADATA_KEY: {"role": PLACE}}, "colormap": "gray"}
        for name, data in ((TAKEN, taken), (SHOWN, picture)):
            if name in layers and layers[name].data.shape == data.shape:
                layers[name].data = data
                continue
            if name in layers:
                layers.remove(name)
            limits = self._contrast(name)
            with gently(self.session.viewer):
                self.session.viewer.add_image(data, name=name, contrast_limits=limits, visible=name == SHOWN, **shared)
            self._again.start()  # the other one in the next turn
            return

    def _contrast(self, name: str) -> tuple[float, float]:
        assert self.look is not None
        if name == TAKEN:
            spread = 3 * float(np.std(self.look.residual)) + 1e-6
            return -spread, spread
        low, high = np.percentile(self.look.after, (0.5, 99.9))
        return float(low), float(max(high, low + 1e-6))
