"""What is read off the lit frames of a movie before anything is assumed of the camera."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.calibrate import rows, transfer

Array = NDArray[np.float64]
LEAST_PARTS = 5  # of the movie, for an error by their spread


class Light:
    """Of chunks (frame, y, x) within `lit` (y, x): photon transfer, neighbours, and which pixels lie in no spot."""

    def __init__(self, chunks: list[NDArray[np.float32]], lit: NDArray[np.bool_], n_frames: int) -> None:
        self.chunks, self.n_frames = chunks, n_frames
        means, variances = transfer.photon_transfer(chunks)
        chosen = np.flatnonzero(lit.ravel())
        means, variances = (a.reshape(len(a), -1)[:, chosen] for a in (means, variances))
        steady = transfer.steady_pixels(means, variances)
        mean = np.mean([chunk.mean(axis=0, dtype=np.float64) for chunk in chunks], axis=0)
        still = np.zeros(lit.shape, dtype=bool)
        still.ravel()[chosen[steady]] = True
        variance = np.zeros(lit.shape)
        variance.ravel()[chosen] = variances.mean(axis=0)
        constant = transfer.constant_pixels(chunks, variance)
        quiet = still & transfer.quiet_pixels(mean) & constant
        self.quiet = quiet if quiet.sum() > max(9, 0.02 * quiet.size) else still
        kept = self.quiet.ravel()[chosen]
        self.means, self.variances = means[:, kept], variances[:, kept]
        # Without dark frames the range of light counts: spots, as far as they are steady, are part of it.
        both = steady & constant.ravel()[chosen]
        self.wider, self.common = _of_parts(chunks, chosen[both if both.sum() > 0.02 * len(chosen) else steady])
        self.counts_each = int(kept.sum()) * len(chunks[0])
        dim = mean < np.median(mean[self.quiet])
        seconds, firsts = partial(_second_differences, pixels=self.quiet), partial(_first_differences, pixels=lit)
        self.rows, self.rows_of_parts = _correlations(map(seconds, chunks), self.quiet, (1, -2, 1))
        halves = [half for half in (self.quiet & dim, self.quiet & ~dim) if half.any()]
        self.rows_of_halves = [_correlations(map(seconds, chunks), half, (1, -2, 1))[0] for half in halves]
        # As the movie has it, molecules included: differences of frames one after the other.
        self.everywhere, self.everywhere_of_parts = _correlations(map(firsts, chunks), lit, (1, -1))

    def kernel_sd(self, dark: rows.Correlations | None, dark_variance: float) -> Array:
        """Standard errors (lag,) of the correlations that the read-out gives to light: by the number of counts, and by
        what parts of the movie, and its dim and its bright pixels, disagree beyond that."""
        total = self.rows.variance
        counted = float(np.sqrt(2) * self.rows.sd * total / max(total - dark_variance, 1e-9))
        parts = _of_light(self.rows_of_parts, dark, dark_variance)
        course = parts.var(axis=0, ddof=1) / len(parts) if len(parts) > 1 else np.zeros(rows.LAGS)
        halves = _of_light(self.rows_of_halves, dark, dark_variance)
        level = (halves[1] - halves[0]) ** 2 / 4 if len(halves) == 2 else np.zeros(rows.LAGS)
        return np.asarray(np.sqrt(np.maximum(course, counted**2) + np.maximum(level - counted**2, 0.0)))


def _correlations(
    parts: Iterable[NDArray[np.float32]], pixels: NDArray[np.bool_], terms: tuple[float, ...]
) -> tuple[rows.Correlations, list[rows.Correlations]]:
    """Of all parts of the movie together, and of each; one part is held."""
    whole, each = None, []
    for part in parts:
        found = rows.Products.of(part, pixels)
        each.append(found.correlations(terms))
        whole = found if whole is None else whole + found
    assert whole is not None
    return whole.correlations(terms), each


def _second_differences(chunk: NDArray[np.float32], pixels: NDArray[np.bool_]) -> NDArray[np.float32]:
    """(frame − 2, y, x) without what these pixels (y, x) have in common."""
    return _in_common_off(transfer.second_differences(chunk), pixels)


def _first_differences(chunk: NDArray[np.float32], pixels: NDArray[np.bool_]) -> NDArray[np.float32]:
    """(frame − 1, y, x) without what these pixels (y, x) have in common."""
    return _in_common_off(np.diff(chunk, axis=0), pixels)


def _in_common_off(differences: NDArray[np.float32], pixels: NDArray[np.bool_]) -> NDArray[np.float32]:
    differences -= differences[:, pixels].mean(axis=1)[:, None, None]
    return differences


def _of_parts(chunks: list[NDArray[np.float32]], pixels: NDArray[np.int64]) -> tuple[tuple[Array, Array], Array]:
    """Mean and variance (part, pixel), in halves and quarters of chunks where these are few, and the variance (part,
    pixel) in common with the pixels above and below, which is taken off.

    Molecules that blink, bleach, move or emit unevenly change neighbours together; photons do not, and no read-out
    mixes along columns. Neighbours have less of a spot than its middle has: a part of what molecules do stays.
    """
    parts = []
    for chunk in chunks:
        parts += np.array_split(chunk, max(1, min(-(-LEAST_PARTS // len(chunks)), len(chunk) // transfer.RUN)))
    means, variances = transfer.photon_transfer(parts)
    shared = np.zeros_like(variances)
    for part, found in zip(parts, shared, strict=True):
        changes = transfer.second_differences(part)
        common = (changes[:, 1:] * changes[:, :-1]).mean(axis=0, dtype=np.float64) / 6
        if len(common):
            padded = np.concatenate([common[:1], common, common[-1:]])
            found += (padded[1:] + padded[:-1]) / 2
    means, variances, shared = (a.reshape(len(parts), -1)[:, pixels] for a in (means, variances, shared))
    return (means, variances - shared), shared


def _of_light(seen: list[rows.Correlations], dark: rows.Correlations | None, dark_variance: float) -> Array:
    """(part, lag) correlations that the read-out gives to light, in each part of what was seen."""
    own = np.zeros(rows.LAGS) if dark is None else np.resize(dark.row - dark.column, rows.LAGS)
    found = []
    for part in seen:
        read = 0.0 if dark is None else dark_variance
        if part.variance > 1.2 * read:
            found.append(((part.row - part.column) * part.variance - own * read) / (part.variance - read))
    return np.reshape(found, (len(found), rows.LAGS))
