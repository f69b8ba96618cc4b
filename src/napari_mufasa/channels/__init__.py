"""Two channels on one camera: choose one, register the other, read donor and acceptor side by side
(docs/two_channels.md)."""

from napari_mufasa.channels.pair import PairedTraces, extract_pair
from napari_mufasa.channels.rectangle import Rectangle, rectangle
from napari_mufasa.channels.registration import Channels, register
from napari_mufasa.channels.simulated import SimulatedPair, simulate_pair

__all__ = [
    "Channels", "PairedTraces", "Rectangle", "SimulatedPair", "extract_pair", "rectangle", "register", "simulate_pair",
]  # fmt: skip
