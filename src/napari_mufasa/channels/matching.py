"""Which spots of two channels are the same: votes for a first guess, RANSAC, then the nearest until nothing changes
(docs/two_channels.md)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from napari_mufasa.channels.transform import TERMS, Array, Kind, Transform, bends, fit
from napari_mufasa.errors import MufasaError

Pairs = NDArray[np.int64]
MOST_TURN_DEG, MOST_STRETCH = 6.0, 0.06  # of one channel against the other: splitters turn by a degree or two
MOST_SHIFT = 0.5  # of what the spots span
VOTE_PX = 3.0  # pairs of spots whose difference is this nearly the same vote for the same shift
MOST_VOTERS = 250  # spots of each channel, the clearest ones: the votes of more change nothing
BY_CHANCE = 1e-3  # of matching spots that have nothing to do with each other as well as those found
FALSE_BEND = 0.01  # of taking the second order where the map is affine
SAME_PX, LEAST_SAME_PX, STANDS_OFF = 1.0, 0.1, 4.0  # pairs in RANSAC; farther than so many sd is another spot
ROUNDS = 10


def match(donor_px: Array, acceptor_px: Array, kind: Kind | None = None) -> tuple[Pairs, Transform, Array]:
    """Pairs (pair, 2) of indices of the same spots, the transform between them, and how far off each pair is when it
    is left out (pair, 2).

    donor_px, acceptor_px : (spot, 2) each in its own channel, clearest first; either may hold spots of its own
    kind : None takes the second order where the pairs show it

    Raises `MufasaError` where fewer spots match than a transform needs, or no more than would by chance.
    """
    least = least_pairs(kind or "affine")
    if min(len(donor_px), len(acceptor_px)) < least:
        raise MufasaError(_too_few(0, donor_px, acceptor_px, least))
    first = _voted(donor_px[:MOST_VOTERS], acceptor_px[:MOST_VOTERS])
    pairs = _mutual(first(donor_px), acceptor_px, VOTE_PX)
    needed = max(least, _more_than_chance(donor_px, acceptor_px))
    if len(pairs) < needed:
        raise MufasaError(_too_few(len(pairs), donor_px, acceptor_px, needed))
    pairs = pairs[_consistent(donor_px[pairs[:, 0]], acceptor_px[pairs[:, 1]])]
    if len(pairs) < least:
        raise MufasaError(_too_few(len(pairs), donor_px, acceptor_px, least))
    return _settled(donor_px, acceptor_px, pairs, kind, least)


def least_pairs(kind: Kind) -> int:
    """Two for every term, so that each can be left out and the rest still tell how well they fit."""
    return 2 * TERMS[kind]


def _voted(donor_px: Array, acceptor_px: Array) -> Callable[[Array], Array]:
    """The turn, stretch and shift that most pairs of spots vote for."""
    centre = donor_px.mean(axis=0)
    around = donor_px - centre
    reach = _reach(donor_px, acceptor_px)
    best, linear = (-1, -np.inf), np.eye(2)
    for turn, stretch in _tried(donor_px):
        cos, sin = np.cos(turn), np.sin(turn)
        each = (1 + stretch) * np.array([[cos, -sin], [sin, cos]])
        rank = int(_votes(around @ each.T + centre, acceptor_px, reach).max()), -abs(turn) - abs(stretch)
        if rank > best:
            best, linear = rank, each
    turned = around @ linear.T + centre
    votes = _votes(turned, acceptor_px, reach)
    middle = (np.array(np.unravel_index(np.argmax(votes), votes.shape)) + 1) * VOTE_PX - reach
    difference = (acceptor_px[None] - turned[:, None]).reshape(-1, 2)
    shift = np.median(difference[np.all(np.abs(difference - middle) <= VOTE_PX, axis=1)], axis=0)
    return lambda places: np.asarray((places - centre) @ linear.T + centre + shift)


def _tried(donor_px: Array) -> list[tuple[float, float]]:
    """Turns (rad) and stretches, so near each other that the farthest spot is moved by no more than two votes."""
    step = 2 * VOTE_PX / max(float(np.hypot(*(donor_px - donor_px.mean(axis=0)).T).max()), 1.0)
    turns, stretches = (
        np.linspace(-most, most, 2 * int(np.ceil(most / step)) + 1)
        for most in (np.radians(MOST_TURN_DEG), MOST_STRETCH)
    )
    return [(float(turn), float(stretch)) for turn in turns for stretch in stretches]


def _reach(donor_px: Array, acceptor_px: Array) -> Array:
    """How far (y, x) the channels may be shifted: half of what the spots span."""
    span = np.maximum(np.ptp(donor_px, axis=0), np.ptp(acceptor_px, axis=0)) * MOST_SHIFT
    return np.asarray(np.maximum(np.ceil(span / VOTE_PX), 2) * VOTE_PX)


def _votes(turned_px: Array, acceptor_px: Array, reach: Array) -> NDArray[np.int64]:
    """How many differences of spots lie in each square of twice `VOTE_PX`, those squares a vote apart."""
    shape = (2 * reach / VOTE_PX).astype(np.int64)
    y, x = (
        ((acceptor_px[None, :, axis] - turned_px[:, None, axis] + reach[axis]) / VOTE_PX).ravel() for axis in range(2)
    )
    inside = (y >= 0) & (y < shape[0]) & (x >= 0) & (x < shape[1])
    cells = y[inside].astype(np.int64) * shape[1] + x[inside].astype(np.int64)
    counts = np.bincount(cells, minlength=int(shape.prod())).reshape(shape)
    return np.asarray(counts[:-1, :-1] + counts[1:, :-1] + counts[:-1, 1:] + counts[1:, 1:])


def _mutual(mapped_px: Array, acceptor_px: Array, within_px: float) -> Pairs:
    """Pairs that are each other's nearest, no farther apart than `within_px`."""
    distance, there = KDTree(acceptor_px).query(mapped_px)
    back = KDTree(mapped_px).query(acceptor_px)[1]
    own = np.arange(len(mapped_px))
    good = (back[there] == own) & (distance <= within_px)
    return np.stack([own[good], there[good]], axis=1).astype(np.int64)


