"""Sample → emission → optical image → movie: one story, from a model to digital counts."""

from napari_mufasa.simulate.movie import SimulatedAcquisition, Simulation, simulate, simulate_dark, simulate_emission
from napari_mufasa.simulate.scene import Scene

__all__ = ["Scene", "SimulatedAcquisition", "Simulation", "simulate", "simulate_dark", "simulate_emission"]
