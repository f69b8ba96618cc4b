"""Whether a movie and a believed model can belong together: said before anything is made of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from napari_mufasa import checks
from napari_mufasa.calibrate import transfer
from napari_mufasa.calibrate.sample import some_frames, window
from napari_mufasa.camera.detector import multiplication_noise, photoelectrons, read_noise_map_e
from napari_mufasa.camera.readout import undone_noise_power
from napari_mufasa.errors import MufasaError
from napari_mufasa.model.model import Model
from napari_mufasa.model.setup import MAPS, Camera

if TYPE_CHECKING:
    from napari_mufasa.files import Movie
    from napari_mufasa.files.instrument import Instrument

FRAMES, MOST_PX = 48, 2**18  # looked at
PATCH_PX = 5  # over which the darkest pixels are averaged
SURE = 5.0  # standard errors
GAIN_FACTOR = 1.6  # of variance over mean, from which on the gain is said to be wrong
SIZE_FACTOR = 1.05  # of pixel size and frame time


@dataclass(frozen=True)
class Mismatch:
    """`field` of the model (dotted path), what is believed and what the movie says, and words for a user."""

    field: str
    believed: float
    measured: float
    words: str


def mismatches(movie: Any, model: Model, dark: Any = None, instrument: Instrument | None = None) -> list[Mismatch]:
    """Where movie (frame, y, x) and model contradict each other; none: nothing speaks against it.

    Looks at `FRAMES` frames of the movie, and as many dark ones, in the middle of large fields. dark : dark frames,
    instrument : what the recording software wrote; None: unknown. Raises `MufasaError` for what is no movie of finite
    numbers, and dark frames of another region.
    """
    movie = checks.stack(movie, single=True)
    checks.need(model, Model, "model", "give preset(NAME) or Model.from_json(PATH)")
    dark = None if dark is None else checks.dark_stack(dark, movie.shape[1:])
    found: list[Mismatch] = []
    n = int(movie.shape[0])
    start = max(0, (n - FRAMES) // 2)
    part = window(movie.shape[1:], MOST_PX)
    stack = np.asarray(movie[start : start + FRAMES, *part]).astype(np.float32)
    if not np.isfinite(stack).all():
        raise MufasaError("movie has values that are not finite: mask or crop those frames first")
    camera = model.camera
    maps = [getattr(camera, name) for name in MAPS]
    if any(m is not None and m.shape != tuple(movie.shape[1:]) for m in maps):
        return [Mismatch("camera", np.nan, np.nan, "the camera's maps have another shape than the movie's frames")]
    camera = camera.of_part(*part)
    found += _baseline(stack, camera, dark if dark is None else some_frames(dark, FRAMES, part=part))
    if not found:
        found += _gain(stack, camera, start)
    if instrument is not None:
        timing = model.acquisition
        found += _setting("pixel_size_nm", timing.pixel_size_nm, instrument.pixel_size_nm, "pixels of", "nm")
        found += _setting("frame_length_s", timing.frame_length_s, instrument.exposure_s, "exposures of", "s")
    return found


def differences(movie: Movie, model: Model) -> list[str]:
    """What a movie's shape and metadata say otherwise than the model, and which of them is used, in words."""
    found = []
    timing, used = model.acquisition, "the model's value is used"
    n_frames, height, width = movie.data.shape
    if (n_frames, height, width) != (timing.n_frames, *timing.shape_px):
        said = f"{checks.counted(timing.n_frames, 'frame')} of {timing.shape_px[0]} × {timing.shape_px[1]} px"
        has = f"{checks.counted(n_frames, 'frame')} of {height} × {width} px"
        found.append(f"the movie has {has}, the model says {said}: the movie's values are used")
    size_nm = movie.pixel_size_nm
    if size_nm is not None and abs(size_nm / timing.pixel_size_nm - 1) > 0.01:
        found.append(f"the movie's pixels are {size_nm:g} nm, the model's {timing.pixel_size_nm:g} nm: {used}")
    exposure_s, gain = movie.instrument.exposure_s, movie.instrument.register_gain
    if exposure_s is not None and abs(exposure_s / timing.frame_length_s - 1) > 0.01:
        said = f"{1000 * exposure_s:g} ms, the model says {1000 * timing.frame_length_s:g} ms"
        found.append(f"the movie was exposed for {said}: {used}")
    if gain is not None and model.camera.em_gain and abs(gain / model.camera.em_gain - 1) > 0.5:
        found.append(f"the movie's EM gain was set to {gain:g}, the model says {model.camera.em_gain:g}: {used}")
    return found


