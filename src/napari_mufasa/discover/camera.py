"""The camera first: a gain or read noise that is not as believed, told from effects that look like it.

An aged EM register, or a wrong setting in a file, puts a gain off by far more than data sheets err. All variance is off
then, and effects that make variance would be named in its place.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from napari_mufasa.discover import library, nuisance
from napari_mufasa.discover.library import Library
from napari_mufasa.discover.null import Null
from napari_mufasa.discover.rules import CAMERA_OFF, NEAR, OFF_DATA_SHEET
from napari_mufasa.discover.start import started
from napari_mufasa.discover.state import Array, State
from napari_mufasa.effects import effect_class
from napari_mufasa.model.model import Model
from napari_mufasa.observe import photoelectrons_per_adu

GAIN, READ_NOISE = "camera.electrons_per_adu", "camera.read_noise_e"
REGISTER = "em_excess_noise"  # changes variance as a gain does, but not how skewed counts are


def set_right(state: State, x: Array, least: float = CAMERA_OFF) -> Model:
    """The state's model, gain and read noise moved to where all observables x (part, observable) together put them, if
    that is farther off than `least` (log units); itself where neither is."""
    values = tuple(replace(n, prior=OFF_DATA_SHEET) if n.path in (GAIN, READ_NOISE) else n for n in state.values)
    free = replace(state, values=values, prior=np.array([*(n.prior for n in values), *state.prior[len(values) :]]))
    moves = free.adjusted(x).moves[: len(values)]
    far = [m if n.path in (GAIN, READ_NOISE) and abs(m) > least else 0.0 for n, m in zip(values, moves, strict=True)]
    return nuisance.apply(state.model, values, far) if any(far) else state.model


def may_be_register(model: Model) -> bool:
    """Whether the noise of a register that the camera may have could be other than believed."""
    return effect_class(REGISTER).suits(model) and all(effect.kind != REGISTER for effect in model.effects)


def is_register(near: Library, believed: Library, x: Array) -> bool:
    """Is it not the gain, set right in `near`, but the excess noise of the register that is not as it was `believed`?
    The right gain leaves nothing of the other. Where much else is wrong, what it leaves is to be as from the model
    believed, more or less noise, and likelier there."""
    near, believed = (library.with_rays(each, [REGISTER]) for each in (near, believed))
    there, here = (each.base.screen(x, {REGISTER: each.rays[REGISTER]})[REGISTER] for each in (near, believed))
    if there[0].gain < Null.of(*near.null_distribution()).needed(REGISTER):
        return False
    if not near.base.far_off(x):
        return True
    noisier = started(believed, believed.base, here, x)
    return there[0].rises == here[0].rises and noisier.score(x) < near.base.score(x) - NEAR


def with_camera_of(model: Model, other: Model) -> Model:
    """The model with the gain and read noise of another, and as much light for each count."""
    ratio = photoelectrons_per_adu(other) / photoelectrons_per_adu(model)
    return model.with_values(
        {
            GAIN: other.camera.electrons_per_adu,
            READ_NOISE: other.camera.read_noise_e,
            "optics.brightness_correction": model.optics.brightness_correction * ratio,
            "optics.background_photons_per_px": model.optics.background_photons_per_px * ratio,
        }
    )


def known_from(state: State, model: Model) -> State:
    """The state whose gain and read noise are looked for about where they are in another model."""
    at = {GAIN: model.camera.electrons_per_adu, READ_NOISE: model.camera.read_noise_e}
    return replace(state, values=tuple(replace(n, origin=at.get(n.path, n.origin)) for n in state.values))


def is_off(state: State) -> bool:
    """Whether gain or read noise are looked for elsewhere than where they are believed."""
    return any(n.path in (GAIN, READ_NOISE) and n.origin != n.believed for n in state.values)


def contradicted(believed: Model, found: Model) -> str:
    """What of the camera was found far from what is believed, in what a movie shows: photoelectrons per count, noise in
    counts; "" where nothing is."""
    shown = (
        ("{:.3g} photoelectrons per ADU", photoelectrons_per_adu),
        ("a read noise of {:.3g} ADU", lambda model: model.camera.read_noise_e / model.camera.electrons_per_adu),
    )
    pairs = [(words, value_of(found), value_of(believed)) for words, value_of in shown]
    far = [pair for pair in pairs if min(pair[1:]) > 0 and abs(np.log(pair[1] / pair[2])) > CAMERA_OFF]
    return " and ".join(f"{words.format(now)}, not {was:.3g}" for words, now, was in far)
