"""Where the molecules are: random with a minimum distance, on a grid, or from a CSV in nm or pixels."""

from __future__ import annotations

import math
import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.errors import MufasaError
from napari_mufasa.model.setup import Setup


def place(setup: Setup, rng: np.random.Generator) -> NDArray[np.float64]:
    """Positions (molecule, 2), (y, x) in detector pixels, by the model's sample layout."""
    sample, shape = setup.sample, setup.acquisition.shape_px
    if sample.layout == "grid":
        return grid(sample.n_molecules, shape)
    return scatter(sample.n_molecules, shape, sample.min_distance_px, rng)


def scatter(n: int, shape_px: tuple[int, int], min_distance_px: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Uniform positions over the detector, none nearer than `min_distance_px` to another (n, 2).

    Raises `MufasaError` when the field cannot hold that many (darts are thrown until 200 misses per molecule).
    """
    extent = np.asarray(shape_px, dtype=float)
    if min_distance_px <= 0:
        return np.asarray(rng.random((n, 2)) * extent - 0.5)
    cell = min_distance_px / np.sqrt(2)  # a cell this small holds one molecule at most
    taken: dict[tuple[int, int], tuple[float, float]] = {}
    misses = 0
    while len(taken) < n:
        y, x = (rng.random(2) * extent - 0.5).tolist()
        row, column = math.floor((y + 0.5) / cell), math.floor((x + 0.5) / cell)
        near = (taken.get((row + i, column + j)) for i in range(-2, 3) for j in range(-2, 3))
        if any(p is not None and math.hypot(p[0] - y, p[1] - x) < min_distance_px for p in near):
            misses += 1
            if misses > 200 * n:
                raise MufasaError(
                    f"{n} molecules at least {min_distance_px} px apart do not fit {shape_px} px "
                    f"({len(taken)} did): lower n_molecules or min_distance_px"
                )
            continue
        taken[row, column] = y, x
    return np.array(list(taken.values())).reshape(-1, 2)


def grid(n: int, shape_px: tuple[int, int]) -> NDArray[np.float64]:
    """n positions on a square lattice that fills the detector (n, 2)."""
    height, width = shape_px
    columns = max(1, round(np.sqrt(n * width / height)))
    rows = max(1, int(np.ceil(n / columns)))
    y = (np.arange(rows) + 0.5) * height / rows - 0.5
    x = (np.arange(columns) + 0.5) * width / columns - 0.5
    lattice = np.stack(np.meshgrid(y, x, indexing="ij"), axis=-1).reshape(-1, 2)
    return lattice[:n]


def check_positions(positions_px: Any) -> NDArray[np.float64]:
    """Positions as float64 (molecule, 2), (y, x) in pixels; raises `MufasaError` when they are not that."""
    try:
        positions = np.asarray(positions_px, dtype=np.float64)
    except (TypeError, ValueError):
        raise MufasaError("positions_px are no numbers: give finite (molecule, 2) positions (y, x) in pixels") from None
    if positions.ndim != 2 or positions.shape[1] != 2 or not np.isfinite(positions).all():
        raise MufasaError(
            f"positions_px has shape {positions.shape}: give finite (molecule, 2) positions (y, x) in pixels"
        )
    return positions


def read_positions(path: str | os.PathLike[str], pixel_size_nm: float) -> NDArray[np.float64]:
    """Positions (molecule, 2), (y, x) in pixels, from a CSV.

    Columns ``y_px, x_px`` or ``y_nm, x_nm`` in any order; without a header the first two columns are x, y in
    nm (the form of emitter lists). In nm, (0, 0) is the detector's corner. Raises `MufasaError`.
    """
    import pandas as pd

    try:
        table = pd.read_csv(path, header=None, dtype=str, skipinitialspace=True, comment="#")
        if len(table.columns) > 1 and all(_is_number(cell) for cell in table.iloc[0]):
            table = table.rename(columns={0: "x_nm", 1: "y_nm"})
        else:
            table = table.rename(columns={i: str(name).strip() for i, name in table.iloc[0].items()}).iloc[1:]
    except FileNotFoundError:
        raise MufasaError(f"no file {path}: give a CSV of positions") from None
    except (ValueError, IndexError, OSError) as error:
        raise MufasaError(f"{path} is not a CSV of positions ({error}): give y_px, x_px or y_nm, x_nm") from None
    for unit, scale, origin in (("px", 1.0, 0.0), ("nm", pixel_size_nm, 0.5)):
        if {f"y_{unit}", f"x_{unit}"} <= set(table.columns):
            numbers = table[[f"y_{unit}", f"x_{unit}"]].apply(pd.to_numeric, errors="coerce").to_numpy(dtype=float)
            if not len(numbers):
                raise MufasaError(f"{path} holds no position: give at least one (an empty field has 0 molecules)")
            if not np.isfinite(numbers).all():
                row = int(np.nonzero(~np.isfinite(numbers).all(axis=1))[0][0]) + 1
                raise MufasaError(f"{path} has a position that is not a number (molecule {row}): remove that row")
            return np.asarray(numbers / scale - origin, dtype=np.float64)
    raise MufasaError(f"{path} has columns {list(table.columns)}: needs y_px, x_px or y_nm, x_nm")


def _is_number(text: object) -> bool:
    try:
        float(str(text))
    except ValueError:
        return False
    return True
