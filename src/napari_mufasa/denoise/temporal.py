"""PURE-LET over time: neighbouring frames as predictors of a frame, and the 1-D estimator for traces."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from . import let
from .purelet import LEVELS, checked, depth_for, estimate, risk_systems, same_mean, windows

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike, NDArray

    Array = NDArray[Any]

#: Windows that settle the weights of a movie; taken with a stride that visits all of a frame's windows.
ENOUGH_WINDOWS = 16
STRIDE = 7
NEIGHBOURS = 5


def rings_for(neighbours: int) -> tuple[tuple[int, ...], ...]:
    """Distances in frames of each guide: the adjacent frames alone, the farther ones averaged."""
    if neighbours <= 0:
        return ()
    if neighbours == 1:
        return ((1,),)
    return ((1,), tuple(range(2, neighbours + 1)))


def guides_of(movie: Array, t: int, rings: Sequence[Sequence[int]]) -> tuple[list[Array], NDArray[np.float32]]:
    """Mean of the existing frames of every ring around frame ``t`` and the variance relative to one frame's.

    At the ends of a movie a ring reaches only one way; a ring with no frame at all repeats the nearest neighbours.
    """
    n = movie.shape[0]
    guides: list[Array] = []
    noise: list[float] = []
    for ring in rings:
        frames = [t + sign * k for k in ring for sign in (-1, 1) if 0 <= t + sign * k < n]
        if not frames:
            frames = [k for k in (t - 1, t + 1) if 0 <= k < n]
        mean = movie[frames[0]].astype(np.float32)
        for k in frames[1:]:
            mean += movie[k]
        guides.append(mean / np.float32(len(frames)))
        noise.append(1.0 / len(frames))
    return guides, np.asarray(noise, np.float32)


def pure_let_movie(
    movie: ArrayLike,
    alpha: float = 1.0,
    sigma: ArrayLike = 0.0,
    offset: float = 0.0,
    *,
    neighbours: int = NEIGHBOURS,
    levels: int = LEVELS,
    multiplied: bool = False,
    samples: int = 16,
) -> NDArray[np.float32]:
    """Denoise every frame with its neighbours in time as further predictors.

    The neighbours' noise is independent of the frame's, so they enter the risk estimate as known images: weights on
    them grow where the scene stands still, and stay small where the estimate says that they would smear.

    Parameters
    ----------
    movie : array (frame, y, x)
    alpha, sigma, offset, multiplied, levels
        As for `pure_let`; ``sigma`` may be a (y, x) map.
    neighbours : int
        Frames used on either side; 0 treats every frame alone.
    samples : int
        Number of frames, spread over the movie, whose pooled risk estimate sets the weights.

    Returns
    -------
    float32 (frame, y, x), each frame with the mean of its data.
    """
    data, variance = checked(movie, alpha, sigma, offset, dimensions=(3,))
    noise = let.Noise(float(alpha), np.broadcast_to(variance, data.shape[1:]), multiplied)
    rings = rings_for(neighbours if data.shape[0] > 1 else 0)
    weights = movie_weights(data, noise, rings, levels, samples)
    out = np.empty_like(data)
    for t in range(data.shape[0]):
        out[t] = apply_frame(data, t, noise, rings, levels, weights)
    return out


def movie_weights(
    data: Array, noise: let.Noise, rings: Sequence[Sequence[int]], levels: int, samples: int
) -> NDArray[np.float64] | None:
    """Weights of least pooled risk over ``samples`` frames; None where the data cannot be improved."""
    parts: list[let.System] = []
    chosen = sample_frames(data.shape[0], samples)
    for number, t in enumerate(chosen):
        guides, relative = guides_of(data, t, rings)
        tiles = sample_windows(data.shape[1:], number, len(chosen))
        parts += risk_systems(data[t], noise, levels, False, tiles, guides, relative)
    return chosen_weights(parts)


def sample_frames(n_frames: int, samples: int) -> list[int]:
    """Frames spread evenly over the movie."""
    return [int(t) for t in np.unique(np.linspace(0, n_frames - 1, min(samples, n_frames)).round())]


def sample_windows(shape: tuple[int, ...], number: int, n_samples: int) -> list[tuple[slice, slice]]:
    """Windows of the ``number``-th sample: other ones in every frame, `ENOUGH_WINDOWS` over all of them."""
    tiles = windows(shape, False)
    each = min(len(tiles), max(1, -(-ENOUGH_WINDOWS // n_samples)))
    return [tiles[(number * each + k) * STRIDE % len(tiles)] for k in range(each)]


def chosen_weights(parts: list[let.System]) -> NDArray[np.float64] | None:
    """Weights of least pooled risk; None where the data cannot be improved."""
    if not parts:
        return None
    weights, risk, untouched = let.learn(parts)
    return weights if risk < untouched else None


def apply_frame(
    data: Array, t: int, noise: let.Noise, rings: Sequence[Sequence[int]], levels: int, weights: Array | None
) -> NDArray[np.float32]:
    """One frame with given weights."""
    frame: NDArray[np.float32] = data[t]
    if weights is None:
        return frame
    guides, relative = guides_of(data, t, rings)
    depth = depth_for(frame.shape, levels, False)
    return same_mean(let.apply(frame, noise, depth, False, guides, relative, weights), frame)


def pure_let_traces(
    traces: ArrayLike,
    alpha: float = 1.0,
    sigma: ArrayLike = 0.0,
    offset: float = 0.0,
    *,
    levels: int = LEVELS,
    multiplied: bool = False,
) -> NDArray[np.float32]:
    """Denoise traces (molecule, frame) along time with one set of weights for all of them.

    Steps are kept: the Haar functions are steps themselves. Parameters as for `pure_let`.
    """
    data, variance = checked(traces, alpha, sigma, offset, dimensions=(2,))
    noise = let.Noise(float(alpha), np.broadcast_to(variance, data.shape), multiplied)
    result, _ = estimate(data, noise, levels, True)
    return result
