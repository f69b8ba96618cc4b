"""PURE-LET over time: neighbouring frames as predictors of a frame, and the 1-D estimator for traces."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from . import let
from .purelet import LEVELS, checked, depth_for, estimate, same_mean, windows
from .still import past_and_future

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import ArrayLike, NDArray

    Array = NDArray[Any]

#: Windows that settle the weights of a movie; taken with a stride that visits all of a frame's windows.
ENOUGH_WINDOWS = 16
STRIDE = 7
#: Frames on either side that count at most.
NEIGHBOURS = 24
Guides = tuple[list["Array"], "NDArray[np.float32]"]
NO_GUIDES: Guides = ([], np.zeros(0, np.float32))


def guided(data: Array, first: int, stop: int, noise: let.Noise, neighbours: int) -> Iterator[tuple[int, Guides]]:
    """The guides of the frames first … stop - 1, and their variance relative to one frame's.

    One guide is the mean of the adjacent frames, the other the past and future as far as the scene stood still.
    """
    n = data.shape[0]
    if neighbours <= 0 or n < 2:
        for t in range(first, stop):
            yield t, NO_GUIDES
        return
    for t, still, relative in past_and_future(data, first, stop, noise, neighbours):
        beside = [data[k] for k in (t - 1, t + 1) if 0 <= k < n]
        mean = beside[0] if len(beside) == 1 else np.float32(0.5) * (beside[0] + beside[1])
        yield t, ([mean, still], np.array([1.0 / len(beside), relative], np.float32))


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
        Frames used on either side at most; 0 treats every frame alone.
    samples : int
        Number of frames, spread over the movie, whose pooled risk estimate sets the weights.

    Returns
    -------
    float32 (frame, y, x), each frame with the mean of its data.
    """
    data, variance = checked(movie, alpha, sigma, offset, dimensions=(3,))
    noise = let.Noise(float(alpha), np.broadcast_to(variance, data.shape[1:]), multiplied)
    weights = movie_weights(data, noise, neighbours, levels, samples)
    out = np.empty_like(data)
    for t, guides in guided(data, 0, data.shape[0], noise, neighbours):
        out[t] = apply_frame(data[t], noise, levels, weights, guides)
    return out


def movie_weights(
    data: Array, noise: let.Noise, neighbours: int, levels: int, samples: int
) -> NDArray[np.float64] | None:
    """Weights of least pooled risk over ``samples`` frames; None where the data cannot be improved."""
    parts: list[let.System] = []
    depth = depth_for(data.shape[1:], levels, False)
    chosen = sample_frames(data.shape[0], samples)
    for number, t in enumerate(chosen):
        first = max(0, t - neighbours)
        for tile in sample_windows(data.shape[1:], number, len(chosen)):
            part = np.ascontiguousarray(data[(slice(first, t + neighbours + 1), *tile)])
            parts += sample_system(part, t - first, noise.within(tile), neighbours, depth)
    return chosen_weights(parts)


def sample_system(data: Array, t: int, noise: let.Noise, neighbours: int, depth: int) -> list[let.System]:
    """The risk system of frame ``t`` of ``data``, a window that holds what its guides are made of, if it has one."""
    if depth == 0 or (noise.alpha == 0 and not np.any(noise.variance)):
        return []
    return [
        let.expand(data[t], noise, depth, False, guides, relative)[0]
        for _, (guides, relative) in guided(data, t, t + 1, noise, neighbours)
    ]


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
    frame: Array, noise: let.Noise, levels: int, weights: Array | None, guides: Guides = NO_GUIDES
) -> NDArray[np.float32]:
    """One frame with given weights."""
    if weights is None:
        return np.asarray(frame, np.float32)
    depth = depth_for(frame.shape, levels, False)
    return same_mean(let.apply(frame, noise, depth, False, *guides, weights), frame)


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
