"""Where a model fails, which physical effect is missing, and how the error falls when it is added."""

from napari_mufasa.discover.automatic import diagnose, diagnose_traces, refine
from napari_mufasa.discover.confirmation import Confirmation, confirm, confirm_halves
from napari_mufasa.discover.detection import Power, power
from napari_mufasa.discover.investigation import Investigation
from napari_mufasa.discover.result import Candidate, Curve, Report

__all__ = [
    "Candidate", "Confirmation", "Curve", "Investigation", "Power", "Report", "confirm", "confirm_halves",
    "diagnose", "diagnose_traces", "power", "refine",
]  # fmt: skip
