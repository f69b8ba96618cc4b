"""CCD, EMCCD and CMOS detectors: `expose` (photons → ADU) and its inverse, side by side (docs/camera.md).

The steps are numbered in both directions. Imperfections hook in between the steps (`SensorHooks`); an ideal
sensor has none.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.camera import readout
from napari_mufasa.chance.streams import Streams
from napari_mufasa.errors import MufasaError

if TYPE_CHECKING:
    from napari_mufasa.model.setup import Camera

Stack = NDArray[np.float32]  # (frame, y, x)
Hook = Callable[[Stack, NDArray[np.int64]], Stack]
"""Takes a stack and the frame number of each of its frames; returns the changed stack.

A hook on ``amplified`` may look at earlier frames: `SensorHooks.memory_frames` of them come along."""


@dataclass
class SensorHooks:
    """What a real sensor does beyond the ideal camera, by the step it happens in."""

    expected: list[Hook] = field(default_factory=list)  # expected photoelectrons, before shot noise
    amplified: list[Hook] = field(default_factory=list)  # charge after the register, before a CMOS's curve and read-out
    amplifier: list[Hook] = field(default_factory=list)  # the same electrons on their way through the read-out
    noise: list[Hook] = field(default_factory=list)  # read noise alone, in electrons
    output: list[Hook] = field(default_factory=list)  # electrons with read noise, before the ADC
    excess_noise_factor: float | None = None  # F² of the multiplication; None: the camera's own (2 or 1)
    nothing_lost: bool = False  # with F² < 2: every electron leaves the register with itself at least (low gain)
    memory_frames: int = 0  # how many earlier frames the `amplified` hooks need
    code_begins: NDArray[np.float64] | None = None  # (period,) signal in ADU at which a code begins, code by code


IDEAL = SensorHooks()


def check_counts(counts: NDArray[Any], camera: Camera) -> None:
    """Raise `MufasaError` for counts that this camera cannot have recorded: below zero in spite of its baseline, or
    above its largest."""
    if counts.dtype.kind != "u" and counts.size and camera.baseline_adu >= 1 and counts.min() < 0:
        raise MufasaError(
            f"movie has counts down to {counts.min():.6g}, the camera's baseline is {camera.baseline_adu:.6g} ADU: "
            "give the raw counts, or set baseline_adu to 0 if it was subtracted"
        )
    if counts.size and counts.max() > camera.adc_max:
        raise MufasaError(
            f"movie has counts up to {counts.max():.6g}, the camera's adc_max is {camera.adc_max}: "
            "give the raw counts, or set adc_max to the largest count of the camera"
        )


def expose(
    photons: Stack, camera: Camera, streams: Streams, frames: NDArray[np.int64], hooks: SensorHooks = IDEAL
) -> NDArray[np.uint16]:
    """Record photons: (frame, y, x) expected photons per pixel → (frame, y, x) ADU, uint16.

    `frames` numbers the frames given; every pixel of every frame draws from its own stream, so any block of a
    movie can be recorded alone. The first `hooks.memory_frames` frames only feed the sensor's memory: they are those
    before the block, and are returned as recorded too.
    """
    # 1 detection: n_ie ~ Poisson(QE x̃ + c)
    expected = camera.quantum_efficiency * photons
    expected += np.float32(camera.clock_induced_charge_e)
    for hook in hooks.expected:
        expected = hook(expected, frames)
    # 2 multiplication or conversion
    excess = multiplication_noise(camera) if hooks.excess_noise_factor is None else hooks.excess_noise_factor
    from napari_mufasa.camera.kernels import detect, digitise, digitise_unevenly, read_out
    from napari_mufasa.camera.register import TABLED, lean, quantile_roots

    numbers = np.ascontiguousarray(frames, dtype=np.int64)
    shape, kept = _multiplication_law(excess, hooks.nothing_lost)
    tabled = TABLED[0] <= excess <= TABLED[1]
    table = quantile_roots(shape, kept) if tabled else np.empty((0, 0), np.float32)
    leans = lean(shape, kept) if tabled else 0.0
    expected = np.ascontiguousarray(expected, np.float32)
    electrons = detect(expected, shape, kept, numbers, streams.key("detection"), table, excess, leans)
    if camera.type != "CMOS":
        electrons *= np.float32(_gain(camera))
    # 3 what happens to the charge on its way out; a CMOS turns it into a voltage, along its curve, only then
    for hook in hooks.amplified:
        electrons = hook(electrons, frames)
    if camera.type == "CMOS":
        electrons = cmos_response(np.ascontiguousarray(electrons, np.float32), camera)
    for hook in hooks.amplifier:
        electrons = hook(electrons, frames)
    if camera.readout_kernel:
        electrons = readout.along_rows(electrons, readout.signal_weights(camera))
    # 4 read noise N(μ, σ²)
    noise = np.asarray(read_noise_map_e(camera), np.float32)
    sigma = np.ascontiguousarray(np.broadcast_to(noise, electrons.shape[1:]))
    electrons = np.ascontiguousarray(electrons, dtype=np.float32)
    apart = bool(hooks.noise or camera.read_noise_kernel)
    added = np.zeros_like(electrons) if apart else electrons
    read_out(added, sigma, camera.read_noise_mean_e, numbers, streams.key("read noise"))
    if camera.read_noise_kernel:
        mean_e = np.float32(camera.read_noise_mean_e)
        added = readout.noise_along_rows(added - mean_e, readout.noise_weights(camera)) + mean_e
    for hook in hooks.noise:
        added = hook(added, frames)
    if apart:
        electrons += added
    if camera.baseline_alternation_adu or camera.baseline_jitter_adu:
        offset_e = camera.electrons_per_adu * readout.frame_offsets_adu(camera, numbers, streams)
        electrons += offset_e.astype(np.float32)[:, None, None]
    for hook in hooks.output:
        electrons = hook(electrons, frames)
    # 5 digitisation: min(⌊n_oe/e_per_ADU⌋ + BL, ADC_max), never below 0. A baseline between two counts is
    # added before the floor, or the ½ of the inverse would not undo it.
    baseline = np.ascontiguousarray(np.broadcast_to(baseline_map_adu(camera), electrons.shape[1:]))
    electrons = np.ascontiguousarray(electrons, dtype=np.float32)
    per_adu, most = np.float32(camera.electrons_per_adu), camera.adc_max
    digital: NDArray[np.uint16]
    begins = hooks.code_begins
    if begins is None and camera.code_widths:
        begins = readout.code_begins(camera.code_widths)
    if begins is None:
        digital = digitise(electrons, per_adu, baseline, most)
    else:
        digital = digitise_unevenly(electrons, per_adu, baseline, most, begins)
    return digital


def output_electrons(movie: NDArray[Any], camera: Camera, first_frame: int = 0) -> Stack:
    """Undo step 5: (y + ½ − BL)·e_per_ADU, float32 (docs/camera.md). Negative values are kept on purpose.

    Of whole counts of a converter with `code_widths`, the middle of the code stands for y + ½.

    first_frame : the number of the movie's frame that is given first; only an alternating baseline asks for it.
    """
    _check_maps(movie, camera)
    half = np.float32(0.5) - baseline_map_adu(camera)
    mean_e = np.float32(camera.read_noise_mean_e)
    signal_adu = np.asarray(movie, dtype=np.float32) + half + readout.code_shifts_adu(movie, camera)
    electrons = signal_adu * np.float32(camera.electrons_per_adu) - mean_e
    if camera.baseline_alternation_adu and electrons.ndim == 3:
        frames = np.arange(first_frame, first_frame + len(electrons))
        offset_e = camera.electrons_per_adu * readout.frame_offsets_adu(camera, frames)
        electrons = electrons - offset_e.astype(np.float32)[:, None, None]
    return np.asarray(electrons, dtype=np.float32)


def photoelectrons(movie: NDArray[Any], camera: Camera, first_frame: int = 0) -> Stack:
    """Undo steps 5, 3 (as far as the camera has a `readout_kernel`) and 2: ADU → photoelectrons (n_ie with noise),
    float32. `first_frame` as for `output_electrons`."""
    electrons = output_electrons(movie, camera, first_frame)
    if camera.readout_kernel:
        electrons = readout.undone_along_rows(electrons, readout.signal_weights(camera))
    if camera.type == "EMCCD":
        return electrons / np.float32(_gain(camera))
    if camera.type == "CMOS":
        return cmos_response_inverse(electrons, camera)
    return electrons if camera.gain_map is None else electrons / camera.gain_map.astype(np.float32)


def photons(electrons: NDArray[np.floating], camera: Camera) -> Stack:
    """Undo step 1: photoelectrons → photons, (n − c)/QE."""
    return np.asarray((electrons - camera.clock_induced_charge_e) / camera.quantum_efficiency, np.float32)


def multiplication_noise(camera: Camera) -> float:
    """α of the photoelectron signal: variance/mean after division by the gain; 2 for an EMCCD, else 1."""
    if camera.excess_noise_factor is not None:
        return camera.excess_noise_factor
    return 2.0 if camera.type == "EMCCD" else 1.0


def charge_variance_e2(camera: Camera) -> float:
    """Variance of what spurious electrons leave at the output of the register, in output electrons squared."""
    return multiplication_noise(camera) * float(camera.em_gain or 1.0) ** 2 * camera.clock_induced_charge_e


def _multiplication_law(excess: float, nothing_lost: bool) -> tuple[float, float]:
    """Shape of the Gamma law and share that is kept as it came, for an excess noise factor F² (see `detect`)."""
    if nothing_lost and 1.0 < excess < 2.0:
        return 1.0, 1.0 - float(np.sqrt(excess - 1.0))
    return (1.0 / (excess - 1.0) if excess > 1.0 else 0.0), 0.0


def read_noise_map_e(camera: Camera) -> Any:
    """Read noise in output electrons rms: a scalar, or the (y, x) map of the camera."""
    if camera.variance_map_e2 is not None:
        return np.sqrt(camera.variance_map_e2).astype(np.float32)
    return np.float32(camera.read_noise_e)


def read_variance(electrons: NDArray[np.floating], camera: Camera) -> Stack:
    """Variance of one frame (y, x) by read noise and by rounding to counts (a²/12 of a converter of a electrons per
    count, more of uneven codes), in photoelectrons squared.

    EMCCD: the register's gain divides it. CMOS: so does the slope of the response, taken at the local mean of 5 x 5
    pixels, because the pixel's own noise would choose its own slope.
    """
    rounding_e2 = np.float32(camera.electrons_per_adu**2 * readout.rounding_variance_adu2(camera))
    variance_e2 = np.square(read_noise_map_e(camera))
    if camera.readout_kernel:
        variance_e2 = variance_e2 * np.float32(readout.undone_noise_power(camera))
        rounding_e2 *= np.float32(readout.undone_rounding_power(camera))
    variance_e2 = variance_e2 + rounding_e2
    slope: Any = np.float32(1.0)
    if camera.type == "EMCCD":
        slope = np.float32(camera.em_gain or 1.0)
    if camera.type == "CMOS":
        from scipy.ndimage import uniform_filter

        local = uniform_filter(electrons, size=[1] * (electrons.ndim - 2) + [5, 5], mode="reflect")
        width = np.float32(0.5) + np.float32(0.01) * np.abs(local)
        slope = (cmos_response(local + width, camera) - cmos_response(local - width, camera)) / (2 * width)
    elif camera.gain_map is not None:
        slope = slope * camera.gain_map.astype(np.float32)
    return np.broadcast_to(np.asarray(variance_e2 / np.square(slope), np.float32), electrons.shape)


def baseline_map_adu(camera: Camera) -> Any:
    """Baseline in ADU: a scalar, or a (y, x) map."""
    if camera.offset_map_adu is not None:
        return (camera.baseline_adu + camera.offset_map_adu).astype(np.float32)
    return np.float32(camera.baseline_adu)


def cmos_response(electrons: NDArray[np.floating], camera: Camera) -> Stack:
    """g_p: photoelectrons → output electrons, piecewise linear, continued with its last slope."""
    return np.asarray(_interpolate(electrons, *_knots(camera)) * _gain_map(camera), dtype=np.float32)


def cmos_response_inverse(electrons: NDArray[np.floating], camera: Camera) -> Stack:
    """g_p⁻¹: output electrons → photoelectrons, per pixel; negative values follow the first slope."""
    into, out = _knots(camera)
    return _interpolate(electrons / _gain_map(camera), out, into).astype(np.float32)


def _knots(camera: Camera) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    knots = np.asarray(camera.cmos_gain_curve, dtype=float)
    return knots[:, 0], knots[:, 1]


def _interpolate(values: NDArray[np.floating], x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """The line through the knots at `values`, continued at either end: its first slope, and its change at each knot."""
    slopes = np.diff(y) / np.diff(x)
    result: NDArray[np.float64] = y[0] + slopes[0] * (values - x[0])
    for knot, change in zip(x[1:-1], np.diff(slopes), strict=True):
        result += change * np.maximum(values - knot, 0.0)
    return result


def _gain_map(camera: Camera) -> Any:
    return np.float32(1.0) if camera.gain_map is None else camera.gain_map.astype(np.float32)


def _gain(camera: Camera) -> Any:
    return float(camera.em_gain or 1.0) * _gain_map(camera)


def _check_maps(movie: NDArray[Any], camera: Camera) -> None:
    for name in ("offset_map_adu", "gain_map", "variance_map_e2"):
        value = getattr(camera, name)
        if value is not None and tuple(movie.shape[-2:]) != value.shape:
            raise MufasaError(
                f"movie frames are {tuple(movie.shape[-2:])}, camera.{name} is {value.shape}: "
                "crop the map to the movie's region"
            )
