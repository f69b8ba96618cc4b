"""Measuring the instrument: what a movie and its dark frames tell of the camera."""

from napari_mufasa.calibrate.measure import Calibration, calibrate
from napari_mufasa.calibrate.value import Value

__all__ = ["Calibration", "Value", "calibrate"]
