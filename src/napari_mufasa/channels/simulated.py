"""A movie of two channels side by side whose efficiency of transfer and whose map are known: `simulate_pair`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from napari_mufasa import checks
from napari_mufasa.chance.streams import Streams
from napari_mufasa.errors import MufasaError
from napari_mufasa.simulate.movie import SimulatedAcquisition

if TYPE_CHECKING:
    from napari_mufasa.model.model import Model

Map = Callable[[NDArray[np.float64]], NDArray[np.float64]]


@dataclass(frozen=True)
class SimulatedPair:
    """movie : (frame, y, x) uint16 ADU, the donor's channel in the left half, the acceptor's in the right one
    positions_px : (molecule, 2) in the donor's channel; efficiency : (molecule, frame) of transfer
    donor, acceptor : (molecule, frame) photons emitted into each channel"""

    movie: NDArray[np.uint16]
    positions_px: NDArray[np.float64]
    efficiency: NDArray[np.float64]
    donor: NDArray[np.int64]
    acceptor: NDArray[np.int64]


def simulate_pair(
    model: Model,
    efficiency: float | NDArray[np.floating] = 0.5,
    place_in_acceptor: Map | None = None,
    positions_px: NDArray[np.floating] | None = None,
    *,
    leakage: float = 0.0,
    seed: int = 0,
) -> SimulatedPair:
    """Simulate an image splitter: each photon of a molecule goes to the acceptor's channel with chance E.

    Parameters
    ----------
    model : of one channel; its shape is that of a half of the frame
    efficiency : E, one number, or of each molecule (molecule, 1), or (molecule, frame)
    place_in_acceptor : from places (molecule, 2) in the donor's channel to places in the acceptor's; None: the same
    positions_px : (molecule, 2) in the donor's channel; None: the model's sample layout
    leakage : light of the donor that is seen in the acceptor's channel, as a share of what its own channel sees
    seed : the same seed gives the same movie

    Raises `MufasaError` for efficiencies outside of 0 … 1 or of another shape, and as `simulate` does.
    """
    checks.number(leakage, "leakage", 0, 1)
    left = SimulatedAcquisition(model, positions_px, seed)
    positions, emission = left.scene.positions_px, left.emission
    if len(emission) != len(positions):
        raise MufasaError("the model has effects that add molecules: drop them for a movie of two channels")
    try:
        shares = np.broadcast_to(np.asarray(efficiency, dtype=float), emission.shape)
    except (TypeError, ValueError):
        raise MufasaError(f"efficiency fits not {emission.shape}: give a number or (molecule, frame)") from None
    if not ((shares >= 0) & (shares <= 1)).all():
        raise MufasaError("efficiency must be from 0 to 1")
    rng = Streams(seed).of("two channels")
    acceptor = rng.binomial(emission, shares)
    donor = emission - acceptor
    seen = acceptor + rng.binomial(donor, leakage) if leakage else acceptor
    there = positions if place_in_acceptor is None else place_in_acceptor(positions)
    right = SimulatedAcquisition(model, there, seed + 2**31)  # pixels of its own, but the same sample
    right.scene.show_sample_of(left.scene)
    left.record_instead(donor)
    right.record_instead(seen)
    halves = [np.concatenate([block.movie for _, block in half.blocks()]) for half in (left, right)]
    return SimulatedPair(np.concatenate(halves, axis=2), positions, np.array(shares), donor, acceptor)
