"""What a movie shows: about a hundred named numbers, the same for measured and simulated movies.

`observe` treats both alike: it finds the spots itself, so that whatever detection misses or merges, it misses
and merges in both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from napari_mufasa.observe import field, summary
from napari_mufasa.observe.pixels import pixel_statistics
from napari_mufasa.observe.summary import Part
from napari_mufasa.observe.table import Meaning, Table
from napari_mufasa.spots.follow import Spots, find_and_follow
from napari_mufasa.traces.dynamics import Dynamics, dynamics

if TYPE_CHECKING:
    from napari_mufasa.model.model import Model

PARTS = ("all", "white", "black")
PART_LABELS = ((1, 2), (1,), (2,))
TILES = 6  # the field is a checkerboard of about TILES × TILES tiles: each half tests what the other was fitted to

LEAST_BACKGROUND = 0.1  # of the field: pixels farthest from spots that are never called near


@dataclass(frozen=True)
class Observation:
    """Observables of one movie: (part, observable) values in a fixed order, and what they were made from.

    side (molecule,) : the half of the field that each spot is in, 1 white, 2 black
    courses (part, frame) : background, photoelectrons
    maps (part, tile_y, tile_x) : background, photoelectrons, NaN under spots and outside the part
    """

    values: NDArray[np.float64]
    names: tuple[str, ...]
    meanings: dict[str, Meaning]
    spots: Spots
    states: Dynamics  # of the spots' light
    side: NDArray[np.int8]
    courses: NDArray[np.float64]
    maps: NDArray[np.float64]

    @property
    def course(self) -> NDArray[np.float64]:
        """(frame,) of the whole field."""
        result: NDArray[np.float64] = self.courses[0]
        return result

    @property
    def background_map(self) -> NDArray[np.float64]:
        """(tile_y, tile_x) of the whole field."""
        result: NDArray[np.float64] = self.maps[0]
        return result

    def part(self, name: str) -> NDArray[np.float64]:
        result: NDArray[np.float64] = self.values[PARTS.index(name)]
        return result

    def only(self, name: str) -> Observation:
        """What a part of the field shows, as if it were all there is. The spots' common path is that of the field."""
        i = PARTS.index(name)
        here = np.isin(self.side, PART_LABELS[i])
        values, courses, maps = (
            np.repeat(v[i : i + 1], len(PARTS), axis=0) for v in (self.values, self.courses, self.maps)
        )
        return replace(
            self, values=values, courses=courses, maps=maps, side=self.side[here], spots=self.spots.of(here),
            states=self.states.of(here),
        )  # fmt: skip

    def molecules(self) -> tuple[NDArray[np.float64], Dynamics]:
        """Light (molecule, frame) and dynamics of the molecules whose traces count."""
        seen = summary.well_seen(self.spots, self.states)
        return self.spots.light[seen], self.states.of(seen)

    def together(self) -> NDArray[np.float64]:
        """(frame,) the light of all molecules inside the field."""
        total: NDArray[np.float64] = self.spots.light[self.spots.inside].sum(axis=0)
        return total


@dataclass(frozen=True)
class DarkView:
    """Observables of dark frames, one table for each part: made once where many movies share dark frames."""

    tables: tuple[Table, ...]


def view_dark(dark: NDArray[Any], model: Model) -> DarkView:
    """Observables of dark frames (frame, y, x) ADU."""
    counts = _counts(dark)
    tiles = checkerboard(dark.shape[1:])
    pixels = pixel_statistics(counts, model.camera.baseline_adu, tiles, 2)
    tables = []
    for labels in PART_LABELS:
        table = Table()
        part = Part(labels, np.zeros(0, dtype=bool))
        field.dark(table, pixels, tiles, part, photoelectrons_per_adu(model), len(dark))
        tables.append(table)
    return DarkView(tuple(tables))


def observe(movie: NDArray[Any], model: Model, dark: NDArray[Any] | DarkView | None = None) -> Observation:
    """Observables of a movie (frame, y, x) ADU, and of its dark frames.

    `model` gives the camera's units and the PSF width to look for; nothing else of it is used. Peak memory:
    a few images and courses beside the movie.
    """
    movie = _counts(movie)
    camera = model.camera
    scale = photoelectrons_per_adu(model)
    sigma = model.sigma_px
    spots = find_and_follow(movie, camera, scale, sigma)
    states = dynamics(spots.light)
    tiles = checkerboard(movie.shape[1:])
    label = np.where(_near_spots(movie.shape[1:], spots, 4 * sigma), 0, tiles).astype(np.int8)
    pixels = pixel_statistics(movie, camera.baseline_adu, label, 2)
    at = np.clip(np.rint(spots.positions_px).astype(int), 0, np.array(movie.shape[1:]) - 1)
    side = tiles[at[:, 0], at[:, 1]]
    if dark is not None and not isinstance(dark, DarkView):
        dark = view_dark(dark, model)
    tables, backgrounds = [], []
    for i, labels in enumerate(PART_LABELS):
        table = Table()
        part = Part(labels, np.isin(side, labels))
        seen = field.seen_background(pixels, label, part, scale, spots.positions_px)
        summary.molecules(table, spots, states, part, movie.shape[1:], seen)
        field.background(table, pixels, spots, label, tiles, part, scale, seen)
        if dark is not None:
            table.include(dark.tables[i])
        tables.append(table)
        backgrounds.append(seen)
    names = tuple(tables[0].values)
    values = np.array([list(t.values.values()) for t in tables])
    courses, maps = (np.array([getattr(seen, each) for seen in backgrounds]) for each in ("course", "tiles"))
    return Observation(values, names, tables[0].meanings, spots, states, side.astype(np.int8), courses, maps)


def photoelectrons_per_adu(model: Model) -> float:
    """Photoelectrons per ADU near zero signal."""
    camera = model.camera
    if camera.type == "CMOS":
        (x0, y0), (x1, y1) = camera.cmos_gain_curve[:2]
        return camera.electrons_per_adu * (x1 - x0) / (y1 - y0)
    return camera.electrons_per_adu / float(camera.em_gain or 1.0)


def checkerboard(shape: tuple[int, ...]) -> NDArray[np.int8]:
    """(y, x) of 1 and 2 in tiles."""
    size = max(4, int(np.ceil(max(shape) / TILES)))
    y, x = np.indices(shape)
    tiles: NDArray[np.int8] = ((y // size + x // size) % 2 + 1).astype(np.int8)
    return tiles


def _counts(movie: NDArray[Any]) -> NDArray[np.uint16]:
    if movie.dtype == np.uint16:
        return np.ascontiguousarray(movie)
    counts: NDArray[np.uint16] = np.clip(np.rint(movie), 0, 65535).astype(np.uint16)
    return counts


def _near_spots(shape: tuple[int, ...], spots: Spots, reach_px: float) -> NDArray[np.bool_]:
    """(y, x) where spots are within reach at any time; a crowded field has its farthest pixels for a background."""
    far, last = np.ones(shape, dtype=bool), np.array(shape) - 1
    for step in spots.path_px:
        at = np.rint(spots.positions_px + step).astype(int)
        beside = np.all((at > -reach_px) & (at < last + reach_px), axis=1)  # a spot beyond the edge lights pixels, too
        far[tuple(np.clip(at[beside], 0, last).T)] = False
    if far.all():
        return np.zeros(shape, dtype=bool)
    distance_px: NDArray[np.float64] = ndimage.distance_transform_edt(far)
    farthest = float(np.quantile(distance_px, 1 - LEAST_BACKGROUND))
    result: NDArray[np.bool_] = distance_px < min(reach_px, max(farthest, 1.0))
    return result
