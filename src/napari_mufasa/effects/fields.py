"""How something may differ across the field."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from pydantic import Field
from scipy import ndimage

from napari_mufasa.model.effect import parameter
from napari_mufasa.simulate.scene import Array, Scene


def bright_side(forms: tuple[str, ...] = ()) -> Any:
    """The field `direction_deg` of effects that make one side of the field brighter, in all or some of their forms."""
    told = "where it is brightest; 0 along x, 90 along y"
    return parameter(0.0, plausible=(0, 360), unit="deg", description=told, forms=forms)


def seen_values() -> Any:
    """The field `seen` of effects that may have any shape across the field."""
    told = "heights on a grid over the field, row by row, 0 lowest, 1 highest; () if nothing is seen: linear"
    return Field((), description=told, json_schema_extra={"forms": ["as_seen"]})


def value_columns() -> Any:
    """The field `seen_columns` beside it."""
    return Field(1, ge=1, description="columns of that grid", json_schema_extra={"forms": ["as_seen"]})


def centre_along(axis: str, form: str) -> Any:
    """The fields `centre_y` and `centre_x` of effects that have a Gaussian somewhere in the field, in one form."""
    told = f"where its middle is along {axis}; the longer side of the field reaches from −1 to 1"
    return parameter(0.0, ge=-5, le=5, plausible=(-1.2, 1.2), unit="half fields", forms=(form,), description=told)


def gaussian_width(form: str) -> Any:
    """The field `width` beside them."""
    told = "its standard deviation"
    return parameter(
        0.8, gt=0.01, le=100, plausible=(0.3, 2), unit="half fields", log=True, forms=(form,), description=told
    )


def gaussian(scene: Scene, centre: tuple[float, float], width: float) -> Callable[[Array, Array], Array]:
    """A Gaussian of pixel coordinates (y, x) of a scene, 0 where it is faintest in the field and 1 at its middle."""

    def law(y: Array, x: Array) -> Array:
        v, u = scene.centred(y, x)
        height: Array = np.exp(-((v - centre[0]) ** 2 + (u - centre[1]) ** 2) / (2 * width**2))
        return height

    faintest = float(np.min(scene.over_field(law)))
    return lambda y, x: (law(y, x) - faintest) / max(1 - faintest, 1e-12)


def relief(values: tuple[float, ...], columns: int, scene: Scene, y: Array, x: Array) -> Array:
    """Height at pixel coordinates of a scene: straight lines between the centres of the grid's cells, level beyond
    them; a last row that is not full does not count."""
    columns = min(columns, len(values))
    grid = np.reshape(values[: len(values) // columns * columns], (-1, columns))
    at = [share * cells - 0.5 for share, cells in zip(scene.shares(y, x), grid.shape, strict=True)]
    found: Array = ndimage.map_coordinates(grid, np.broadcast_arrays(*at), order=1, mode="nearest")
    return found
