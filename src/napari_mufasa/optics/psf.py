"""From emitted photons to the optical image (docs/optics.md).

Emitters are points, so a frame is the sum over emitters of the Gaussian PSF integrated over each detector
pixel. `image_on_grid` is the same image by the source's operator path (fine grid, blur, L×L sums); the two
agree to the grid error.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.optics.gaussian import REACH_SIGMA


def spot_images(
    photons: NDArray[np.floating], positions_px: NDArray[np.floating], sigma_px: NDArray[np.floating],
    shape_px: tuple[int, int],
) -> NDArray[np.float32]:  # fmt: skip
    """Expected photons per pixel from point emitters; pixel (i, j) covers [i−½, i+½] × [j−½, j+½].

    Parameters
    ----------
    photons : (frame, molecule) photons that reach the detector plane
    positions_px : (frame, molecule, 2) or, for molecules at rest, (1, molecule, 2); (y, x)
    sigma_px : (frame, 2) or (1, 2) PSF standard deviations (y, x)
    shape_px : (height, width). Photons outside are lost; nothing wraps round.

    Returns
    -------
    (frame, y, x) float32
    """
    from napari_mufasa.optics.kernels import draw_spots

    images = np.zeros((len(photons), *shape_px), dtype=np.float32)
    if np.all(sigma_px == sigma_px[0]):
        sigma_px = sigma_px[:1]
    draw_spots(
        images,
        np.ascontiguousarray(photons, dtype=np.float64),
        np.ascontiguousarray(positions_px, dtype=np.float64),
        np.ascontiguousarray(sigma_px, dtype=np.float64),
    )
    return images


def add_pattern(images: NDArray[np.float32], course: NDArray[np.float32], pattern: NDArray[np.float32]) -> None:
    """Add a pattern (y, x) to images (frame, y, x), each times its course (frame,)."""
    from napari_mufasa.optics import kernels

    kernels.add_pattern(images, course, pattern)


def elongated(
    photons: NDArray[np.floating], positions_px: NDArray[np.floating], sigma_px: NDArray[np.floating],
    log_ratio: float, direction: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:  # fmt: skip
    """Emitters as weighted copies along a line: with a round PSF of `sigma_px` across it, together they make a
    Gaussian that is exp(log_ratio) times longer along `direction` (rad; 0 along x).

    Shapes as in `spot_images`; a Gaussian along a line is its Gauss–Hermite quadrature, exact in the first moments, its
    nodes less than 1.6 PSF widths apart, without those that have next to no weight.
    """
    node, weight = np.polynomial.hermite_e.hermegauss(3 + 2 * int(np.ceil(np.expm1(2 * log_ratio))))
    heavy = weight > 1e-7 * weight.max()
    node, weight = node[heavy], weight[heavy]
    reach = sigma_px.mean(axis=1) * np.sqrt(np.expm1(2 * log_ratio))  # (frame,)
    if np.all(sigma_px == sigma_px[0]):
        reach = reach[:1]
    step = np.multiply.outer(np.multiply.outer(reach, node), [np.sin(direction), np.cos(direction)])  # (frame, k, 2)
    copies = (positions_px[:, None] + step[:, :, None]).reshape(-1, len(node) * positions_px.shape[1], 2)
    share = weight / weight.sum()
    return (photons[:, None] * share[None, :, None]).reshape(len(photons), -1), copies


def image_on_grid(
    photons: NDArray[np.floating], positions_px: NDArray[np.floating], sigma_px: tuple[float, float],
    shape_px: tuple[int, int], factor: int,
) -> NDArray[np.float64]:  # fmt: skip
    """One frame by the operator path UΨ: emitters binned on an L-fold finer grid, blurred, summed L×L.

    `photons` is (molecule,), `positions_px` (molecule, 2); returns (y, x).
    """
    from scipy.ndimage import gaussian_filter

    margin = int(np.ceil(REACH_SIGMA * max(sigma_px))) + 1  # emitters just outside still light the field
    fine_shape = tuple((n + 2 * margin) * factor for n in shape_px)
    fine = np.zeros(fine_shape)
    index = np.floor((np.asarray(positions_px, float) + 0.5 + margin) * factor).astype(int)
    inside = np.all((index >= 0) & (index < fine_shape), axis=1)
    np.add.at(fine, tuple(index[inside].T), np.asarray(photons, float)[inside])
    blurred = gaussian_filter(fine, [s * factor for s in sigma_px], mode="constant", truncate=REACH_SIGMA + 1)
    height, width = (n + 2 * margin for n in shape_px)
    summed = blurred.reshape(height, factor, width, factor).sum(axis=(1, 3))
    result: NDArray[np.float64] = summed[margin : height - margin, margin : width - margin]
    return result
