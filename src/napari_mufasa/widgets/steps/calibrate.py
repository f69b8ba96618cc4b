"""Calibrate (step Camera): the camera of every later step, typed in or measured on the movie."""

from functools import partial
from html import escape
from typing import Annotated, Any

from magicgui import magic_factory

from napari_mufasa.calibrate.found import Calibration
from napari_mufasa.calibrate.measure import CameraType
from napari_mufasa.files.layers import measurement_of
from napari_mufasa.propose import Proposal
from napari_mufasa.report.lines import calibration_line, fit_line, proposal_lines
from napari_mufasa.report.offscreen import drawing
from napari_mufasa.widgets.parts.doubts import Doubts
from napari_mufasa.widgets.parts.forms import PartEditor, begin
from napari_mufasa.widgets.parts.model_edit import ModelEdit
from napari_mufasa.widgets.parts.panel import Panel
from napari_mufasa.widgets.parts.parameters import NUMBER, Dark, DarkFrames, Efficiency, ElectronsPerAdu, EmGain, Movie
from napari_mufasa.widgets.parts.pieces import Words, button, into_view, section, timer
from napari_mufasa.widgets.parts.plot import PlotCanvas
from napari_mufasa.widgets.steps.propose import propose
from napari_mufasa.widgets.turns.session import Session
from napari_mufasa.widgets.turns.steering import steering

TIMING = ("frame_length_s", "frame_interval_s", "pixel_size_nm")


def calibrate(
    movie: Movie,
    dark: Dark = None,
    dark_frames: DarkFrames = 0,
    camera_type: Annotated[CameraType | None, {"label": "Type"}] = None,
    em_gain: EmGain = None,
    electrons_per_adu: ElectronsPerAdu = None,
    quantum_efficiency: Efficiency = 0.9,
    baseline_adu: Annotated[float | None, NUMBER | {"label": "Baseline (ADU)", "empty": "measured"}] = None,
    read_noise_adu: Annotated[float | None, NUMBER | {"label": "Read noise (ADU)", "empty": "measured"}] = None,
) -> Calibration:
    """Measure the camera on a movie under steady light and its dark frames.

    Parameters:
        camera_type: An EM register doubles the variance. None: as the counts tell
        electrons_per_adu: Photon transfer measures only its ratio to the EM gain: give one of them
        baseline_adu: Instead of dark frames
        read_noise_adu: Instead of dark frames

    Returns:
        The `Calibration`: values with their errors, and a `Camera` that a model can take.
    """
    from napari_mufasa.calibrate.measure import calibrate as run

    progress, cancel = steering()
    measurement = measurement_of(movie, dark, dark_frames).recorded()
    return run(
        measurement.movie, measurement.dark, camera_type=camera_type, em_gain=em_gain,
        electrons_per_adu=electrons_per_adu, quantum_efficiency=quantum_efficiency, baseline_adu=baseline_adu,
        read_noise_adu=read_noise_adu, progress=progress, cancel=cancel,
    )  # fmt: skip


def _begin(form: Any) -> None:
    begin(form)
    form.camera_type.null_string = "as the counts tell"
    form.camera_type.reset_choices()


calibrate_widget = magic_factory(calibrate, call_button="Measure", widget_init=_begin)


def believe(session: Session, movie: str, found: Calibration) -> str:
    """What was measured on a movie is the camera from now on; says what it is."""
    session.change_model(session.model.model_copy(update={"camera": found.camera}), "measured")
    return calibration_line(found, movie)


class CameraPanel(Panel):
    words = "The camera that recorded the movie. It is used in every later step."
    run_label, running = "Measure it on the movie", "Measuring the camera"
    form_factory = calibrate_widget
    hidden = ("dark_frames",)

    def build(self) -> None:
        self.source = ModelEdit(session=self.session)
        self.editor = PartEditor(self.session, "camera")
        timing = PartEditor(self.session, "acquisition", TIMING)
        self.result = Words()
        self.picture = PlotCanvas(self.viewer, "", 420)
        self.picture.hide()
        self.propose_button = button(
            "Propose a model from this movie", lambda: self.guarded(self.propose),
            "Metadata, camera, PSF width, background, molecules and their light: a model to start from",
        )  # fmt: skip
        self.run_bar.besides.append(self.propose_button)
        self.add(self.source.native, Doubts(self.session, self), self.propose_button, self.editor)
        self.add(section("Timing and pixels", timing))
        self.add(Words("<b>Measure it</b> where its values are not known: steady light, dark frames"))
        self.add(self.form.native, self.run_bar, self.result, self.picture)
        self.column.addStretch(1)
        self.session.model_changed.connect(self._refresh)
        self._refresh()

    def prepare(self) -> None:
        self.session.measurement().recorded()
        self.call(self.running, partial(self.take_camera, self.form.movie.value.name))

    def take_camera(self, movie: str, found: Calibration) -> None:
        """The camera measured on a movie is believed; the panel tells how well it is known."""
        self.result.say("<br>".join((escape(believe(self.session, movie, found)), fit_line(found), *found.notes)))
        self._show(found)

    def propose(self) -> None:
        """Propose a whole model from the movie, with what is given of its camera."""
        self.session.measurement().recorded()
        asked = self.form.asdict()
        names = ("movie", "dark", "dark_frames", "em_gain", "electrons_per_adu", "quantum_efficiency")
        given = {name: asked[name] for name in names}
        done = partial(self.take_proposal, asked["movie"].name)
        self.run_bar.start("Proposing a model", lambda: propose(**given), done)
        into_view(self.run_bar)

    def take_proposal(self, movie: str, found: Proposal) -> None:
        """The model proposed from a movie is believed; the panel tells how far each value is known."""
        self.session.set_model(found.model, f"proposed from {movie}")
        self.result.say(proposal_lines(found, movie))
        self._show(found.calibration)
        timer(self, 50, lambda: into_view(self.result)).start()  # once it has its place

    def _show(self, found: Calibration | None) -> None:
        """The laws against the histograms."""
        self.picture.setVisible(found is not None)
        if found is not None:
            self.picture.draw(drawing("calibration", found, whole=True))

    def _refresh(self) -> None:
        """The type believed, once anyone has said one: that of the model the viewer begins with is no belief."""
        model = self.session.model
        self.form.camera_type.value = model.camera.type if self.session.model_chosen else None
