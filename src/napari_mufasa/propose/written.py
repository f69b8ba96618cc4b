"""A model with what the recording software wrote about the instrument in place of what was believed."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from napari_mufasa.calibrate.measure import CameraType
from napari_mufasa.files.instrument import Instrument
from napari_mufasa.model.cameras import camera_type_of
from napari_mufasa.model.model import Model


def camera_told(
    written: Instrument, camera_type: CameraType | None, em_gain: float | None
) -> tuple[CameraType | None, float | None, list[str]]:
    """Type and EM gain of the camera by what the user gives (`camera_type`, `em_gain`) and by the metadata, None where
    the counts must tell, and words for what the metadata leave open.

    A name can say that a camera has a register, only an EM gain above 1 that it multiplied: read out through the
    conventional amplifier, or at a gain of 1, its electrons are those of a CCD.
    """
    named = camera_type_of(written.camera)
    kind = camera_type or (None if named == "EMCCD" else named)
    if kind in ("CCD", "CMOS"):
        return kind, em_gain, []
    gain = written.register_gain if em_gain is None else em_gain
    if gain is not None and not (gain == 1 and em_gain is None and camera_type is not None):
        off = em_gain is None and written.register == "off"
        words = ["the metadata say that the electrons did not pass the EM register, or that it was off"] if off else []
        return (None if gain == 1 else "EMCCD"), gain, words
    if kind is not None:
        return kind, None, []
    said = [f"a camera that has an EM register ({written.camera})"] if named == "EMCCD" else []
    said += [f"a gain of {written.gain:g}"] if (written.gain or 0) > 1 else []
    open_words = (
        f"the metadata tell of {' and '.join(said)}, but of no EM gain: the counts decide; give it if you know it"
    )
    return None, None, [open_words] if said else []


def values_written(model: Model, written: Instrument) -> dict[str, Any]:
    """The values of a model (dotted path → value) that the metadata say otherwise; empty where they agree, or say
    nothing. A setting is no measurement: an EM gain above 1 is taken, for EMCCD cameras only, the baseline never."""
    timing = model.acquisition
    exposure_s = written.exposure_s or (written.interval_s if timing.frame_interval_s is None else None)
    said: dict[str, Any] = {}
    if written.pixel_size_nm is not None:
        said["acquisition.pixel_size_nm"] = written.pixel_size_nm
    if exposure_s is not None:
        said["acquisition.frame_length_s"] = exposure_s
        longer = written.interval_s is not None and written.interval_s > exposure_s * (1 + 1e-6)
        said["acquisition.frame_interval_s"] = written.interval_s if longer else None
    if (written.register_gain or 1.0) > 1 and model.camera.type == "EMCCD":
        said["camera.em_gain"] = written.register_gain
    believed = {
        "acquisition.pixel_size_nm": timing.pixel_size_nm, "acquisition.frame_length_s": timing.frame_length_s,
        "acquisition.frame_interval_s": timing.frame_interval_s, "camera.em_gain": model.camera.em_gain,
    }  # fmt: skip
    return {path: value for path, value in said.items() if not _same(believed[path], value)}


def stated(written: Instrument, own: Model | None) -> Instrument:
    """What the recording software wrote, and of a movie that carries its own model also that model's timing, pixel size
    and wavelength; never its camera, which is measured."""
    if own is None:
        return written
    timing = own.acquisition
    return replace(
        written, pixel_size_nm=timing.pixel_size_nm, exposure_s=timing.frame_length_s,
        interval_s=timing.frame_interval_s, wavelength_nm=own.excitation.wavelength_nm,
    )  # fmt: skip


def _same(one: float | None, other: float | None) -> bool:
    return one == other or (one is not None and other is not None and abs(one / other - 1) < 1e-6)


def as_written(model: Model, written: Instrument) -> Model:
    """The model with those values."""
    return model.with_values(values_written(model, written))
