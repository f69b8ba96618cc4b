"""The Denoise widget: counts in, photons out."""

from __future__ import annotations

from typing import Any, Literal

from qtpy.QtWidgets import QCheckBox, QComboBox, QFormLayout

from napari_mufasa.widgets.layers import add_movie, like, slim
from napari_mufasa.widgets.panel import MovieChooser, Panel

METHODS: dict[str, Literal["pure-let-movie", "pure-let", "source", "none"]] = {
    "PURE-LET, neighbouring frames": "pure-let-movie",
    "PURE-LET, frame by frame": "pure-let",
    "recipe of the source note": "source",
    "camera's inverse only": "none",
}


class DenoisePanel(Panel):
    """Over `napari_mufasa.denoise`."""

    title = "Denoise"
    words = "Run the camera backwards: from counts to photons per pixel, the camera's noise removed."
    run_label = "Denoise"

    def build(self) -> None:
        from napari_mufasa.widgets.model_panel import ModelSource, PartEditor, section

        self.chooser = MovieChooser(self.session, dark=False)
        self.column.addWidget(self.chooser)
        self.source = ModelSource(self.session)
        self.column.addWidget(self.source)
        self.column.addWidget(section("Camera", PartEditor(self.session, "camera"), False))
        self.method = QComboBox()
        self.method.addItems(list(METHODS))
        slim(self.method)
        self.method.setToolTip("The first is best on movies; the others are for comparison")
        self.excess = QCheckBox("EM gain adds noise (excess noise)")
        self.excess.setToolTip(
            "An EMCCD's multiplication doubles the variance; untick for the source note's literal way"
        )
        self.excess.setChecked(True)
        form = QFormLayout()
        form.addRow("Method", self.method)
        self.column.addLayout(form)
        for widget in (self.excess, self.run_bar):
            self.column.addWidget(widget)
        self.column.addStretch(1)
        self.session.model_changed.connect(self._refresh)
        self._refresh()

    def _refresh(self) -> None:
        self.excess.setVisible(self.session.model.camera.type == "EMCCD")

    def prepare(self) -> None:
        measurement, camera = self.session.measurement().recorded(), self.session.model.camera
        layer = self.session.movie_layer
        assert layer is not None
        space, name = like(layer), measurement.name
        method, excess = METHODS[self.method.currentText()], self.excess.isChecked()

        def work(progress: Any, cancel: Any) -> Any:
            from napari_mufasa.denoise import denoise

            return denoise(
                measurement.movie, camera, method=method, excess_noise=excess, progress=progress, cancel=cancel
            )

        def done(photons: Any) -> None:
            add_movie(self.viewer, photons, f"{name}, photons", space, role="photons")
            self.session.set_result("denoised", True)
            self.run_bar.say("Added: photons per pixel and frame.")

        self.start("Denoising", work, done)