def _baseline(stack: NDArray[np.float32], camera: Camera, dark: NDArray[Any] | None) -> list[Mismatch]:
    base = camera.baseline_adu - 0.5
    if dark is not None:
        level = float(np.mean(dark, dtype=np.float64))
        gain = camera.em_gain or 1.0
        spurious_e = camera.clock_induced_charge_e * gain + camera.read_noise_mean_e
        expected = base + spurious_e / camera.electrons_per_adu
        if camera.offset_map_adu is not None:
            expected += float(np.mean(camera.offset_map_adu))
        noise = float(np.std(dark[0]))
        if abs(level - expected) > max(0.5 * noise, 2.0):
            words = f"the dark frames have {level:.4g} ADU, the model's dark level is {expected:.4g} ADU"
            return [Mismatch("camera.baseline_adu", camera.baseline_adu, level + 0.5, words)]
        return []
    means = stack.mean(axis=0, dtype=np.float64)
    if camera.offset_map_adu is not None:
        means = means - camera.offset_map_adu
    noise = float(np.sqrt(np.median(np.var(stack, axis=0, ddof=1)) / len(stack))) if len(stack) > 1 else 0.0
    if min(means.shape) >= 4 * PATCH_PX:  # of patches: their noise is smaller by as many times as they are wide
        means, noise = uniform_filter(means, PATCH_PX), noise / PATCH_PX
    darkest = float(np.percentile(means, 1))
    # One pixel in a hundred lies 2.3 standard errors low by chance.
    if base > darkest + (SURE + 2.3) * noise + 1.0:
        words = (
            f"the model's baseline is {camera.baseline_adu:.4g} ADU, but the darkest pixels have {darkest:.4g} ADU: "
            "this is another camera, or another setting of it"
        )
        return [Mismatch("camera.baseline_adu", camera.baseline_adu, darkest, words)]
    return []


def _gain(stack: NDArray[np.float32], camera: Camera, first: int) -> list[Mismatch]:
    if len(stack) < 4:
        return []
    electrons = photoelectrons(stack, camera, first)
    mean = electrons.mean(axis=0, dtype=np.float64)
    quiet = transfer.quiet_pixels(mean)
    mean, variance = mean[quiet], np.mean(transfer.second_differences(electrons) ** 2, axis=0)[quiet] / 6
    slope = camera.em_gain or 1.0
    read = float(np.mean(np.square(read_noise_map_e(camera)))) / slope**2 * undone_noise_power(camera)
    rounding = (camera.electrons_per_adu / slope) ** 2 / 12
    level = float(mean.mean())
    light = float(np.median(variance)) - read - rounding
    doubt = float(np.std(variance)) / np.sqrt(len(variance)) + 0.05 * (read + rounding)
    if level <= 0 or light < SURE * doubt or level < 0.2:
        return []
    ratio = light / level / multiplication_noise(camera)
    if 1 / GAIN_FACTOR < ratio < GAIN_FACTOR:
        return []
    believed = slope / camera.electrons_per_adu
    words = (
        f"counts scatter {ratio:.2g} times as the model's gain says: about {believed * ratio:.3g} ADU per "
        f"photoelectron instead of {believed:.3g}"
    )
    return [Mismatch("camera.em_gain", believed, believed * ratio, words)]


def _setting(field: str, believed: float, written: float | None, what: str, unit: str) -> list[Mismatch]:
    if written is None or 1 / SIZE_FACTOR < written / believed < SIZE_FACTOR:
        return []
    words = f"the movie's metadata say {what} {written:.4g} {unit}, the model {believed:.4g} {unit}"
    return [Mismatch(f"acquisition.{field}", believed, written, words)]
