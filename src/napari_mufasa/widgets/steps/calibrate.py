"""Calibrate (step Camera): the camera of every later step, typed in or measured on the movie."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

from napari_mufasa.calibrate.measure import Calibration, CameraType
from napari_mufasa.widgets.parts.edits import NumberEdit
from napari_mufasa.widgets.parts.forms import step_form
from napari_mufasa.widgets.parts.model_edit import ModelEdit
from napari_mufasa.widgets.parts.panel import Panel, section, wrapped
from napari_mufasa.widgets.parts.parameters import Dark, DarkFrames, Movie
from napari_mufasa.widgets.parts.part_editor import PartEditor
from napari_mufasa.widgets.turns.session import measurement_of
from napari_mufasa.widgets.turns.steering import steering

if TYPE_CHECKING:
    from magicgui.widgets import FunctionGui
    from napari.viewer import Viewer

TIMING = ("frame_length_s", "frame_interval_s", "pixel_size_nm")
NUMBER: dict[str, Any] = {"widget_type": NumberEdit, "min": 0}


def calibrate(
    movie: Movie,
    dark: Dark = None,
    dark_frames: DarkFrames = 0,
    camera_type: Annotated[CameraType, {"label": "Type", "tooltip": "An EM register doubles the variance"}] = "EMCCD",
    em_gain: Annotated[
        float | None,
        NUMBER | {"label": "EM gain", "min": 1, "empty": "300 for an EMCCD", "tooltip": "If it is known"},
    ] = None,
    electrons_per_adu: Annotated[
        float | None,
        NUMBER | {
            "label": "Electrons per count", "empty": "from the EM gain",
            "tooltip": "Photon transfer measures only its ratio to the EM gain: give one of them",
        },
    ] = None,
    quantum_efficiency: Annotated[
        float, NUMBER | {"label": "Quantum efficiency", "max": 1, "tooltip": "Photoelectrons per photon, as stated"}
    ] = 0.9,
    baseline_adu: Annotated[
        float | None, NUMBER | {"label": "Baseline (ADU)", "empty": "measured", "tooltip": "Instead of dark frames"}
    ] = None,
    read_noise_adu: Annotated[
        float | None, NUMBER | {"label": "Read noise (ADU)", "empty": "measured", "tooltip": "Instead of dark frames"}
    ] = None,
) -> Calibration:  # fmt: skip
    """Measure the camera on a movie under steady light and its dark frames.

    Returns the `Calibration`: values with their errors, and a `Camera` that a model can take.
    """
    from napari_mufasa.calibrate.measure import calibrate as run

    progress, cancel = steering()
    measurement = measurement_of(movie, dark, dark_frames).recorded()
    return run(
        measurement.movie, measurement.dark, camera_type=camera_type, em_gain=em_gain,
        electrons_per_adu=electrons_per_adu, quantum_efficiency=quantum_efficiency, baseline_adu=baseline_adu,
        read_noise_adu=read_noise_adu, progress=progress, cancel=cancel,
    )  # fmt: skip


def calibrate_widget(viewer: Viewer | None = None, call_button: Any = "Measure") -> FunctionGui[..., Any]:
    return step_form(calibrate, viewer, call_button)


class CameraPanel(Panel):
    words = "The camera that recorded the movie. It is used in every later step."
    run_label, running, needs = "Measure it on the movie", "Measuring the camera", "counts"
    form_factory = calibrate_widget
    hidden = ("dark_frames", "camera_type")

    def build(self) -> None:
        self.source = ModelEdit()
        self.source.follow(self.session)
        self.editor = PartEditor(self.session, "camera")
        self.timing = PartEditor(self.session, "acquisition", TIMING)
        self.result = wrapped()
        self.result.hide()
        self.add(self.source.native, self.editor, section("Timing and pixels", self.timing))
        self.add(wrapped("<b>Measure it</b> where its values are not known: steady light, dark frames"))
        self.add(self.form.native, self.run_bar, self.result)
        self.column.addStretch(1)
        self.session.model_changed.connect(self._refresh)
        self._refresh()

    def take(self, found: Calibration) -> None:
        """What was measured is the camera from now on."""
        origin = self.session.model_origin.removesuffix(" (measured)")
        model = self.session.model.model_copy(update={"camera": found.camera})
        self.session.set_model(model, f"{origin} (measured)")
        self.result.setText(
            f"Measured: {found.adu_per_photoelectron} ADU per photoelectron, baseline {found.baseline_adu} ADU, "
            f"read noise {found.read_noise_adu} ADU.<br>" + "<br>".join(found.notes)
        )
        self.result.show()
        self.session.set_result("calibration", found)

    def _refresh(self) -> None:
        self.form.camera_type.value = self.session.model.camera.type
