"""How something may differ across the field, and how a movie's background shows it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field
from scipy import ndimage

from napari_mufasa.effects.base import parameter
from napari_mufasa.scene import Array

if TYPE_CHECKING:
    from napari_mufasa.observe import Observation

FEWEST_TILES = 12  # of the background's map that tell a relief
SEEN = 0.5  # variance of the smoothed map over that of what smoothing takes away: white noise on 12 × 12 tiles reached
# 0.42 at most in 20 000 draws, on 6 × 6 tiles one in 80 passes


def bright_side(forms: tuple[str, ...] = ()) -> Any:
    """The field `direction_deg` of effects that make one side of the field brighter, in all or some of their forms."""
    told = "where it is brightest; 0 along x, 90 along y"
    return parameter(0.0, plausible=(0, 360), unit="deg", description=told, forms=forms)


def seen_bright_side(observation: Observation) -> dict[str, float]:
    """`direction_deg` as the background's tilt shows it."""
    seen = dict(zip(observation.names, observation.part("all"), strict=True))
    tilt = np.arctan2(seen["background_map_tilt_y"], seen["background_map_tilt_x"])
    return {"direction_deg": float(np.rad2deg(tilt) % 360)}


def seen_values() -> Any:
    """The field `seen` of effects that may have any shape across the field."""
    told = "heights on a grid over the field, row by row, 0 lowest, 1 highest; () if nothing is seen: linear"
    return Field((), description=told, json_schema_extra={"forms": ["as_seen"]})


def value_columns() -> Any:
    """The field `seen_columns` beside it."""
    return Field(1, ge=1, description="columns of that grid", json_schema_extra={"forms": ["as_seen"]})


def relief(values: tuple[float, ...], columns: int, y: Array, x: Array, shape_px: tuple[int, int]) -> Array:
    """Height at pixel coordinates: straight lines between the centres of the grid's cells, level beyond them;
    a last row that is not full does not count."""
    columns = min(columns, len(values))
    grid = np.reshape(values[: len(values) // columns * columns], (-1, columns))
    at = [(place + 0.5) / n * cells - 0.5 for place, n, cells in zip((y, x), shape_px, grid.shape, strict=True)]
    found: Array = ndimage.map_coordinates(grid, np.broadcast_arrays(*at), order=1, mode="nearest")
    return found


def seen_relief(observation: Observation) -> dict[str, Any]:
    """`seen` and `seen_columns` from the background's map, smoothed over neighbouring tiles; () where it shows
    nothing but noise."""
    tiles = observation.background_map
    known = np.isfinite(tiles)
    nothing = {"seen": (), "seen_columns": 1}
    if known.sum() < FEWEST_TILES:
        return nothing
    weight = ndimage.gaussian_filter(known.astype(float), 1.0, mode="nearest")
    smooth = ndimage.gaussian_filter(np.where(known, tiles, 0.0), 1.0, mode="nearest") / np.maximum(weight, 1e-9)
    if smooth[known].var() < SEEN * (tiles - smooth)[known].var():
        return nothing
    height = (smooth - smooth.min()) / np.ptp(smooth)
    return {"seen": tuple(height.ravel().round(4).tolist()), "seen_columns": tiles.shape[1]}
