"""The Denoise widget: counts in, photons out."""

from __future__ import annotations

import tempfile
from collections.abc import Generator
from typing import Any

import numpy as np
from qtpy.QtWidgets import QCheckBox, QComboBox, QFormLayout

from napari_mufasa.denoise.pipeline import Method
from napari_mufasa.widgets.parts.denoise_preview import PreviewBox
from napari_mufasa.widgets.parts.layers import add_movie, like, slim
from napari_mufasa.widgets.parts.panel import MovieChooser, Panel
from napari_mufasa.widgets.turns.gently import shown_later

METHODS: dict[str, Method] = {
    "PURE-LET, past and future frames": "pure-let-movie",
    "PURE-LET, frame by frame": "pure-let",
    "PURE-LET, frame by frame, like patches": "pure-let-patches",
    "recipe of the source note": "source",
    "camera's inverse only": "none",
}
IN_USE = "as set below"
MEASURED = "measure on this movie"
#: Typical cameras to start from; electrons per count and baseline are on the camera's data sheet.
CAMERAS: dict[str, dict[str, Any]] = {
    "EMCCD, gain 300": {
        "type": "EMCCD", "quantum_efficiency": 0.9, "read_noise_e": 50.0, "clock_induced_charge_e": 0.002,
        "electrons_per_adu": 12.0, "baseline_adu": 200.0, "em_gain": 300.0,
    },
    "sCMOS, linear": {
        "type": "CMOS", "quantum_efficiency": 0.8, "read_noise_e": 1.6, "electrons_per_adu": 0.46,
        "baseline_adu": 100.0, "cmos_gain_curve": ((0.0, 0.0), (1.0, 1.0)),
    },
    "CCD": {
        "type": "CCD", "quantum_efficiency": 0.7, "read_noise_e": 6.0, "electrons_per_adu": 1.0, "baseline_adu": 100.0,
    },
}  # fmt: skip
#: Results larger than this are written to a temporary zarr store and shown from there.
IN_MEMORY_BYTES = 2**30


