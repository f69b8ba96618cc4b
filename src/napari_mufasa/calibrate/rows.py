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


@dataclass(frozen=True)
class Products:
    """Products of neighbours' noise within `pixels` (y, x), summed over `n_frames` differences of frames: `row` and
    `column` (lag,) over all pairs at lags 1 … `LAGS`, `squares` (y, x) of each pixel with itself. They add up."""

    pixels: NDArray[np.bool_]
    n_frames: int
    squares: Array
    row: Array
    column: Array

    @classmethod
    def of(cls, differences: NDArray[Any], pixels: NDArray[np.bool_] | None = None) -> Products:
        """Of differences of frames (frame, y, x) without pattern; one frame of float64 is held."""
        mask = np.ones(differences.shape[1:], dtype=bool) if pixels is None else pixels
        squares, row, column = np.zeros(mask.shape), np.zeros(LAGS), np.zeros(LAGS)
        for frame in differences:
            values = np.where(mask, frame, 0.0).astype(np.float64)
            squares += values**2
            for lag in range(1, LAGS + 1):
                row[lag - 1] += np.einsum("yx,yx->", values[:, :-lag], values[:, lag:])
                column[lag - 1] += np.einsum("yx,yx->", values[:-lag], values[lag:])
        return cls(mask, len(differences), squares, row, column)

    def __add__(self, other: Products) -> Products:
        return Products(
            self.pixels, self.n_frames + other.n_frames, self.squares + other.squares, self.row + other.row,
            self.column + other.column,
        )  # fmt: skip

    def correlations(self, terms: tuple[float, ...]) -> Correlations:
        """terms : the weights of the frames in a difference, (1, −2, 1) or (1,): how many are independent follows."""
        mask, n_frames = self.pixels, self.n_frames
        variance = float(self.squares.sum() / (mask.sum() * n_frames))
        per_pair = 1 / (n_frames * variance) if variance > 0 else 0.0
        row, column = np.zeros(LAGS), np.zeros(LAGS)
        for lag in range(1, LAGS + 1):
            row[lag - 1] = self.row[lag - 1] * per_pair / max(int((mask[:, :-lag] & mask[:, lag:]).sum()), 1)
            column[lag - 1] = self.column[lag - 1] * per_pair / max(int((mask[:-lag] & mask[lag:]).sum()), 1)
        weights = np.array(terms)
        own = np.correlate(weights, weights, "full") / np.sum(weights**2)
        independent = mask.sum() * n_frames / np.sum(own**2)
        # Neighbours that are correlated make the products of their neighbours alike, too; and where light is uneven,
        # few bright pixels make most of the sum.
        uneven = _unevenness(self.squares / n_frames, mask)
        sd = float(np.sqrt(uneven * (1 + 2 * np.sum(row**2)) / max(independent, 1.0)))
        return Correlations(row, column, sd, variance / float(np.sum(weights**2)))


def _unevenness(power: Array, mask: NDArray[np.bool_]) -> float:
    """Mean of the products of neighbours' variances over the mean variance squared; 1 where pixels are alike."""
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
    they have nothing in common but their row's offset. Takes four times the memory of the frames as uint16."""
    flat = dark - dark.mean(axis=2, keepdims=True, dtype=np.float64)
    flat -= flat.mean(axis=0)
    found = Products.of(flat).correlations((1.0,))
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
