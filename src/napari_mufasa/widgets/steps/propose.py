"""Propose: a first model from the movie itself, in step Camera."""

from magicgui import magic_factory

from napari_mufasa.files.layers import instrument_of, measurement_of, pixel_size_um, stored
from napari_mufasa.model.model import Model
from napari_mufasa.propose import Proposal, stated
from napari_mufasa.widgets.parts.forms import begin
from napari_mufasa.widgets.parts.parameters import Dark, DarkFrames, Efficiency, ElectronsPerAdu, EmGain, Movie
from napari_mufasa.widgets.turns.steering import steering


def propose(
    movie: Movie,
    dark: Dark = None,
    dark_frames: DarkFrames = 0,
    em_gain: EmGain = None,
    electrons_per_adu: ElectronsPerAdu = None,
    quantum_efficiency: Efficiency = 0.9,
) -> Proposal:
    """Propose a first model: metadata, camera, PSF width, background, molecules and their light, on and off times.

    Parameters:
        electrons_per_adu: If it is known

    Returns:
        The `Proposal`: a model with an interval beside each value, and words for what could not be known.
    """
    from napari_mufasa.propose import propose_model

    progress, cancel = steering()
    measured = measurement_of(movie, dark, dark_frames).recorded()
    own = stored(movie, "model")
    known = stated(instrument_of(movie), own if isinstance(own, Model) else Model.stored_in({"model": own}))
    size_um = pixel_size_um(movie.scale, movie.units)
    return propose_model(
        measured.movie, measured.dark, instrument=known, em_gain=em_gain,
        electrons_per_adu=electrons_per_adu, quantum_efficiency=quantum_efficiency,
        pixel_size_nm=1000 * size_um if size_um else None, progress=progress, cancel=cancel,
    )  # fmt: skip


propose_widget = magic_factory(propose, call_button="Propose", widget_init=begin)
