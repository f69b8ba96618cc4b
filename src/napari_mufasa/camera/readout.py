"""The read-out: what amplifier and converter make of a row, a frame and a code, and what of it can be undone."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import signal

if TYPE_CHECKING:
    from napari_mufasa.chance.streams import Streams
    from napari_mufasa.model.setup import Camera

Array = NDArray[np.float64]
Stack = NDArray[np.float32]  # (frame, y, x)


def signal_weights(camera: Camera) -> Array:
    """What a pixel reads of itself and of those before it in its row, (lag,), summing to 1: light keeps its mean."""
    weights = np.array([1.0, *camera.readout_kernel])
    return np.asarray(weights / weights.sum())


def noise_weights(camera: Camera) -> Array:
    """The same of the read noise, (lag,), of power 1: read noise keeps the rms that dark frames show."""
    weights = np.array([1.0, *camera.read_noise_kernel])
    return np.asarray(weights / np.sqrt(np.sum(weights**2)))


def without_readout(camera: Camera) -> Camera:
    """The camera for values that do not stand in rows and frames as they were read out."""
    plain = {"readout_kernel": (), "read_noise_kernel": (), "baseline_alternation_adu": 0.0, "baseline_jitter_adu": 0.0}
    return camera.model_copy(update=plain | {"code_widths": ()})


def along_rows(electrons: Stack, weights: Array) -> Stack:
    """Each pixel as the weighted sum of itself and of those before it in its row (x − 1, x − 2 …), which continue level
    before the first one."""
    return _mixed(electrons, weights, False)


def noise_along_rows(noise: Stack, weights: Array) -> Stack:
    """The same of read noise: before a row's first pixel the amplifier read the end of another row, so that it is
    alike everywhere."""
    return _mixed(noise, weights, True)


def _mixed(values: Stack, weights: Array, wraps: bool) -> Stack:
    from napari_mufasa.camera.kernels import mix_rows

    mixed = np.empty(values.shape, np.float32)
    mix_rows(np.ascontiguousarray(values, np.float32), weights.astype(np.float32), wraps, mixed)
    return mixed


def undone_along_rows(mixed: Stack, weights: Array) -> Stack:
    """What `along_rows` was given; weights sum to 1 and have their zeros within the unit circle (`Camera`)."""
    lead = signal.lfilter_zi([1.0], weights) * mixed[..., :1].astype(np.float64)
    found, _ = signal.lfilter([1.0], weights, mixed, axis=-1, zi=lead)
    return np.asarray(found, np.float32)


def undone_noise_power(camera: Camera) -> float:
    """By what factor undoing the kernel of the signal changes the variance of the read noise; 1 without kernels."""
    return float(np.sum(_undone(camera, noise_weights(camera)) ** 2))


def undone_rounding_power(camera: Camera) -> float:
    """The same for what the converter rounds off, which no kernel has passed."""
    return float(np.sum(_undone(camera, np.ones(1)) ** 2))


def undone_noise_correlation(camera: Camera, lags: int = 4) -> Array:
    """Correlations along a row of the read noise once the signal's kernel is undone, lags 1 … (lag,)."""
    response = _undone(camera, noise_weights(camera))
    products = np.array([np.sum(response[lag:] * response[: len(response) - lag]) for lag in range(lags + 1)])
    found: Array = products[1:] / products[0]
    return found


def _undone(camera: Camera, weights: Array) -> Array:
    """The kernel `weights` of a noise once that of the signal is undone."""
    impulse = np.zeros(256)
    impulse[: len(weights)] = weights
    response: Array = signal.lfilter([1.0], signal_weights(camera), impulse)
    return response


def row_kernel(correlations: Array) -> Array:
    """The weights of a pixel and of those before it (lag,), first 1, that correlate even noise as given: correlations
    along a row at lags 1, 2 … (lag − 1,), as dark frames show them; farther lags are taken as none.

    Of all such kernels the one of least delay (by the cepstrum). Correlations that no noise can have are brought down
    to what it can have.
    """
    n = 64 * (len(correlations) + 1)
    power = 1 + 2 * np.cos(2 * np.pi * np.outer(np.arange(n) / n, np.arange(1, len(correlations) + 1))) @ correlations
    cepstrum = np.fft.ifft(np.log(np.maximum(power, 1e-3))).real
    cepstrum[1 : n // 2] *= 2
    cepstrum[n // 2 + 1 :] = 0
    weights = np.fft.ifft(np.exp(np.fft.fft(cepstrum) / 2)).real[: len(correlations) + 1]
    return np.asarray(weights / weights[0], np.float64)


def frame_offsets_adu(camera: Camera, frames: NDArray[np.int64], streams: Streams | None = None) -> Array:
    """(frame,) what each frame's baseline has more than the camera's; the jitter only with `streams` to draw it from:
    it cannot be known of a recorded frame."""
    offsets = np.asarray(camera.baseline_alternation_adu * (1.0 - 2.0 * (np.asarray(frames) % 2)), np.float64)
    if streams is not None and camera.baseline_jitter_adu > 0:
        draws = (streams.of("camera baseline", int(f)).standard_normal() for f in frames)
        offsets += camera.baseline_jitter_adu * np.fromiter(draws, np.float64, len(frames))
    return offsets


def code_begins(pattern: Any, unevenness: float | None = None) -> Array:
    """Where the codes of one period begin, in ADU (period,). They lie about the even ones such that a count is right
    on average.

    pattern : the codes' widths in any unit; with `unevenness` only their pattern counts, made to have mean 0 and rms 1:
        widths are then 1 + unevenness × the pattern.
    """
    widths = np.asarray(pattern, dtype=np.float64)
    if unevenness is not None:
        widths = widths - widths.mean()
        widths = widths / max(float(np.sqrt(np.mean(widths**2))), 1e-12)
        widths = np.maximum(1 + unevenness * widths, 0.0)
    widths = widths * (len(widths) / widths.sum())
    begins = np.concatenate([[0.0], np.cumsum(widths)[:-1]])
    result: Array = begins - np.mean(begins - np.arange(len(begins)))
    return result


def code_shifts_adu(counts: NDArray[Any], camera: Camera) -> Any:
    """How far from count + ½ the middle of the signals lies that get this count, in ADU, float32 in the shape of
    `counts`; 0 of even codes, and of numbers that are no longer whole counts."""
    if not camera.code_widths or counts.dtype.kind not in "ui":
        return np.float32(0.0)
    begins = code_begins(camera.code_widths)
    ends = np.append(begins[1:], begins[0] + len(begins))
    shifts = (begins + ends) / 2 - np.arange(len(begins)) - 0.5
    return shifts.astype(np.float32)[counts % len(begins)]


def rounding_variance_adu2(camera: Camera) -> float:
    """Variance within a code, over all signals: 1/12 of even codes."""
    if not camera.code_widths:
        return 1 / 12
    widths = np.array(camera.code_widths) / np.mean(camera.code_widths)
    return float(np.mean(widths**3) / 12)
