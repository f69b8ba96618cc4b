"""Denoise: counts in, photons out."""

from __future__ import annotations

from collections.abc import Generator
from typing import TYPE_CHECKING, Annotated, Any

from magicgui.widgets import ComboBox
from napari.layers import Layer

from napari_mufasa.denoise.pipeline import Method
from napari_mufasa.model.cameras import CAMERAS
from napari_mufasa.widgets.parts.denoise_preview import PreviewBox
from napari_mufasa.widgets.parts.forms import dress, step_form
from napari_mufasa.widgets.parts.layers import added, movie_layer, space_of
from napari_mufasa.widgets.parts.panel import Panel, section
from napari_mufasa.widgets.parts.parameters import Believed, Dark, DarkFrames, Movie
from napari_mufasa.widgets.parts.part_editor import PartEditor
from napari_mufasa.widgets.turns.jobs import guarded
from napari_mufasa.widgets.turns.session import measurement_of, model_in
from napari_mufasa.widgets.turns.steering import steering

if TYPE_CHECKING:
    from magicgui.widgets import FunctionGui
    from napari.viewer import Viewer

METHODS = [
    ("PURE-LET, past and future frames", "pure-let-movie"),
    ("PURE-LET, frame by frame", "pure-let"),
    ("PURE-LET, frame by frame, like patches", "pure-let-patches"),
    ("recipe of the source note", "source"),
    ("camera's inverse only", "none"),
]
IN_USE = "as set below"
MEASURED = "measure on this movie"


def denoise(
    movie: Movie,
    dark: Dark = None,
    dark_frames: DarkFrames = 0,
    model: Believed = None,
    method: Annotated[
        Method,
        {
            "label": "Method", "widget_type": "ComboBox", "choices": METHODS,
            "tooltip": "The first is best on movies, the third on single frames; the others are to compare",
        },
    ] = "pure-let-movie",
    excess_noise: Annotated[
        bool,
        {
            "label": "EM gain adds noise (excess noise)",
            "tooltip": "An EMCCD's multiplication doubles the variance; untick for the source note's literal way",
        },
    ] = True,
    residual: Annotated[
        bool,
        {
            "label": "Add what was taken away",
            "tooltip": "A layer of counts (as photons) less the result: it should look like noise",
        },
    ] = False,
) -> list[Layer]:  # fmt: skip
    """Run the model's camera backwards: from counts to photons per pixel, the camera's noise removed.

    Without a model, here and in the movie's metadata, the camera is measured on the movie and its dark frames.
    Returns, as they lie on each other: what was taken away, the photons.
    """
    from napari_mufasa.denoise.pipeline import denoise as run
    from napari_mufasa.denoise.pipeline import measured_camera
    from napari_mufasa.denoise.viewing import lazily, store_for, taken_away

    progress, cancel = steering()
    measurement = measurement_of(movie, dark, dark_frames).recorded()
    model = model if model is not None else model_in(movie)
    camera = model.camera if model is not None else measured_camera(measurement.movie, measurement.dark, cancel)
    photons = lazily(
        run(
            measurement.movie, camera, method=method, excess_noise=excess_noise, progress=progress, cancel=cancel,
            out=store_for(measurement.movie.shape),
        )
    )  # fmt: skip
    name, space, role = movie.name, space_of(movie, measurement.first_frame), {"role": "photons"}
    layers: list[Layer] = [movie_layer(photons, f"{name}, photons", space, ours=role)]
    if residual:
        taken = taken_away(measurement.movie, camera, photons)
        layers.insert(0, movie_layer(taken, f"{name}, taken away", space, ours=role, visible=False))
    return layers


def denoise_widget(viewer: Viewer | None = None, call_button: Any = "Denoise") -> FunctionGui[..., Any]:
    return step_form(denoise, viewer, call_button)


class DenoisePanel(Panel):
    words = "Run the camera backwards: from counts to photons per pixel, the camera's noise removed."
    run_label, running, needs = "Denoise", "Denoising", "counts"
    form_factory = denoise_widget
    hidden = ("dark", "dark_frames")

    def build(self) -> None:
        self.preset = ComboBox(
            label="Camera", choices=[IN_USE, *CAMERAS, MEASURED],
            tooltip="A typical camera to start from, or this one, measured on the movie and its dark frames",
        )  # fmt: skip
        self.preset.native.activated.connect(self._on_preset)
        self.form.insert(list(self.form.asdict()).index("method"), self.preset)
        dress(self.form)
        self.preview = PreviewBox(self.session, self.settings)
        self.add(self.form.native, section("Camera", PartEditor(self.session, "camera")), self.preview, self.run_bar)
        self.column.addStretch(1)
        self.session.model_changed.connect(self._refresh)
        self.session.movie_changed.connect(self.preview.refresh)
        self.form.method.changed.connect(self.preview.refresh)
        self.form.excess_noise.changed.connect(self.preview.refresh)
        self._refresh()

    def settings(self) -> tuple[Method, bool]:
        """Method and whether the excess noise counts."""
        return self.form.method.value, self.form.excess_noise.value

    def take(self, layers: list[Any]) -> Generator[None, None, None]:
        self.preview.switch.setChecked(False)
        yield
        yield from added(self.viewer, layers)
        self.session.set_result("denoised", True)
        self.run_bar.say("Added: photons per pixel and frame.")

    def _refresh(self) -> None:
        camera = self.session.model.camera
        self.form.excess_noise.visible = camera.type == "EMCCD"
        named = [name for name, values in CAMERAS.items() if all(getattr(camera, k) == v for k, v in values.items())]
        self.preset.value = named[0] if named else IN_USE
        self.preview.refresh()

    def _on_preset(self, _index: int) -> None:
        from napari_mufasa.model.setup import Camera

        name: Any = self.preset.value
        if name == MEASURED:
            guarded(self.run_bar, self._measure)
        elif name in CAMERAS:
            self._set_camera(Camera(**CAMERAS[name]))

    def _set_camera(self, camera: Any) -> None:
        self.session.set_model(self.session.model.model_copy(update={"camera": camera}))

    def _measure(self) -> None:
        measurement, kind = self.measurement().recorded(), self.session.model.camera.type

        def work(progress: Any, cancel: Any) -> Any:
            from napari_mufasa.calibrate.measure import calibrate

            return calibrate(measurement.movie, measurement.dark, camera_type=kind, progress=progress, cancel=cancel)

        def done(found: Any) -> None:
            self._set_camera(found.camera)
            self.run_bar.say(
                f"Measured: {found.adu_per_photoelectron} ADU per photoelectron, baseline {found.baseline_adu} ADU."
            )

        self.start("Measuring the camera", work, done)
