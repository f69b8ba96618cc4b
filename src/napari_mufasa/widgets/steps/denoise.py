"""Denoise: counts in, photons out."""

from collections.abc import Generator
from typing import Annotated, Any

from magicgui import magic_factory
from magicgui.widgets import ComboBox
from napari.layers import Layer

from napari_mufasa.denoise.pipeline import Method
from napari_mufasa.files.layers import measurement_of
from napari_mufasa.model.cameras import CAMERAS
from napari_mufasa.model.setup import Camera
from napari_mufasa.widgets.parts.denoise_preview import PreviewBox
from napari_mufasa.widgets.parts.forms import PartEditor, begin, dress
from napari_mufasa.widgets.parts.layers import added, movie_layer, space_of
from napari_mufasa.widgets.parts.panel import Panel
from napari_mufasa.widgets.parts.parameters import Believed, Dark, DarkFrames, Movie
from napari_mufasa.widgets.parts.pieces import section
from napari_mufasa.widgets.steps.calibrate import believe, calibrate
from napari_mufasa.widgets.turns.session import model_in
from napari_mufasa.widgets.turns.steering import steering

METHODS = [
    ("PURE-LET, over time", "pure-let-movie"),
    ("PURE-LET, each frame", "pure-let"),
    ("PURE-LET, like patches", "pure-let-patches"),
    ("source note's recipe", "source"),
    ("camera's inverse only", "none"),
]
IN_USE = "as set below"
MEASURED = "measure on this movie"


def denoise(
    movie: Movie,
    dark: Dark = None,
    dark_frames: DarkFrames = 0,
    model: Believed = None,
    method: Annotated[Method, {"label": "Method", "widget_type": "ComboBox", "choices": METHODS}] = "pure-let-movie",
    excess_noise: Annotated[bool, {"label": "EM gain adds noise (excess noise)"}] = True,
    residual: Annotated[bool, {"label": "Add what was taken away"}] = False,
) -> list[Layer]:
    """Run the model's camera backwards: from counts to photons per pixel, the camera's noise removed.

    Without a model, here and in the movie's metadata, the camera is measured on the movie and its dark frames.

    Parameters:
        method: Over past and future frames is best on movies, like patches of each frame on single images; the others
            are to compare
        excess_noise: An EMCCD's multiplication doubles the variance; untick for the source note's literal way
        residual: A layer of counts (as photons) less the result: it should look like noise

    Returns:
        As they lie on each other: what was taken away, the photons.
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


denoise_widget = magic_factory(denoise, call_button="Denoise", widget_init=begin)


class DenoisePanel(Panel):
    words = "Run the camera backwards: from counts to photons per pixel, the camera's noise removed."
    run_label, running, needs_counts = "Denoise", "Denoising", True
    form_factory = denoise_widget
    hidden = ("dark", "dark_frames")

    def build(self) -> None:
        self.preset = ComboBox(
            label="Camera", choices=[IN_USE, *CAMERAS, MEASURED],
            tooltip="A typical camera to start from, or this one, measured on the movie and its dark frames",
        )  # fmt: skip
        self.preset.native.activated.connect(lambda _index: self.guarded(self._on_preset))
        self.form.insert(list(self.form.asdict()).index("method"), self.preset)
        dress(self.form)
        self.preview = PreviewBox(self.session, lambda: (self.form.method.value, self.form.excess_noise.value))
        self.add(self.form.native, section("Camera", PartEditor(self.session, "camera")), self.preview, self.run_bar)
        self.column.addStretch(1)
        self.session.model_changed.connect(self._refresh)
        for change in (self.session.movie_changed, self.form.method.changed, self.form.excess_noise.changed):
            change.connect(self.preview.refresh)
        self._refresh()

    def take(self, layers: list[Any]) -> Generator[None, None, None]:
        self.preview.switch.setChecked(False)
        yield
        yield from added(self.viewer, layers)
        self.run_bar.say("Added: photons per pixel and frame.")

    def _refresh(self) -> None:
        camera = self.session.model.camera
        self.form.excess_noise.visible = camera.type == "EMCCD"
        named = [name for name, values in CAMERAS.items() if all(getattr(camera, k) == v for k, v in values.items())]
        self.preset.value = named[0] if named else IN_USE
        self.preview.refresh()

    def _on_preset(self) -> None:
        name: Any = self.preset.value
        if name == MEASURED:
            self.session.measurement().recorded()
            chosen = {key: self.form[key].value for key in ("movie", "dark", "dark_frames")}
            chosen["camera_type"] = self.session.model.camera.type
            say, movie = self.run_bar.say, chosen["movie"].name
            self.run_bar.start(
                "Measuring the camera", lambda: calibrate(**chosen),
                lambda found: say(believe(self.session, movie, found)),
            )  # fmt: skip
        elif name in CAMERAS:
            self.session.set_model(self.session.model.model_copy(update={"camera": Camera(**CAMERAS[name])}))
