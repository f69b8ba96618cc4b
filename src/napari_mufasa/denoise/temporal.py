"""PURE-LET over time: neighbouring frames as predictors of a frame, and the 1-D estimator for traces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from zlib import crc32

import numpy as np

from . import expansion
from .expansion import NO_GUIDES, Guides
from .noise import Noise, same_mean
from .purelet import LEVELS, checked, depth_for, estimate, windows
from .risk import RiskSystem, choose_weights, improves, is_impossible
from .still import past_and_future, shown

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from numpy.typing import ArrayLike, NDArray

    from .reel import Reel
    from .still import Side

    Array = NDArray[Any]

#: Windows that settle the weights of a movie; taken with a stride that visits all of a frame's windows.
ENOUGH_WINDOWS = 16
STRIDE = 7
#: Frames on either side that count at most.
NEIGHBOURS = 24
#: Disturbance of a frame that measures what the choice between past and future costs, in noise standard deviations.
PROBE = 0.3


@dataclass(frozen=True)
class Sight:
    """One frame, or a window of it, and what the frames around it show."""

    frame: Array
    noise: Noise
    beside: list[Array]
    past: Side | None = None
    future: Side | None = None

    def guides(self, trust: float | None, frame: Array | None = None) -> Guides:
        """The mean of the adjacent frames, and past and future as far as the scene stood still.

        ``trust`` 1: next to a change the frame (or the one given) says which of the two counts; None: no guides.
        """
        if trust is None or (self.past is None and self.future is None):
            return NO_GUIDES
        seen = self.frame if frame is None else frame
        still, relative = shown(seen, self.past, self.future, self.noise, trust)
        mean = self.beside[0] if len(self.beside) == 1 else np.float32(0.5) * (self.beside[0] + self.beside[1])
        return Guides([mean, still], np.array([1.0 / len(self.beside), relative], np.float32))

    def system(self, depth: int, trust: float | None) -> RiskSystem:
        """Its risk system."""
        return expansion.expand(self.frame, self.noise, depth, False, self.guides(trust))[0]

    def cost_of_trust(self, weights: Array, depth: int) -> float:
        """Estimated risk per pixel with the frame's own choice between past and future, less that without it.

        The choice makes a guide depend on the frame, which the risk system leaves out. To first order
        E[x F] = E[y F - (alpha y + variance) dF/dy]; disturbing the frame along random signs sums the derivatives.
        """
        y, noise = self.frame, self.noise
        spread = np.sqrt(max(float(np.mean(noise.alpha * y + noise.variance)), 1e-30))
        rng = np.random.default_rng(crc32(np.ascontiguousarray(y).tobytes()))
        signs = rng.choice(np.array([-PROBE, PROBE], np.float32), y.shape) * np.float32(spread)

        def both(frame: Array) -> tuple[Array, Array]:
            trusting, not_trusting = (
                expansion.apply(frame, noise, depth, False, weights, self.guides(trust, frame)).astype(np.float64)
                for trust in (1.0, 0.0)
            )
            return trusting, not_trusting

        (more_1, more_0), (less_1, less_0), (here_1, here_0) = both(y + signs), both(y - signs), both(y)
        slope = ((more_1 - more_0) - (less_1 - less_0)) / (2.0 * signs)
        gained = y * (here_1 - here_0) - (noise.alpha * y + noise.variance) * slope
        return float(np.mean(here_1**2 - here_0**2 - 2.0 * gained))


def sights(
    data: Array | Reel, first: int, stop: int, noise: Noise, neighbours: int, piece: int | None = None
) -> Iterator[tuple[int, Sight]]:
    """The frames first … stop - 1 of ``data``, which should hold ``neighbours`` more on either side; ``piece`` as for
    `past_and_future`."""
    n = data.shape[0]
    if neighbours <= 0 or n < 2:
        for t in range(first, stop):
            yield t, Sight(data[t], noise, [])
        return
    for t, past, future in past_and_future(data, first, stop, noise, neighbours, piece):
        beside = [data[k] for k in (t - 1, t + 1) if 0 <= k < n]
        yield t, Sight(data[t], noise, beside, past, future)


@dataclass(frozen=True)
class Learnt:
    """A movie's weights, none where it cannot be improved; estimated risk with them and without.

    ``trust`` says whether frames choose between their past and future; None: neither is looked at.
    """

    weights: Array | None
    trust: float | None
    risk: float
    untouched: float

    @property
    def is_impossible(self) -> bool:
        """Can the risk not be what it is estimated at, so that the noise is not what it was taken for?"""
        return is_impossible(self.risk, self.untouched)


def learn(seen: list[Sight], depth: int, each: Callable[..., Iterable[Any]] = map) -> Learnt:
    """Weights of least risk pooled over windows, and what frames make of their past and future.

    They choose between the two unless that is estimated to cost: where everything moves, each would choose its own
    noise. Where past and future tell hardly anything of the frame, and so only add to what weights can be fitted to by
    chance, they are left out. ``each`` maps a function over the windows.
    """
    seen = [one for one in seen if one.noise.alpha > 0 or np.any(one.noise.variance)]
    if depth == 0 or not seen:
        return Learnt(None, 1.0, 0.0, 0.0)

    def weighed(trust: float | None) -> Learnt:
        weights, risk, untouched = choose_weights(list(each(lambda one: one.system(depth, trust), seen)))
        return Learnt(weights if improves(risk, untouched) else None, trust, risk, untouched)

    if all(one.past is None and one.future is None for one in seen):
        return weighed(None)
    best = weighed(1.0)
    if best.weights is not None and any(one.past is not None and one.future is not None for one in seen):
        costs = np.array(list(each(lambda one: one.cost_of_trust(best.weights, depth), seen)))
        # In doubt, two standard errors, they do choose.
        if costs.mean() > 2.0 * costs.std() / np.sqrt(max(len(costs) - 1, 1)):
            best = weighed(0.0)
    alone = weighed(None)
    return alone if alone.risk < best.risk else best


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
    noise = Noise(float(alpha), np.broadcast_to(variance, data.shape[1:]), multiplied)
    seen: list[Sight] = []
    chosen = sample_frames(data.shape[0], samples)
    for number, t in enumerate(chosen):
        first = max(0, t - neighbours)
        for tile in sample_windows(data.shape[1:], number, len(chosen)):
            part = np.ascontiguousarray(data[(slice(first, t + neighbours + 1), *tile)])
            seen += [one for _, one in sights(part, t - first, t - first + 1, noise.within(tile), neighbours)]
    learnt = learn(seen, depth_for(data.shape[1:], levels, False))
    out = np.empty_like(data)
    for t, sight in sights(data, 0, data.shape[0], noise, neighbours):
        out[t] = apply_frame(sight, levels, learnt)
    return out


def sample_frames(n_frames: int, samples: int) -> list[int]:
    """Frames spread evenly over the movie."""
    return [int(t) for t in np.unique(np.linspace(0, n_frames - 1, min(samples, n_frames)).round())]


def sample_windows(shape: tuple[int, ...], number: int, n_samples: int) -> list[tuple[slice, slice]]:
    """Windows of the ``number``-th sample: other ones in every frame, `ENOUGH_WINDOWS` over all of them."""
    tiles = windows(shape, False)
    each = min(len(tiles), max(1, -(-ENOUGH_WINDOWS // n_samples)))
    return [tiles[(number * each + k) * STRIDE % len(tiles)] for k in range(each)]


def apply_frame(sight: Sight, levels: int, learnt: Learnt) -> NDArray[np.float32]:
    """One frame with the movie's weights."""
    frame = sight.frame
    if learnt.weights is None:
        return np.asarray(frame, np.float32)
    depth = depth_for(frame.shape, levels, False)
    guides = sight.guides(learnt.trust)
    return same_mean(expansion.apply(frame, sight.noise, depth, False, learnt.weights, guides), frame)


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
    noise = Noise(float(alpha), np.broadcast_to(variance, data.shape), multiplied)
    result, _ = estimate(data, noise, levels, True)
    return result
