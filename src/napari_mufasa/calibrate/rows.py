"""How neighbours are correlated: what the read-out mixes along a row, told from what the sample does everywhere."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.calibrate.value import Value
from napari_mufasa.camera.readout import row_kernel

Array = NDArray[np.float64]
LAGS = 8  # a read-out that rings does so over several pixels
SURE = 3.5  # standard errors from which on a lag is believed
CONTINUES = 2.5  # those from which on the lag after a believed one is: an undershoot dies out step by step


@dataclass(frozen=True)
class Correlations:
    """Of neighbours' noise at lags 1 … `LAGS`, each (lag,): along a row, along a column; `sd` of each, and the variance
    (of a pixel in a frame, ADU²) that they are relative to."""

    row: Array
    column: Array
    sd: float
    variance: float

    @property
    def kernel(self) -> Array:
        """What rows have of correlation and columns have not: the read-out's, (lag,), up to the last sure one."""
        own = self.row - self.column
        sure = _sure(own, np.sqrt(2) * self.sd)
        n = int(np.max(np.nonzero(sure)[0], initial=-1)) + 1
        return own[:n]


def correlations(differences: NDArray[Any], pixels: NDArray[np.bool_] | None, terms: tuple[float, ...]) -> Correlations:
    """Of differences of frames (frame, y, x) without pattern, within `pixels` (y, x).

    terms : the weights of the frames in a difference, (1, −2, 1) or (1,): how many are independent follows from them.
    """
    n_frames = len(differences)
    mask = np.ones(differences.shape[1:], dtype=bool) if pixels is None else pixels
    values = np.where(mask, differences, 0.0).astype(np.float32)
    variance = float(np.sum(np.square(values, dtype=np.float64)) / (mask.sum() * n_frames))

    def along(axis: int) -> Array:
        found = []
        for lag in range(1, LAGS + 1):
            if values.shape[axis] <= lag:
                found.append(0.0)
                continue
            n = values.shape[axis]
            one, other = (np.take(values, range(lo, n - lag + lo), axis) for lo in (0, lag))
            pairs = int(np.sum(np.take(mask, range(n - lag), axis - 1) & np.take(mask, range(lag, n), axis - 1)))
            total = float(np.einsum("fyx,fyx->", one, other, dtype=np.float64))
            found.append(total / max(pairs * n_frames, 1) / variance if variance > 0 else 0.0)
        return np.array(found)

    weights = np.array(terms)
    own = np.correlate(weights, weights, "full") / np.sum(weights**2)
    independent = mask.sum() * n_frames / np.sum(own**2)
    row, column = along(2), along(1)
    # Neighbours that are correlated make the products of their neighbours alike, too; and where light is uneven, few
    # bright pixels make most of the sum.
    sd = float(np.sqrt(_unevenness(values, mask) * (1 + 2 * np.sum(row**2)) / max(independent, 1.0)))
    return Correlations(row, column, sd, variance / float(np.sum(weights**2)))


def _unevenness(values: NDArray[np.float32], mask: NDArray[np.bool_]) -> float:
    """Mean of the products of neighbours' variances over the mean variance squared; 1 where pixels are alike."""
    power = np.mean(np.square(values, dtype=np.float64), axis=0)
    pairs = mask[:, 1:] & mask[:, :-1]
    mean = float(power[mask].mean())
    if not pairs.any() or mean <= 0:
        return 1.0
    return max(float(np.mean((power[:, 1:] * power[:, :-1])[pairs])) / mean**2, 1.0)


def of_light(lit: Correlations, dark: Correlations | None, read_variance: float) -> Array:
    """Correlations (lag,) that the read-out gives the light: those of lit pixels without the read noise's share, whose
    own are the dark ones (without dark frames: the same)."""
    found = np.zeros(LAGS)
    known = 0 if dark is None or read_variance <= 0 else len(dark.kernel)
    # Where the dark shows a kernel, its first share in light is kept however small it looks: none is no better known.
    n = max(len(lit.kernel), known)
    found[:n] = (lit.row - lit.column)[:n]
    if dark is None or read_variance <= 0 or n == 0:
        return found
    own = np.zeros(LAGS)
    own[:known] = dark.kernel
    light = max(lit.variance - read_variance, 1e-9)
    found = (found * lit.variance - own * read_variance) / light
    sure = _sure(found, np.sqrt(2) * lit.sd * lit.variance / light)
    sure[: min(known, 1)] = True
    found[~sure] = 0.0
    return found


def dark_rows(dark: NDArray[Any]) -> tuple[float, ...]:
    """Correlation of neighbours along a row, (lag,), in dark frames (frame, y, x), as far as it is sure; (0,) where
    they have nothing in common but their row's offset. Takes about ten times the memory of the frames as uint16."""
    flat = dark - dark.mean(axis=2, keepdims=True, dtype=np.float64)
    flat -= flat.mean(axis=0)
    found = correlations(flat, None, (1.0,))
    # A row's mean holds its share of every pixel of the row.
    row = found.row + (1 + 2 * found.row.sum()) / flat.shape[2]
    return tuple(replace(found, row=row).kernel.round(5).tolist()) or (0.0,)


def _sure(correlations: Array, sd: float) -> NDArray[np.bool_]:
    """(lag,) which of them are believed."""
    sure = np.abs(correlations) > SURE * sd
    for lag in range(1, len(sure)):
        sure[lag] |= sure[lag - 1] and abs(correlations[lag]) > CONTINUES * sd
    return np.asarray(sure)


def shares_of(correlations: Array, sd: Array) -> tuple[Value, ...]:
    """The shares of `kernel_of` with what the errors of the correlations, `sd` (lag,), make of theirs."""
    centre = np.array(kernel_of(correlations))
    errors = np.zeros(len(centre))
    for lag in range(len(centre)):
        moved = correlations.copy()
        moved[lag] += sd[lag]
        other = np.array(kernel_of(moved))
        errors[: len(other)] += (other[: len(centre)] - centre[: len(other)]) ** 2
    return tuple(Value(float(share), float(np.sqrt(error))) for share, error in zip(centre, errors, strict=True))


def kernel_of(correlations: Array) -> tuple[float, ...]:
    """The shares of the pixels before, (lag,), that correlate noise so; () where there are none."""
    n = int(np.max(np.nonzero(correlations)[0], initial=-1)) + 1
    if n == 0:
        return ()
    shares = row_kernel(np.asarray(correlations[:n]))[1:]
    return tuple(round(float(share), 5) for share in np.clip(shares, -0.99, 0.99))