class DenoisePanel(Panel):
    """Over `napari_mufasa.denoise`."""

    title = "Denoise"
    words = "Run the camera backwards: from counts to photons per pixel, the camera's noise removed."
    run_label = "Denoise"

    def build(self) -> None:
        from napari_mufasa.widgets.steps.model import ModelSource, PartEditor, section

        self.chooser = MovieChooser(self.session, dark=False)
        self.column.addWidget(self.chooser)
        self.source = ModelSource(self.session)
        self.column.addWidget(self.source)
        self.preset = QComboBox()
        self.preset.addItems([IN_USE, *CAMERAS, MEASURED])
        slim(self.preset)
        self.preset.setToolTip("A typical camera to start from, or this one, measured on the movie and its dark frames")
        self.preset.activated.connect(self._on_preset)
        self.method = QComboBox()
        self.method.addItems(list(METHODS))
        slim(self.method)
        self.method.setToolTip("The first is best on movies, the third on single frames; the others are to compare")
        form = QFormLayout()
        form.addRow("Camera", self.preset)
        form.addRow("Method", self.method)
        self.column.addLayout(form)
        self.column.addWidget(section("Camera", PartEditor(self.session, "camera"), False))
        self.excess = QCheckBox("EM gain adds noise (excess noise)")
        self.excess.setToolTip(
            "An EMCCD's multiplication doubles the variance; untick for the source note's literal way"
        )
        self.excess.setChecked(True)
        self.residual = QCheckBox("Add what was taken away")
        self.residual.setToolTip("A layer of counts (as photons) less the result: it should look like noise")
        self.preview = PreviewBox(self.session, self.settings)
        for widget in (self.excess, self.preview, self.residual, self.run_bar):
            self.column.addWidget(widget)
        self.column.addStretch(1)
        self.session.model_changed.connect(self._refresh)
        self.session.movie_changed.connect(self.preview.refresh)
        self.method.currentIndexChanged.connect(self.preview.refresh)
        self.excess.toggled.connect(self.preview.refresh)
        self._refresh()

    def settings(self) -> tuple[Method, bool]:
        """Method and whether the excess noise counts."""
        return METHODS[self.method.currentText()], self.excess.isChecked()

    def _refresh(self) -> None:
        camera = self.session.model.camera
        self.excess.setVisible(camera.type == "EMCCD")
        named = [name for name, values in CAMERAS.items() if all(getattr(camera, k) == v for k, v in values.items())]
        self.preset.setCurrentText(named[0] if named else IN_USE)
        self.preview.refresh()

    def _on_preset(self, index: int) -> None:
        name = self.preset.itemText(index)
        if name == MEASURED:
            from napari_mufasa.widgets.turns.jobs import guarded

            guarded(self.run_bar, self._measure)
        elif name in CAMERAS:
            from napari_mufasa.model.setup import Camera

            self._set_camera(Camera(**CAMERAS[name]))

    def _set_camera(self, camera: Any) -> None:
        self.session.set_model(self.session.model.model_copy(update={"camera": camera}))

    def _measure(self) -> None:
        measurement, kind = self.session.measurement().recorded(), self.session.model.camera.type

        def work(progress: Any, cancel: Any) -> Any:
            from napari_mufasa.calibrate.measure import calibrate

            return calibrate(measurement.movie, measurement.dark, camera_type=kind, progress=progress, cancel=cancel)

        def done(found: Any) -> None:
            self._set_camera(found.camera)
            self.run_bar.say(
                f"Measured: {found.adu_per_photoelectron} ADU per photoelectron, baseline {found.baseline_adu} ADU."
            )

        self.start("Measuring the camera", work, done)

    def prepare(self) -> None:
        measurement, camera = self.session.measurement().recorded(), self.session.model.camera
        layer = self.session.movie_layer
        assert layer is not None
        space, name = like(layer), measurement.name
        method, excess = self.settings()
        residual = self.residual.isChecked()

        def work(progress: Any, cancel: Any) -> Any:
            from napari_mufasa.denoise import denoise

            out = store_for(measurement.movie.shape)
            result = denoise(
                measurement.movie, camera, method=method, excess_noise=excess, progress=progress, cancel=cancel, out=out
            )
            return lazily(result)

        def done(photons: Any) -> Generator[None, None, None]:
            self.preview.switch.setChecked(False)
            yield
            if residual:
                taken = taken_away(measurement.movie, camera, photons)
                add_movie(self.viewer, taken, f"{name}, taken away", space, role="photons", visible=False)
                yield
            result = add_movie(self.viewer, photons, f"{name}, photons", space, role="photons", visible=False)
            yield from shown_later(self.viewer, result)
            self.session.set_result("denoised", True)
            self.run_bar.say("Added: photons per pixel and frame.")

        self.start("Denoising", work, done)


def store_for(shape: tuple[int, ...]) -> Any:
    """A zarr array in a temporary folder for results that are better not held in memory; None for the others."""
    if 4 * int(np.prod(shape, dtype=np.int64)) <= IN_MEMORY_BYTES:
        return None
    import zarr

    folder = tempfile.mkdtemp(prefix="mufasa-denoised-")
    chunks = (min(16, shape[0]), *shape[1:])
    return zarr.open(folder, mode="w", shape=shape, chunks=chunks, dtype="f4")


def lazily(result: Any) -> Any:
    """Stored results as dask, so that the viewer reads the frame it shows."""
    if isinstance(result, np.ndarray):
        return result
    import dask.array

    da: Any = dask.array  # its functions carry no types

    return da.from_array(result, chunks=(1, *result.shape[1:]))


def taken_away(movie: Any, camera: Any, photons: Any) -> Any:
    """Recorded frames as photons less the denoised ones, frame by frame when looked at."""
    import dask.array

    da: Any = dask.array  # its functions carry no types

    from napari_mufasa import camera as cam

    one_frame = (1, *photons.shape[1:])
    counts, after = da.asarray(movie).rechunk(one_frame), da.asarray(photons).rechunk(one_frame)

    def difference(recorded: Any, denoised: Any) -> Any:
        return np.asarray(cam.photons(cam.photoelectrons(recorded, camera), camera) - denoised, np.float32)

    return da.map_blocks(difference, counts, after, dtype=np.float32)
