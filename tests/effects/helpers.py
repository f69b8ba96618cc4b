"""A small model without bleaching, blinking or background to hang effects on, and the scene it makes."""

import types

import numpy as np

from napari_mufasa import preset
from napari_mufasa.chance.streams import Streams
from napari_mufasa.effects import catalogue
from napari_mufasa.simulate.scene import build_scene


def plain(n_frames=40, frame_length_s=0.01, shape=(32, 40), **values):
    """FF with steady molecules: 67.25 photons per 10 ms."""
    base = {
        "acquisition.n_frames": n_frames,
        "acquisition.frame_length_s": frame_length_s,
        "acquisition.shape_px": list(shape),
        "fluorophore.cycles_before_bleaching": None,
        "sample.n_molecules": 6,
        "camera.electrons_per_adu": 12.0,
    }
    return preset("FF").with_values(base | values)


def ccd(**values):
    """`plain` with a quiet CCD: one electron per count, no read noise, so that ADU are electrons."""
    data = plain().to_dict()
    data["camera"] |= {"type": "CCD", "em_gain": None, "read_noise_e": 0.0, "electrons_per_adu": 1.0}
    data["camera"] |= {"clock_induced_charge_e": 0.0, "quantum_efficiency": 1.0, "baseline_adu": 100}
    return type(plain()).from_dict(data).with_values(values)


def cmos(**values):
    """`plain` with a CMOS camera."""
    data = plain().to_dict()
    data["camera"] |= {"type": "CMOS", "em_gain": None, "read_noise_e": 2.0, "electrons_per_adu": 1.0}
    return type(plain()).from_dict(data).with_values(values)


def effect(kind, **values):
    return catalogue()[kind](**values)


def scene_of(model, positions=((15.0, 20.0),), seed=1):
    return build_scene(model, np.array(positions, float).reshape(-1, 2), Streams(seed))


def still_spots(course):
    """A background whose light changes beside spots whose light does not."""
    return types.SimpleNamespace(course=course, together=lambda: np.zeros(len(course)))
