"""The camera from the same light recorded at several EM gains: electrons per count, every gain, every excess noise.

The mean of a movie is n·g/a (n photoelectrons, g the gain, a electrons per count), its variance F²·g/a times that. The
light is the same in all, so the ratio of means is the ratio of gains; a register of many stages has a known F²(g), near
1 without gain and near 2 at a high one; what is left to find is a and n.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.calibrate import transfer
from napari_mufasa.calibrate.sample import lit_chunks
from napari_mufasa.calibrate.value import Value
from napari_mufasa.errors import MufasaError

STAGES = 536  # of an EMCCD's register; F² depends on their number by less than 1 %


@dataclass(frozen=True)
class Exposed:
    """A movie of the series: `movie` (frame, y, x) ADU, its mean without light and the read noise, both ADU, scalars or
    (y, x)."""

    movie: Any
    dark_mean_adu: Any
    read_noise_adu: Any


@dataclass(frozen=True)
class GainSeries:
    """What a series tells: electrons per count, photoelectrons per pixel and frame, and for each movie its gain and its
    excess noise factor (with the electrons per count that all movies together tell)."""

    electrons_per_adu: Value
    photoelectrons: Value
    em_gain: tuple[Value, ...]
    excess_noise_factor: tuple[Value, ...]


def register_excess_noise(gain: Any, stages: int = STAGES) -> Any:
    """F² of a register of equal stages (Robbins & Hadwen 2003): 2(g − 1)/g^((N + 1)/N) + 1/g."""
    g = np.asarray(gain, dtype=np.float64)
    return 2 * (g - 1) * g ** (-(stages + 1) / stages) + 1 / g


def calibrate_gain_series(series: Sequence[Exposed]) -> GainSeries:
    """Measure a camera on movies of one light at several gains, the first of which is without gain (1).

    Raises `MufasaError` for fewer than two movies or a movie without light.
    """
    if len(series) < 2:
        raise MufasaError(f"a series of {len(series)} movies tells no gain: give the same light at two gains or more")
    levels, slopes = zip(*(_level_and_slope(one) for one in series), strict=True)
    gains = np.array([level.value for level in levels]) / levels[0].value
    per_adu = _electrons_per_adu(gains, slopes)
    gain_values = []
    for level in levels:
        share = float(np.hypot(level.sd / level.value, levels[0].sd / levels[0].value)) if level is not levels[0] else 0
        gain = level.value / levels[0].value
        gain_values.append(Value(gain, gain * share))
    excess = []
    for gain, slope in zip(gains, slopes, strict=True):
        factor = slope.value * per_adu.value / gain
        excess.append(Value(factor, factor * float(np.hypot(slope.sd / slope.value, per_adu.sd / per_adu.value))))
    electrons = levels[0].value * per_adu.value
    return GainSeries(
        per_adu, Value(electrons, electrons * per_adu.sd / per_adu.value), tuple(gain_values), tuple(excess)
    )


def _electrons_per_adu(gains: NDArray[np.float64], slopes: Sequence[Value]) -> Value:
    """a from slope = F²(g)·g/a, each movie by its error."""
    found = np.array(
        [register_excess_noise(gain) * gain / slope.value for gain, slope in zip(gains, slopes, strict=True)]
    )
    # The error is that of 1/a, which is linear in what was measured.
    sd = np.array([slope.sd / slope.value for slope in slopes]) / found
    weights = 1 / sd**2
    inverse = float(np.sum(weights / found) / weights.sum())
    spread = float(np.sqrt(1 / weights.sum()))
    scatter = float(np.sqrt(np.sum(weights * (1 / found - inverse) ** 2) / max(len(found) - 1, 1)))
    spread *= max(1.0, scatter)
    return Value(1 / inverse, spread / inverse**2)


def _level_and_slope(one: Exposed) -> tuple[Value, Value]:
    """Mean light in ADU, and variance over mean, with the errors that pixels and parts of the movie show."""
    chunks = lit_chunks(one.movie, 0, None, None)
    means, variances = transfer.photon_transfer(chunks)
    signal = means - np.asarray(one.dark_mean_adu, dtype=np.float64)
    level, light = float(signal.mean()), float((variances - np.square(one.read_noise_adu)).mean())
    if level <= 0 or light <= 0:
        raise MufasaError("a movie of the series shows no light above its dark frames: give raw frames under light")
    n = variances.size
    own = (
        variances.mean(axis=(1, 2)).std(ddof=1) / np.sqrt(len(chunks)) if len(chunks) > 1 else variances.std() / n**0.5
    )
    # Read noise is as uncertain as its map scatters.
    read = np.square(one.read_noise_adu)
    read_sd = float(np.std(read) / np.sqrt(np.size(read))) if np.size(read) > 1 else 0.0
    slope = light / level
    drift = float(signal.mean(axis=(1, 2)).std(ddof=1) / np.sqrt(len(chunks))) if len(chunks) > 1 else 0.0
    return Value(level, drift), Value(slope, float(np.hypot(own, read_sd)) / level)
