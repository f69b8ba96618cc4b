"""From frames to traces: one linear operator per profile, applied to every frame (docs/traces.md).

A trace is a weighted sum of pixels minus the same weights times a local background, and both are linear in
the frame. So all traces of a block of frames are one sparse matrix times the block.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from napari_mufasa.camera.frames import Stack
from napari_mufasa.optics.gaussian import pixel_shares

Profile = Literal["psf", "sum", "brightest_pixel"]
MIN_RING = 12  # pixels; with fewer undisturbed ones the ring keeps pixels near other molecules too
WINDOW_SIGMA = 3.0
DISC_SIGMA = 2.5  # radius of the profile "sum"
TELLS = 0.25  # of a ring: with less of it undisturbed it tells no slope, but the light of what stands around
DOUBT = 0.03  # of a whole ring's Σ y²: a part of a ring that lies to one side tells hardly a slope, but noise


@dataclass(frozen=True)
class Aperture:
    """Sparse operators (candidate, pixel): `signal` gives the trace, `background` the local background, `slope` its
    slopes along y, then along x (2 candidate, pixel)."""

    signal: sparse.csr_matrix
    background: sparse.csr_matrix
    slope: sparse.csr_matrix
    window: NDArray[np.int64]  # (candidate, window pixel) flat pixel index, clipped at the border
    window_offset: NDArray[np.float64]  # (candidate, window pixel, 2) pixel centre minus position
    inside: NDArray[np.bool_]  # (candidate, window pixel) False where the window leaves the field
    weight: NDArray[np.float64]  # (candidate,) sum of the profile's weights: pixels' worth of background in a trace

    def traces(self, stack: Stack) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Traces and local backgrounds per pixel, each (candidate, frame), of a block (frame, y, x)."""
        pixels = np.ascontiguousarray(stack.reshape(len(stack), -1).T)
        return self.signal @ pixels, self.background @ pixels

    def slopes(self, stack: Stack) -> NDArray[np.float32]:
        """Slopes (2, candidate, frame) of the local background along y and x, per px, of a block (frame, y, x)."""
        pixels = np.ascontiguousarray(stack.reshape(len(stack), -1).T)
        return np.asarray((self.slope @ pixels).reshape(2, -1, len(stack)))


def aperture(
    positions_px: NDArray[np.float64],
    shape_px: tuple[int, int],
    sigma_px: float,
    profile: Profile,
    *,
    subtract_background: bool = True,
    neighbours_px: NDArray[np.float64] | None = None,
) -> Aperture:
    """Operators for molecules at `positions_px` (candidate, 2).

    profile : "psf" gives the photoelectrons of the whole spot (least squares: Σ w(p−b)/Σ w² with w the
        pixel-integrated PSF), "sum" the photoelectrons inside a disc of 2.5 σ, "brightest_pixel" those of the
        pixel the molecule lies in.
    neighbours_px : further molecules whose light the background ring avoids (None: the same ones).
    """
    height, width = shape_px
    n = len(positions_px)
    centre = np.rint(positions_px).astype(np.int64)
    reach, inner, outer = _sizes(sigma_px)

    window, offset, inside = _around(positions_px, centre, reach, shape_px)
    weights = _profile_weights(offset, inside, centre - positions_px, sigma_px, profile)

    ring, ring_offset, ring_inside = _around(positions_px, centre, outer, shape_px)
    distance = np.hypot(ring_offset[..., 0], ring_offset[..., 1])
    allowed = ring_inside & (distance >= inner) & (distance <= outer)
    lit = _near(positions_px if neighbours_px is None else neighbours_px, shape_px, 3.0 * sigma_px)
    undisturbed = allowed & ~lit.ravel()[ring]
    clean = undisturbed.copy()
    crowded = clean.sum(axis=1) < MIN_RING
    clean[crowded] = allowed[crowded]
    empty = ~clean.any(axis=1)
    clean[empty] = ring_inside[empty]
    ring_weights = clean / np.maximum(clean.sum(axis=1, keepdims=True), 1)  # none is left of a ring outside the field

    background = _operator(ring, ring_weights, clean, n, height * width)
    tells, doubt = _slope_rule(inner, outer)
    told = undisturbed & (undisturbed.sum(axis=1, keepdims=True) >= tells)
    tilts = _slope_weights(ring_offset, told, doubt)
    slope = sparse.vstack([_operator(ring, tilts[..., axis], told, n, height * width) for axis in range(2)])
    signal = _operator(window, weights, weights != 0, n, height * width)
    total = weights.sum(axis=1)
    if subtract_background:
        signal = (signal - sparse.diags(total) @ background).tocsr()
    return Aperture(
        signal.astype(np.float32), background.astype(np.float32), slope.tocsr().astype(np.float32), window, offset,
        inside, total,
    )  # fmt: skip


