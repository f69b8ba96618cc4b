"""An image splitter whose map is known, and movies taken with it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

import napari_mufasa as nm

SHAPE = (96, 96)
MODEL = nm.preset("FF").with_values(
    {
        "acquisition.n_frames": 100, "acquisition.shape_px": SHAPE, "excitation.power_density_w_per_cm2": 10,
        "optics.background_photons_per_px": 10, "fluorophore.cycles_before_bleaching": None, "sample.n_molecules": 40,
        "sample.min_distance_px": 10,
    }
)  # fmt: skip
BRIGHT = MODEL.with_values({"acquisition.n_frames": 10, "excitation.power_density_w_per_cm2": 60})
CENTRE = (np.array(SHAPE) - 1) / 2


def splitter(
    rotation_deg: float = 1.5, scale: float = 1.02, shift_px: tuple[float, float] = (3.3, -5.7), bend_px: float = 0.0,
    centre_px: NDArray[np.float64] = CENTRE,
) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:  # fmt: skip
    """Places of the donor's channel → places of the acceptor's; `bend_px` in the corners, of second order."""
    turn = np.radians(rotation_deg)
    linear = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])

    def there(places: NDArray[np.float64]) -> NDArray[np.float64]:
        u = (places - centre_px) / centre_px
        bent = bend_px / np.sqrt(2) * np.stack([u[:, 0] * u[:, 1], u[:, 1] ** 2], axis=1)
        return np.asarray((places - centre_px) @ linear.T + centre_px + np.array(shift_px) + bent)

    return there


def everywhere(shape: tuple[int, int] = SHAPE, margin: float = 8.0) -> NDArray[np.float64]:
    """Places (100, 2) all over a channel."""
    axes = [np.linspace(margin, n - 1 - margin, 10) for n in shape]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
