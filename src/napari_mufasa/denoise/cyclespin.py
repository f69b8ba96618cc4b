"""PURE-LET on the decimated Haar transform, averaged over shifts (cycle spinning)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from . import haar
from .expansion import Bands
from .noise import Noise, same_mean
from .risk import RiskSystem

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

#: Shifts averaged, spread over the 4 x 4 positions of a block of level 2.
SHIFTS = [(0, 0), (2, 2), (0, 2), (2, 0), (1, 1), (3, 3), (1, 3), (3, 1)]


def cycle_spin(plane: Array, noise: Noise, levels: int) -> tuple[NDArray[np.float32], float]:
    """Mean over `SHIFTS` of the decimated estimator; the risk is the mean of theirs, an upper bound of the mean's.

    Whole blocks are needed, so the image is continued by reflection; the continuation takes no part in the risk.
    """
    flat = plane.shape[0] == 1
    depth = haar.levels_for(plane.shape[1:] if flat else plane.shape, levels)
    mean_noise = noise.mean(plane)
    if depth == 0 or mean_noise <= 0:
        return plane, max(mean_noise, 0.0)
    total = np.zeros(plane.shape, np.float64)
    risks = []
    for dy, dx in SHIFTS:
        if flat and dy:
            continue
        block = 2**depth
        pad = [(0, 0) if flat else _margins(plane.shape[0], dy, block), _margins(plane.shape[1], dx, block)]
        wide = np.pad(plane, pad, mode="symmetric")
        variance = np.pad(np.broadcast_to(noise.variance, plane.shape), pad, mode="symmetric")
        estimate, saved = _decimated(wide, Noise(noise.alpha, variance, noise.multiplied), depth, flat)
        inside = tuple(slice(before, before + n) for (before, _), n in zip(pad, plane.shape, strict=True))
        total += estimate[inside]
        risks.append(mean_noise - saved)
    risk = float(np.mean(risks))
    if not risk < mean_noise:
        return plane, mean_noise
    return same_mean(total / len(risks), plane), risk


def _margins(n: int, shift: int, block: int) -> tuple[int, int]:
    return shift, (-(n + shift)) % block


def _decimated(wide: Array, noise: Noise, depth: int, flat: bool) -> tuple[Array, float]:
    """One shift: every level has its own least-squares weights; also the estimated risk saved per pixel."""
    signs_all = haar.SIGNS_1D if flat else haar.SIGNS_2D
    low = haar.LOW_1D if flat else haar.LOW_2D
    a, v = wide, np.ascontiguousarray(noise.variance)
    kept = []
    saved = 0.0
    for level in range(depth):
        children = np.stack([_child(a, k, flat) for k in range(2 if flat else 4)])
        spreads = np.stack([_child(v, k, flat) for k in range(2 if flat else 4)])
        s, block_variance = children.sum(axis=0), spreads.sum(axis=0)
        details = np.einsum("ok,krc->orc", signs_all[:, : len(children)], children)
        bands = Bands(s, details, block_variance, noise, 1, flat)
        planes = np.stack(list(bands.candidates()))
        flattened = planes.reshape(len(planes), -1)
        if flat:
            children, spreads = (np.concatenate([part, np.zeros_like(part)]) for part in (children, spreads))
        system = RiskSystem(
            gram=(flattened @ flattened.T).astype(np.float64),
            cross=np.asarray(bands.terms(children, spreads)),
            rest=0.0,
            noise=bands.n * (noise.alpha * float(s.sum(dtype=np.float64)) + float(block_variance.sum())),
            n_pixels=flattened.shape[1],
        )
        weights = system.solve()
        # The coefficients as they are (first weight 1) are the data themselves.
        same = np.zeros(len(planes))
        same[0] = 1.0
        gain = system.risk(same) - system.risk(weights) - system.optimism()
        if gain <= 0:
            weights, gain = same, 0.0
        # A detail's square counts once for each pixel of its block in the image, over the block's size squared.
        saved += gain * system.n_pixels * (0.5 if flat else 0.25) ** (level + 1) / wide.size
        kept.append(np.einsum("k,korc->orc", weights.astype(np.float32), planes))
        a, v = s, block_variance
    return _rebuild(a, kept, signs_all, low, flat), saved


def _rebuild(a: Array, kept: list[Array], signs_all: Array, low: Array, flat: bool) -> Array:
    for bands in reversed(kept):
        rows, cols = a.shape
        below = np.empty((rows if flat else 2 * rows, 2 * cols), a.dtype)
        for k in range(2 if flat else 4):
            value = low[k] * a
            for band, signs in zip(bands, signs_all, strict=True):
                value = value + signs[k] * band
            _child(below, k, flat)[...] = value * np.float32(0.5 if flat else 0.25)
        a = below
    return a


def _child(a: Array, k: int, flat: bool) -> Array:
    """View of the k-th child (top left, top right, bottom left, bottom right) of every block."""
    return a[:, k::2] if flat else a[k // 2 :: 2, k % 2 :: 2]