@dataclass(frozen=True)
class Reading:
    """What is read of one frame at places that no other frame has: trace, background (candidate,), the latter per
    pixel, slope (2, candidate); window, window_offset, inside, weight as of an `Aperture`."""

    trace: NDArray[np.float32]
    background: NDArray[np.float32]
    slope: NDArray[np.float32]
    window: NDArray[np.int64]
    window_offset: NDArray[np.float64]
    inside: NDArray[np.bool_]
    weight: NDArray[np.float64]

    def slopes(self, _: Stack) -> NDArray[np.float32]:
        """As of an `Aperture`, of the frame that was read."""
        return self.slope[:, :, None]


def read_frame(
    frame: NDArray[np.float32], positions_px: NDArray[np.float64], sigma_px: float, profile: Profile, *,
    subtract_background: bool = True,
) -> Reading:  # fmt: skip
    """What an `aperture` at these places gives of one frame (y, x), without the operators, which take longer to make
    than to use once."""
    from napari_mufasa.spots.kernels import ring_planes

    shape = (frame.shape[0], frame.shape[1])
    centre = np.rint(positions_px).astype(np.int64)
    reach, inner, outer = _sizes(sigma_px)
    window, offset, inside = _around(positions_px, centre, reach, shape)
    weights = _profile_weights(offset, inside, centre - positions_px, sigma_px, profile)
    lit = _near(positions_px, shape, 3.0 * sigma_px)
    planes = ring_planes(frame, positions_px, centre, lit, float(inner), outer, MIN_RING, *_slope_rule(inner, outer))
    background, slope = planes[0], planes[1:].astype(np.float32)
    trace = (weights * frame.ravel()[window]).sum(axis=1)
    total = weights.sum(axis=1)
    if subtract_background:
        trace = trace - total * background
    return Reading(trace.astype(np.float32), background.astype(np.float32), slope, window, offset, inside, total)


def background_slopes(
    images: NDArray[np.float32], frame: NDArray[np.int64], positions_px: NDArray[np.float64], sigma_px: float
) -> NDArray[np.float64]:
    """Slopes (spot, 2) along y and x of what lies around spots (spot, 2), in order of their frames, of images
    (frame, y, x): of the ring around each that is free of the other ones of its frame."""
    from napari_mufasa.spots.kernels import ring_planes

    _, inner, outer = _sizes(sigma_px)
    shape = (images.shape[1], images.shape[2])
    slopes = np.zeros((len(frame), 2))
    bounds = np.flatnonzero(np.diff(frame, prepend=-1, append=-1))
    for first, last in pairwise(bounds):
        places = positions_px[first:last]
        lit = _near(places, shape, 3.0 * sigma_px)
        centre = np.rint(places).astype(np.int64)
        planes = ring_planes(
            images[frame[first]], places, centre, lit, float(inner), outer, MIN_RING, *_slope_rule(inner, outer)
        )
        slopes[first:last] = planes[1:].T
    return slopes


