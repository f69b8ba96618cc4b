"""What frames without light tell: baseline, read noise, the tail of spurious electrons."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.calibrate.value import Value
from napari_mufasa.errors import MufasaError

TAIL_SD = 5.0


def counts(data: Any, what: str) -> NDArray[Any]:
    """Raw counts; raises `MufasaError` for what no camera records."""
    counts: NDArray[Any] = np.asarray(data)
    if counts.dtype.kind not in "uif" or not np.isfinite(counts).all() or (counts.size and counts.min() < 0):
        raise MufasaError(f"{what} hold values that are negative or no numbers: give the raw counts (ADU)")
    return counts


def leading_dark_frames(movie: Any) -> int:
    """How many frames at the beginning are dark: before a sudden, lasting rise of the mean; 0 if none."""
    n = int(movie.shape[0])
    step = max(1, int(np.sqrt(movie.shape[1] * movie.shape[2] / 4096)))
    level = np.array([float(np.mean(np.asarray(movie[i])[::step, ::step])) for i in range(min(n, 500))])
    if len(level) < 8:
        return 0
    jumps = np.diff(level)
    at = int(np.argmax(jumps))
    before, after = level[: at + 1], level[at + 1 :]
    if len(before) < 3 or len(after) < 3:
        return 0
    usual = max(float(np.std(before)), 1e-9)
    # The first lit frame may be lit in part; the dark ones are alike and all below all lit ones.
    return at + 1 if before.max() + 10 * usual < after.min() else 0


def dark_frames(
    dark: Any, baseline: float | None, read_noise: float | None, shape: tuple[int, ...], notes: list[str]
) -> tuple[Value, Value, float, NDArray[np.float64] | None]:
    """Baseline (BL of docs/camera.md, half a count above the recorded mean), read noise, tail, dark values."""
    nan = float("nan")
    if dark is None:
        base = Value(nan if baseline is None else float(baseline), nan)
        read = Value(0.0 if read_noise is None else float(read_noise), nan)
        if baseline is None:
            notes.append(f"no dark frames: read noise taken as {read.value:g} ADU, baseline from the variance")
        return base, read, nan, None
    dark = counts(dark, "dark frames").astype(np.float64)
    if np.ndim(dark) != 3 or dark.shape[1:] != tuple(shape):
        raise MufasaError(f"dark has shape {dark.shape}, the movie's frames are {tuple(shape)}: give the same region")
    if dark.size == 0:
        raise MufasaError(f"dark has shape {dark.shape}: give at least one dark frame, better 50")
    pixel = np.median(dark, axis=0) if len(dark) > 4 else np.full(shape, np.median(dark))
    values = (dark - pixel).ravel()
    # Whole counts make the median deviation coarse: a random part of a count smooths it, and is taken off again.
    smooth = values + np.random.default_rng(0).uniform(-0.5, 0.5, values.size)
    sd = np.sqrt(max(float(1.4826 * np.median(np.abs(smooth))) ** 2 - 1 / 12, 0.0))
    sd *= np.sqrt(len(dark) / max(len(dark) - 1.57, 1.0)) if len(dark) > 4 else 1.0  # the median took its part
    core = values[np.abs(values) < TAIL_SD * max(sd, 0.5)]
    # Each frame's own offset (it wanders together) is the uncertainty of the mean, not the number of pixels.
    per_frame = np.array([np.mean(f[np.abs(f - np.median(f)) < TAIL_SD * max(sd, 0.5)]) for f in dark])
    base = Value(
        float(baseline) if baseline is not None else float(per_frame.mean()) + 0.5,
        float(per_frame.std() / np.sqrt(len(per_frame))) if len(per_frame) > 1 else nan,
    )
    read = Value(
        float(read_noise) if read_noise is not None else float(np.sqrt(max(sd**2 - 1 / 12, 0.0))),
        float(sd / np.sqrt(2 * len(core))),
    )
    return base, read, float(np.mean(values > TAIL_SD * max(sd, 0.5))), values


def clock_induced(values: NDArray[np.float64] | None, base: float, read_noise: float, adu_per_electron: float) -> Value:
    """Electrons per pixel from the tail: one spurious electron gives an exponential of mean one gain."""
    nan = float("nan")
    threshold = TAIL_SD * max(read_noise, 0.5)
    if values is None or threshold > 3 * adu_per_electron:  # the tail of one electron hides in the read noise
        return Value(nan, nan)
    n = int(np.count_nonzero(values > threshold))
    weight = np.exp(threshold / adu_per_electron) / values.size
    return Value(float(n * weight), float(np.sqrt(max(n, 1)) * weight))
