"""Measuring the instrument: what a movie and its dark frames tell of the camera."""

from napari_mufasa.calibrate.found import Calibration
from napari_mufasa.calibrate.measure import calibrate
from napari_mufasa.calibrate.value import Value

__all__ = ["Calibration", "Value", "calibrate"]