def _sizes(sigma_px: float) -> tuple[int, float, int]:
    """Half the window's width, and the ring's inner and outer radius, px."""
    reach = int(np.ceil(WINDOW_SIGMA * sigma_px))
    inner = max(4.0 * sigma_px, reach + 1.0)
    return reach, inner, int(np.ceil(inner + max(3.0, 2.0 * sigma_px)))


def _slope_rule(inner: float, outer: int) -> tuple[float, float]:
    """How many pixels of a ring tell its slopes, and what is then added to their Σ y², px²: hardly anything of that of
    the whole ring, so that a slope is told where it can be, and 0 where not."""
    return TELLS * np.pi * (outer**2 - inner**2), DOUBT * np.pi / 4 * (outer**4 - inner**4)


def _slope_weights(offset: NDArray[np.float64], used: NDArray[np.bool_], doubt: float) -> NDArray[np.float64]:
    """Weights (candidate, ring pixel, 2) that give the slopes of the plane through the pixels used."""
    mean = (offset * used[..., None]).sum(axis=1) / np.maximum(used.sum(axis=1), 1)[:, None]
    away = (offset - mean[:, None]) * used[..., None]
    spread = away.transpose(0, 2, 1) @ away + doubt * np.eye(2)
    return np.asarray(away @ np.linalg.inv(spread))


def _profile_weights(
    offset: NDArray[np.float64], inside: NDArray[np.bool_], off_centre: NDArray[np.float64], sigma_px: float,
    profile: Profile,
) -> NDArray[np.float64]:  # fmt: skip
    """Weights (candidate, window pixel) of a profile."""
    if profile == "psf":
        shares = pixel_shares(offset[..., 0], offset[..., 1], sigma_px) * inside
        return np.asarray(shares / np.maximum((shares**2).sum(axis=1, keepdims=True), 1e-12))
    if profile == "sum":
        return np.asarray(((offset**2).sum(axis=-1) <= (DISC_SIGMA * sigma_px) ** 2) * inside * 1.0)
    return np.asarray((np.all(np.abs(offset - off_centre[:, None]) < 0.5, axis=-1) & inside) * 1.0)


def _around(
    positions_px: NDArray[np.float64], centre: NDArray[np.int64], reach: int, shape_px: tuple[int, int]
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.bool_]]:
    """Pixels of a square window around each position: flat index, offset from the position, inside the field."""
    dy, dx = (d.ravel() for d in np.mgrid[-reach : reach + 1, -reach : reach + 1])
    y, x = centre[:, :1] + dy, centre[:, 1:] + dx
    inside = (y >= 0) & (y < shape_px[0]) & (x >= 0) & (x < shape_px[1])
    offset = np.stack([y - positions_px[:, :1], x - positions_px[:, 1:]], axis=-1)
    flat = np.clip(y, 0, shape_px[0] - 1) * shape_px[1] + np.clip(x, 0, shape_px[1] - 1)
    return flat, offset, inside


def _near(positions_px: NDArray[np.float64], shape_px: tuple[int, int], radius_px: float) -> NDArray[np.bool_]:
    """(y, x) True within `radius_px` of any position."""
    mask = np.zeros(shape_px, dtype=bool)
    index, offset, inside = _around(
        positions_px, np.rint(positions_px).astype(np.int64), int(np.ceil(radius_px)), shape_px
    )
    close = inside & (np.hypot(offset[..., 0], offset[..., 1]) <= radius_px)
    mask.ravel()[index[close]] = True
    return mask


def _operator(
    index: NDArray[np.int64], weights: NDArray[np.float64], used: NDArray[np.bool_], n: int, n_pixels: int
) -> sparse.csr_matrix:
    rows = np.broadcast_to(np.arange(n)[:, None], index.shape)
    return sparse.csr_matrix((weights[used], (rows[used], index[used])), shape=(n, n_pixels))
