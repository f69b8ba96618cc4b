"""PURE-LET for one image: unbiased risk estimate, linear expansion of thresholds, Haar (docs/denoising.md)."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any, Literal, get_args, overload

import numpy as np

from napari_mufasa.errors import MufasaError

from . import expansion, haar
from .fused import DEEPEST
from .noise import Noise, same_mean
from .risk import RiskSystem, choose_weights, improves

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    Array = NDArray[Any]

Method = Literal["patches", "undecimated", "cycle-spinning"]

#: Side of the windows (pixels) that carry the risk estimate, and how many of them one image needs at most.
WINDOW = 192
MAX_WINDOWS = 4
LEVELS = 5
#: Side of the part of an image on which the second pass is judged.
JUDGED = 256


@overload
def pure_let(
    image: ArrayLike,
    alpha: float = ...,
    sigma: ArrayLike = ...,
    offset: float = ...,
    *,
    method: Method = ...,
    levels: int = ...,
    multiplied: bool = ...,
    return_risk: Literal[False] = ...,
) -> NDArray[np.float32]: ...


@overload
def pure_let(
    image: ArrayLike,
    alpha: float = ...,
    sigma: ArrayLike = ...,
    offset: float = ...,
    *,
    method: Method = ...,
    levels: int = ...,
    multiplied: bool = ...,
    return_risk: Literal[True],
) -> tuple[NDArray[np.float32], float]: ...


def pure_let(
    image: ArrayLike,
    alpha: float = 1.0,
    sigma: ArrayLike = 0.0,
    offset: float = 0.0,
    *,
    method: Method = "patches",
    levels: int = LEVELS,
    multiplied: bool = False,
    return_risk: bool = False,
) -> NDArray[np.float32] | tuple[NDArray[np.float32], float]:
    """Estimate x from y = alpha * Poisson(x / alpha) + N(offset, sigma^2).

    Parameters
    ----------
    image : array (y, x) or (n,)
        The data y, any shape. A 1-D array is treated as a trace.
    alpha : float
        Variance per unit of signal; 1 for counts, 2 for EMCCD photoelectrons.
    sigma : float or array of the image's shape
        Standard deviation of the Gaussian noise, in the units of ``image``.
    offset : float
        Mean of the Gaussian noise; it is removed from the result.
    method : "patches", "undecimated" or "cycle-spinning"
        "undecimated" weighs all shifts of the Haar blocks in one risk estimate of the image; "patches" then filters
        like patches of that estimate together as far as the risk says that it helps: the best for one image, some eight
        times slower; "cycle-spinning" solves each shift of the decimated transform by itself and averages: simpler, a
        little worse.
    levels : int
        Deepest level, blocks of 2^levels pixels; small images use fewer.
    multiplied : bool
        The variance alpha * x comes from electron multiplication (Gamma of a Poisson number) rather than scaled counts.
    return_risk : bool
        Also return the estimated mean squared error per pixel.

    Returns
    -------
    float32 array of the image's shape, mean equal to the data's mean less ``offset``. Where the estimated risk is no
    better than the noise of the data, it is the data (less ``offset``). With ``return_risk`` also that risk.

    Raises
    ------
    MufasaError
        The image is empty, has the wrong number of dimensions or holds NaN; alpha or sigma is negative.
    """
    data, variance = checked(image, alpha, sigma, offset, dimensions=(1, 2))
    if method not in get_args(Method):
        raise MufasaError(f"method is {method!r}; use 'patches', 'undecimated' or 'cycle-spinning'")
    shape = data.shape
    plane = np.atleast_2d(data)
    variance = np.broadcast_to(np.atleast_2d(variance), plane.shape)
    flat = 1 in plane.shape
    if flat and plane.shape[1] == 1:
        plane, variance = plane.T, variance.T
    noise = Noise(float(alpha), np.ascontiguousarray(variance), multiplied)
    if method == "cycle-spinning":
        from .cyclespin import cycle_spin

        result, risk = cycle_spin(plane, noise, levels)
    elif method == "patches":
        result, risk = second_pass(plane, noise, levels, flat)
    else:
        result, risk = estimate(plane, noise, levels, flat)
    final = result.reshape(shape)
    return (final, risk) if return_risk else final


def estimate(plane: Array, noise: Noise, levels: int, flat: bool) -> tuple[NDArray[np.float32], float]:
    """Undecimated PURE-LET of one plane, with the estimated risk."""
    weights, risk = learned(plane, noise, levels, flat)
    return applied(plane, noise, levels, flat, weights), risk


def learned(plane: Array, noise: Noise, levels: int, flat: bool) -> tuple[Array | None, float]:
    """Weights of least estimated risk and that risk; no weights where the plane is best left as it is."""
    tiles = windows(plane.shape, flat)
    spread = np.unique(np.linspace(0, len(tiles) - 1, MAX_WINDOWS).round().astype(int))
    parts = risk_systems(plane, noise, levels, flat, [tiles[k] for k in spread])
    if not parts:
        return None, max(noise.mean(plane), 0.0)
    weights, risk, untouched = choose_weights(parts)
    return (weights, risk) if improves(risk, untouched) else (None, max(untouched, 0.0))


def applied(plane: Array, noise: Noise, levels: int, flat: bool, weights: Array | None) -> NDArray[np.float32]:
    """The plane denoised with given weights."""
    if weights is None:
        return plane
    depth = depth_for(plane.shape, levels, flat)
    return same_mean(expansion.apply(plane, noise, depth, flat, weights), plane)


def second_pass(plane: Array, noise: Noise, levels: int, flat: bool) -> tuple[NDArray[np.float32], float]:
    """`estimate`, then like patches of it filtered together as far as that lowers the estimated risk."""
    from . import patches

    first, risk = learned(plane, noise, levels, flat)
    pilot = applied(plane, noise, levels, flat, first)
    if first is None or not patches.big_enough(plane.shape):
        return pilot, risk
    middle, depth = central(plane.shape), depth_for(plane.shape, levels, flat)
    inside = noise.within(middle)
    part = np.ascontiguousarray(plane[middle])
    way, added, change = patches.judge(part, inside, lambda y: applied(y, inside, depth, flat, first))
    if way == 0.0:
        return pilot, risk
    whole = part.shape == plane.shape
    result = patches.moved(pilot, change, way) if whole else patches.towards(plane, pilot, noise, way)
    return result, max(risk + added, 0.0)


def central(shape: tuple[int, ...]) -> tuple[slice, ...]:
    """The middle of a plane, at most `JUDGED` pixels a side."""
    return tuple(slice((n - min(n, JUDGED)) // 2, (n - min(n, JUDGED)) // 2 + min(n, JUDGED)) for n in shape)


def depth_for(shape: tuple[int, ...], levels: int, flat: bool) -> int:
    """Levels used for a plane: those that fit its smallest window."""
    rows, cols = windows(shape, flat)[0]
    sizes = (cols.stop,) if flat else (rows.stop, cols.stop)
    return haar.levels_for(sizes, levels if flat else min(levels, DEEPEST))


def risk_systems(
    plane: Array, noise: Noise, levels: int, flat: bool, tiles: list[tuple[slice, slice]]
) -> list[RiskSystem]:
    """The risk system of each window of a plane; none where the plane is too small or free of noise."""
    depth = depth_for(plane.shape, levels, flat)
    if depth == 0 or (noise.alpha == 0 and not np.any(noise.variance)):
        return []
    cut = ((np.ascontiguousarray(plane[tile]), noise.within(tile)) for tile in tiles)
    return [expansion.expand(part, inside, depth, flat)[0] for part, inside in cut]


def windows(shape: tuple[int, ...], flat: bool) -> list[tuple[slice, slice]]:
    """Disjoint windows of two thirds to three halves of `WINDOW` per axis (or the axis) that tile the plane.

    The first is the smallest.
    """

    def cuts(n: int) -> list[slice]:
        parts = max(1, round(n / WINDOW))
        edges = np.linspace(0, n, parts + 1).astype(int)
        return [slice(int(a), int(b)) for a, b in pairwise(edges)]

    # A trace is never cut: its windows are groups of whole traces.
    columns = [slice(0, shape[1])] if flat else cuts(shape[1])
    return [(rows, cols) for rows in cuts(shape[0]) for cols in columns]


def checked(
    image: ArrayLike, alpha: float, sigma: ArrayLike, offset: float, dimensions: tuple[int, ...]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The data less ``offset`` and the Gaussian variance, float32, or a `MufasaError`."""
    data = np.asarray(image)
    if data.ndim not in dimensions:
        allowed = " or ".join(str(n) for n in dimensions)
        raise MufasaError(f"image has {data.ndim} dimensions {data.shape}; give an array of {allowed}")
    if data.size == 0:
        raise MufasaError(f"image of shape {data.shape} is empty; give at least one pixel")
    if not (np.issubdtype(data.dtype, np.number) or data.dtype == bool) or np.iscomplexobj(data):
        raise MufasaError(f"image has type {data.dtype}; give real numbers")
    if not np.isfinite(alpha) or alpha < 0:
        raise MufasaError(f"alpha is {alpha}; give a number >= 0 (1 for counts, 2 for EMCCD photoelectrons)")
    spread = np.asarray(sigma, dtype=np.float32)
    if not np.all(np.isfinite(spread)) or np.any(spread < 0):
        raise MufasaError(f"sigma holds {float(np.min(spread))}; every value must be finite and >= 0")
    try:
        np.broadcast_to(spread, data.shape)
    except ValueError:
        raise MufasaError(f"sigma has shape {spread.shape}, the image {data.shape}; give a number or a map") from None
    values = np.ascontiguousarray(data - offset if offset else data, dtype=np.float32)
    if not np.all(np.isfinite(values)):
        bad = int(np.count_nonzero(~np.isfinite(values)))
        raise MufasaError(f"image holds {bad} values that are not finite: crop or fill them first")
    return values, spread * spread
