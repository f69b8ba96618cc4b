"""The live preview of the Denoise widget: the current frame, before and after, and what was taken away."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from napari.layers import Image
from qtpy.QtCore import Qt, QTimer
from qtpy.QtWidgets import QCheckBox, QSlider, QWidget

from napari_mufasa.errors import MufasaError
from napari_mufasa.files.movies import METADATA_KEY
from napari_mufasa.widgets.parts.edits import PLACE
from napari_mufasa.widgets.parts.layers import OwnLayers, plane_of
from napari_mufasa.widgets.parts.pieces import Words, column, made, row
from napari_mufasa.widgets.turns.gently import NEXT_TURN_MS
from napari_mufasa.widgets.turns.jobs import Latest, report_error

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
        self._ready: tuple[Any, Preview | None] = (None, None)  # what the preview learnt from, and the preview
        self._layers = OwnLayers(session.viewer)
        self._made_for: dict[str, Any] = {}  # by layer, the movie it was made for and its place
        self._latest = Latest(WAIT_MS, self)
        self._latest.arrived.connect(self._on_arrived)
        tip = "Denoises the frame in view, and each one you go to"
        self.switch = made(QCheckBox, "Preview on this frame", toolTip=tip, toggled=self._on_switched)
        self.split = made(
            QSlider, Qt.Orientation.Horizontal, maximum=100, value=50, visible=False, valueChanged=self._show,
            toolTip="Left of here the recorded frame, right of it the denoised one",
            accessibleName="Border between before and after",
        )  # fmt: skip
        self.words = Words()
        column(self, row(self.switch, self.split), self.words)
        self._dims = session.viewer.dims
        self._dims.events.current_step.connect(self.refresh)
        self.destroyed.connect(lambda: self._latest.drop())

    def refresh(self, _event: Any = None) -> None:
        """Ask for the frame in view, if the preview is on."""
        if not self.switch.isChecked():
            return
        if self._ready[1] is not None and self.session.movie_layer is None:
            self.switch.setChecked(False)  # the movie was removed, or the viewer is closing
            return
        try:
            measurement = self.session.measurement().recorded()
        except MufasaError as error:
            self._stop(error)
            return
        (method, excess), camera, movie = self.settings(), self.session.model.camera, measurement.movie
        layer: Any = self.session.movie_layer
        shown = round(layer.world_to_data(self._dims.point)[0]) if layer.ndim == 3 else 0
        frame = int(np.clip(shown - measurement.first_frame, 0, movie.shape[0] - 1))
        # What the layer holds, for the movie may be a view of it, another one at each look.
        key = (id(layer.data), movie.shape, measurement.first_frame, camera.model_dump_json(), method, excess)
        known, preview = self._ready
        if known != key:
            preview, self.look = None, None
            self.words.say("Learning from the movie …")

        def work(cancel: Callable[[], bool]) -> tuple[Any, Preview, Look]:
            from napari_mufasa.denoise.preview import Preview

            learnt = preview if preview is not None else Preview(movie, camera, method, excess, cancel)
            return key, learnt, learnt.look(frame)

        self._latest.request(work)

    def _on_arrived(self, outcome: Any) -> None:
        if not self.switch.isChecked():
            return
        if outcome.error is not None:
            self._stop(outcome.error)
            return
        key, preview, self.look = outcome.value
        self._ready, gain = (key, preview), preview.gain_db
        told = f"Estimated gain in PSNR: {gain:.1f} dB"
        self.words.say(told if gain > 0 else "This method tells no estimate of its gain.")
        self._show()

    def _stop(self, error: BaseException) -> None:
        self.switch.setChecked(False)
        report_error(error)

    def _on_switched(self, on: bool) -> None:
        self.split.setVisible(on)
        if on:
            self.refresh()
            return
        self._latest.drop()
        self.words.say("")
        self.look = None
        for name in (SHOWN, TAKEN):
            self._layers.remove(name)

    def _show(self, _value: int = 0) -> None:
        movie, look = self.session.movie_layer, self.look
        if look is None or movie is None:
            return
        made_for = (id(movie.data), plane_of(movie))
        for name, data in ((TAKEN, look.residual), (SHOWN, look.split(self.split.value() / 100))):
            shown = self._layers.get(name)
            if shown is not None and self._made_for[name] == made_for:
                shown.data = data
                continue
            self._layers.remove(name)
            self._made_for[name] = made_for
            # Neither is ever offered as the movie, like the pictures of where a model fails.
            new = Image(
                data, name=name, contrast_limits=_contrast(name, look), colormap="gray", visible=name == SHOWN,
                metadata={METADATA_KEY: {"role": PLACE}}, **plane_of(movie),
            )  # fmt: skip
            self._layers.show(name, new, movie)
            QTimer.singleShot(NEXT_TURN_MS, self._show)  # the other one in the next turn
            return


def _contrast(name: str, look: Look) -> tuple[float, float]:
    if name == TAKEN:
        spread = 3 * float(np.std(look.residual)) + 1e-6
        return -spread, spread
    low, high = np.percentile(look.after, (0.5, 99.9))
    return float(low), float(max(high, low + 1e-6))
