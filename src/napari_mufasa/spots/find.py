"""Where molecules are: local maxima of the evidence above a threshold (docs/traces.md).

The one finder: traces are extracted, and movies are observed for a diagnosis, at the places it gives.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from napari_mufasa import checks
from napari_mufasa.camera.frames import Frames
from napari_mufasa.errors import MufasaError
from napari_mufasa.spots.evidence import Evidence, peak_offsets, search
from napari_mufasa.spots.filters import Image, lower_spread

Threshold = Literal["sigma", "percentile", "otsu", "triangle"]
THRESHOLDS: tuple[Threshold, ...] = ("sigma", "percentile", "otsu", "triangle")
NOISE_SD = 6.0  # of the "sigma" threshold
LEAST_PROMINENCE = 0.2  # of a peak in every direction; isolated spots have 0.3 … 0.7, edges 0.1 ± 0.06
LEAST_BESIDE = 0.1  # of a pixel's height: so bright are the four beside a spot's top; the narrowest spot's have 0.2
SOLID = 0.8  # of the pixels beside one that changes: so many change in a field of view, where light is not scarce
BESIDE = np.array([[0.0, 0.25, 0.0], [0.25, 0.0, 0.25], [0.0, 0.25, 0.0]])  # the four beside


@dataclass(frozen=True)
class Found:
    """Candidates for molecules.

    positions_px (candidate, 2) · significance (candidate,) in noise sd · prominence (candidate,) see `prominence`
    evidence : what they were found in
    """

    positions_px: NDArray[np.float64]
    significance: NDArray[np.float64]
    prominence: NDArray[np.float64]
    evidence: Evidence

    @property
    def is_spot(self) -> NDArray[np.bool_]:
        """(candidate,) False for what goes on in one direction: an edge or a line."""
        return np.asarray(self.prominence >= LEAST_PROMINENCE)


def find_spots(
    frames: Frames,
    sigma_px: float,
    *,
    threshold: Threshold = "sigma",
    value: float | None = None,
    block: int | None = None,
    drift_px: NDArray[np.float64] | None = None,
    report: Callable[[int], None] | None = None,
    cancel: Callable[[], bool] | None = None,
) -> Found:
    """Find what looks like molecules in a movie, read once, block by block.

    threshold, value : see `candidates`; block, drift_px : see `search`
    report : called with the frames of each block read; cancel : True stops (raises `Cancelled`)
    """
    seen = search(frames, sigma_px, block=block, drift_px=drift_px, report=report, cancel=cancel)
    peaks = candidates(seen.image, sigma_px, method=threshold, value=value, spread=seen.spread)
    significance = seen.image[tuple(peaks.T)].astype(np.float64)
    positions = summits(seen.signal, peaks)
    return Found(positions, significance, prominence(seen.image, positions, sigma_px), seen)


def candidates(
    image: Image,
    sigma_px: float,
    *,
    method: Threshold = "sigma",
    value: float | None = None,
    spread: float | None = None,
) -> NDArray[np.int64]:
    """Pixels (candidate, 2) of the local maxima of an image of evidence above a threshold.

    method : "sigma": `value` (6) noise sd, and as many robust sd above the image's own background, so that
        heavy-tailed noise (electron multiplication) raises no false candidates; "percentile": `value` (98)
        of the pixels lie below; "otsu", "triangle": from the histogram.
    spread : robust sd of the background (None: that of the image's lower half)
    """
    from skimage.feature import peak_local_max

    level = threshold_level(image, method, value, spread)
    distance = max(1, round(sigma_px))
    peaks = peak_local_max(  # type: ignore[no-untyped-call]
        image, min_distance=distance, threshold_abs=level, exclude_border=False
    )
    return np.asarray(peaks, dtype=np.int64).reshape(-1, 2)


def summits(image: Image, peaks: NDArray[np.int64]) -> NDArray[np.float64]:
    """Places (candidate, 2) of the maxima of an image next to some pixels (candidate, 2), to a part of a pixel."""
    padded = np.pad(image, 1, constant_values=-np.inf)
    steps = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1], indexing="ij"), axis=-1).reshape(-1, 2)
    y, x = (peaks[:, None] + 1 + steps).transpose(2, 0, 1)
    tops = peaks + steps[np.argmax(padded[y, x], axis=1)]
    return np.asarray(tops + peak_offsets(image, tops))


def check_threshold(method: str, value: float | None) -> None:
    """Raise `MufasaError` for a threshold that is none."""
    if method not in THRESHOLDS:
        raise MufasaError(f"threshold {method!r} is unknown: choose one of {', '.join(THRESHOLDS)}")
    if method == "sigma" and value is not None and checks.number(value, "threshold_value") <= 0:
        raise MufasaError(f"threshold_value = {value}: give a number of noise sd above 0")
    if method == "percentile" and value is not None:
        checks.number(value, "threshold_value (a percentile)", 0, 100)


def threshold_level(image: Image, method: Threshold, value: float | None, spread: float | None = None) -> float:
    from skimage import filters

    check_threshold(method, value)
    if method == "sigma":
        k = NOISE_SD if value is None else float(value)
        return max(k, float(np.median(image)) + k * (lower_spread(image) if spread is None else spread))
    if method == "percentile":
        return float(np.percentile(image, 98.0 if value is None else float(value)))
    if method == "otsu":
        return float(filters.threshold_otsu(image))  # type: ignore[no-untyped-call]
    return float(filters.threshold_triangle(image))  # type: ignore[no-untyped-call]


def prominence(image: Image, positions_px: NDArray[np.float64], sigma_px: float) -> NDArray[np.float64]:
    """How much of a peak stands out in every direction, (candidate,): near 0.6 for a spot, 0 along an edge.

    The peak minus the mean of two opposite points 2 σ away, in the least favourable of four directions,
    relative to the peak: an edge or a filament has one direction in which it goes on.
    """

    def at(points: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(ndimage.map_coordinates(image, points.T, order=1, mode="nearest"), dtype=np.float64)

    peak = at(positions_px)
    angles = np.arange(4) * np.pi / 4
    steps = 2 * sigma_px * np.stack([np.sin(angles), np.cos(angles)], axis=1)
    drops = [peak - 0.5 * (at(positions_px + step) + at(positions_px - step)) for step in steps]
    return np.asarray(np.min(drops, axis=0) / np.maximum(peak, 1e-12))


def neighbour_px(positions_px: NDArray[np.float64], is_spot: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Distance from each candidate to the nearest other one that is a spot, (candidate,); inf without any."""
    from scipy.spatial import KDTree

    if is_spot.sum() < 2:
        return np.full(len(positions_px), np.inf)
    distance = KDTree(positions_px[is_spot]).query(positions_px, k=2)[0]
    return np.asarray(np.where(is_spot, distance[:, 1], distance[:, 0]), dtype=float)


def isolation_px(sigma_px: float) -> float:
    """The distance to a neighbour from which on a molecule counts as standing alone."""
    return max(3.0, 3.5 * sigma_px)


def estimate_sigma_px(frames: Frames, n_spots: int = 40) -> float | None:
    """PSF sd in px measured on the brightest isolated spots of the movie's beginning; None without spots.

    A spot of variance v = σ² + 1/12 (a pixel's own) answers blur(s) − blur(s') with 1/(v+s²) − 1/(v+s'²): σ is the
    width whose answers are most nearly parallel to those of the spots at their tops, over all scales first, then over
    those up to twice the width, which neighbours do not reach. Light has passed the optics: what is a single pixel, an
    edge or a line, or never changes, tells nothing of their width.
    """
    n = min(frames.n_frames, max(1, min(50, frames.block_frames())))
    counts = np.asarray(frames.movie[:n])
    live = _live(counts)
    image = _of_light(frames.photoelectrons(counts), live)
    scales = np.array([0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6])
    blurs = [ndimage.gaussian_filter(image, s) for s in [*scales, scales[-1] * np.sqrt(2)]]
    responses = np.stack([(a - b) * s**2 for a, b, s in zip(blurs, blurs[1:], scales, strict=False)])
    noise = np.array([lower_spread(r[live]) for r in responses])
    ratio = responses / np.maximum(noise, 1e-12)[:, None, None]
    best = ratio.max(axis=0)
    peaks = candidates(best, 1.4, spread=lower_spread(best[live]))
    at = ratio[:, *peaks.T]
    out = np.stack([prominence(r, peaks.astype(float), s) for r, s in zip(ratio, scales, strict=True)])
    stands = ((out >= LEAST_PROMINENCE) & (at >= 0.5 * at.max(axis=0))).any(axis=0)  # at the scale of any spot there
    peaks = peaks[stands]
    if len(peaks) == 0:
        return None
    chosen = peaks[np.argsort(-best[tuple(peaks.T)])[:n_spots]]
    curves = np.median(_tops(responses, chosen) / scales[:, None] ** 2, axis=1)
    widths = np.geomspace(0.5, 8.0, 200)
    steps = np.append(scales, scales[-1] * np.sqrt(2))
    variance = widths[:, None] ** 2 + 1 / 12
    models = 1 / (variance + steps[:-1] ** 2) - 1 / (variance + steps[1:] ** 2)

    def nearest(n: int) -> float:
        parallel = models[:, :n] @ curves[:n] / np.linalg.norm(models[:, :n], axis=1)
        return float(widths[np.argmax(parallel)])

    first = nearest(len(scales))
    return nearest(max(3, int(np.count_nonzero(scales <= 2 * first))))


def _live(counts: NDArray[Any]) -> NDArray[np.bool_]:
    """(y, x) False for pixels of a stack (frame, y, x) that never change: a margin of zeros, dead and saturated ones.
    In a single frame, or one that is repeated: those that are as all around. Where hardly any changes, light is scarce:
    all are True."""
    live = counts.max(axis=0) > counts.min(axis=0)
    if not live.any():
        live = ndimage.maximum_filter(counts[0], 3) > ndimage.minimum_filter(counts[0], 3)
    beside = ndimage.uniform_filter(live.astype(np.float32), 3)[live]
    return live if beside.size and beside.mean() > SOLID else np.ones_like(live)


def _of_light(stack: NDArray[np.float32], live: NDArray[np.bool_]) -> Image:
    """Mean (y, x) of photoelectrons (frame, y, x) as light that has passed the optics makes it: pixels that are not
    `live` show the nearest that is, one that stands out alone, as no spot does, shows the median around it."""
    image = stack.mean(axis=0)
    if not live.all():
        image = image[tuple(ndimage.distance_transform_edt(~live, return_distances=False, return_indices=True))]
    around = ndimage.median_filter(image, 5)
    above = image - around
    beside = ndimage.convolve(image, BESIDE, mode="mirror") - around
    # So many sd, those of its own photons among them: few photons may well miss the pixels beside.
    clear = above > max(NOISE_SD * lower_spread(above[live]), NOISE_SD**2 / len(stack))
    return np.asarray(np.where(clear & (beside < LEAST_BESIDE * above), around, image))


def _tops(images: NDArray[np.floating], peaks: NDArray[np.int64]) -> NDArray[np.float64]:
    """Heights (image, peak) of the parabolas through some maxima (peak, 2) of images (image, y, x): a spot's top lies
    between the pixels."""
    padded = np.pad(images, ((0, 0), (1, 1), (1, 1)), mode="edge")
    y, x = peaks.T + 1
    middle = padded[:, y, x].astype(np.float64)
    heights = middle.copy()
    for before, after in (((y - 1, x), (y + 1, x)), ((y, x - 1), (y, x + 1))):
        low, high = padded[:, *before], padded[:, *after]
        bend = low - 2 * middle + high
        heights -= np.divide((low - high) ** 2, 8 * bend, out=np.zeros_like(middle), where=np.abs(low - high) < -bend)
    return heights
