"""Measuring the instrument: what a movie and its dark frames tell of the camera."""

from napari_mufasa.calibrate.measure import Calibration, Value, calibrate

__all__ = ["Calibration", "Value", "calibrate"]
