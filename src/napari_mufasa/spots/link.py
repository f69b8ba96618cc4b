"""From spots of single frames to paths of molecules (docs/traces.md)."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.errors import Cancelled, MufasaError
from napari_mufasa.spots.locate import Places

Array = NDArray[np.float64]
LEAST_FRAMES = 5  # spots in a row that noise does not put together
MOST_GAP = 5  # frames that a molecule may be missed or dark for


@dataclass(frozen=True)
class Paths:
    """Molecules that were followed.

    path_px : (molecule, frame, 2) where each was found, (y, x), in the mean of the frames around; nan where it was not
    seen_px : (molecule, frame, 2) where it was seen in the frame itself: with errors that are independent of each other
    strength : (molecule,) median noise sd of its spots · shorter : how many paths were too short to count
    """

    path_px: Array
    seen_px: Array
    strength: Array
    shorter: int

    @property
    def found(self) -> NDArray[np.bool_]:
        """(molecule, frame) whether it was found."""
        return np.asarray(np.isfinite(self.path_px[..., 0]))

    def ends(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """First and last frame (molecule,) in which each was found."""
        found = self.found
        return found.argmax(axis=1), found.shape[1] - 1 - found[:, ::-1].argmax(axis=1)

    def everywhere(self) -> Array:
        """(molecule, frame, 2): where it was not found, on the straight line between; before the first and after the
        last sighting in that place."""
        t = np.arange(self.path_px.shape[1])
        whole = np.empty_like(self.path_px)
        for path, found, filled in zip(self.path_px, self.found, whole, strict=True):
            for axis in range(2):
                filled[:, axis] = np.interp(t, t[found], path[found, axis])
        return whole


def farthest_step_px(sigma_px: float) -> float:
    """How far a molecule may move from one frame to the next where nothing else is said: twice the width of the PSF,
    so that its spot is still one."""
    return max(2.0, 2.0 * sigma_px)


def link(
    places: Places, n_frames: int, max_step_px: float, *, max_gap: int = MOST_GAP, least_frames: int = LEAST_FRAMES,
    cancel: Callable[[], bool] | None = None,
) -> Paths:  # fmt: skip
    """Paths of molecules through the spots of single frames: the links that are shortest together (trackpy; Crocker
    and Grier, J. Colloid Interface Sci. 179, 298 (1996)).

    max_step_px : from one sighting to the next a molecule moves no farther
    max_gap : frames that it may be missed for in between
    least_frames : paths with fewer sightings do not count

    Raises `MufasaError` where spots lie so close together for such steps that links cannot be told.
    """
    ids = np.zeros(len(places.frame), dtype=np.int64)
    edges = np.searchsorted(places.frame, np.arange(n_frames + 1))
    levels = (places.position_px[a:b] for a, b in pairwise(edges))
    with _without_log():
        from trackpy import SubnetOversizeException, link_iter

        try:
            for t, found in link_iter(enumerate(levels), max_step_px, memory=max_gap):
                ids[edges[t] : edges[t + 1]] = found
                if cancel is not None and cancel():
                    raise Cancelled
        except SubnetOversizeException:
            raise MufasaError(
                f"spots lie too close together to be followed with steps of {max_step_px:g} px: "
                "give a smaller max_step_px, or a higher threshold"
            ) from None
    _, path, count = np.unique(ids, return_inverse=True, return_counts=True)
    long = count >= least_frames
    number = np.cumsum(long) - 1
    kept = long[path] if len(path) else np.zeros(0, dtype=bool)
    found = np.full((2, int(long.sum()), n_frames, 2), np.nan)
    found[:, number[path[kept]], places.frame[kept]] = places.position_px[kept], places.own_px[kept]
    order = np.argsort(number[path[kept]], kind="stable")
    each = np.split(places.strength[kept][order], np.cumsum(count[long])[:-1])
    strength = np.array([np.median(values) for values in each if len(values)], dtype=np.float64)
    return Paths(found[0], found[1], strength, int((~long).sum()))


@contextlib.contextmanager
def _without_log() -> Iterator[None]:
    """The library tells every frame; that is not for users."""
    logger = logging.getLogger("trackpy")
    before = logger.disabled
    inner = logging.getLogger("trackpy.linking.linking")
    inner_before, inner.disabled, logger.disabled = inner.disabled, True, True
    try:
        yield
    finally:
        logger.disabled, inner.disabled = before, inner_before
