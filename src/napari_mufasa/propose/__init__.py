"""A first model from a movie, and whether a movie and a model can belong together."""

from napari_mufasa.propose.belongs import Mismatch, differences, mismatches
from napari_mufasa.propose.proposal import Proposal, propose_model
from napari_mufasa.propose.written import stated

__all__ = ["Mismatch", "Proposal", "differences", "mismatches", "propose_model", "stated"]