def _more_than_chance(donor_px: Array, acceptor_px: Array) -> int:
    """How many spots must match that unrelated ones would not, in any of the shifts, turns and stretches tried."""
    from scipy.stats import binom

    extent = np.maximum(np.ptp(acceptor_px, axis=0), 1.0)
    chance = 1 - np.exp(-len(acceptor_px) / float(extent.prod()) * np.pi * VOTE_PX**2)
    trials = len(_tried(donor_px)) * float(np.prod(2 * _reach(donor_px, acceptor_px) / VOTE_PX))
    return int(binom.isf(min(BY_CHANCE / trials, 1.0), len(donor_px), chance)) + 1


def _consistent(donor_px: Array, acceptor_px: Array) -> NDArray[np.bool_]:
    """(pair,) those that one affine map brings together."""
    from skimage.measure import ransac
    from skimage.transform import AffineTransform

    _, inside = ransac(  # type: ignore[no-untyped-call]
        (donor_px, acceptor_px), AffineTransform, min_samples=3, residual_threshold=SAME_PX, max_trials=2000,
        stop_probability=1 - 1e-6, rng=0,
    )  # fmt: skip
    return np.zeros(len(donor_px), bool) if inside is None else np.asarray(inside, dtype=bool)


def _settled(
    donor_px: Array, acceptor_px: Array, pairs: Pairs, kind: Kind | None, least: int
) -> tuple[Pairs, Transform, Array]:
    """Fit, take what the fit brings together, and again, until the pairs stay the same."""
    for _ in range(ROUNDS):
        donors, acceptors = donor_px[pairs[:, 0]], acceptor_px[pairs[:, 1]]
        transform, left_out = fit(donors, acceptors, _kind(donors, acceptors, kind))
        typical = float(np.median(np.hypot(*left_out.T))) / 1.1774  # the median of a Rayleigh distance in its sd
        within = float(np.clip(STANDS_OFF * typical, LEAST_SAME_PX, VOTE_PX))
        again = _mutual(transform(donor_px), acceptor_px, within)
        if len(again) < least:
            raise MufasaError(_too_few(len(again), donor_px, acceptor_px, least))
        if np.array_equal(again, pairs):
            break
        pairs = again
    donors, acceptors = donor_px[pairs[:, 0]], acceptor_px[pairs[:, 1]]
    transform, left_out = fit(donors, acceptors, _kind(donors, acceptors, kind))
    return pairs, transform, left_out


def _kind(donor_px: Array, acceptor_px: Array, asked: Kind | None) -> Kind:
    if asked is not None:
        return asked
    enough = len(donor_px) >= least_pairs("polynomial")
    return "polynomial" if enough and bends(donor_px, acceptor_px, FALSE_BEND) else "affine"


def _too_few(matching: int, donor_px: Array, acceptor_px: Array, needed: int) -> str:
    return (
        f"{matching} of {len(donor_px)} spots of the donor's channel and {len(acceptor_px)} of the acceptor's match, "
        f"{needed} are needed: record more beads that both channels show, or check the two rectangles"
    )
