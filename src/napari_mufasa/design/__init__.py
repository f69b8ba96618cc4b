"""Planning an experiment: what a model predicts before any movie is taken."""

from napari_mufasa.design.predict import Prediction, design, numbers, predict
from napari_mufasa.design.solve import Solution, solve

__all__ = ["Prediction", "Solution", "design", "numbers", "predict", "solve"]
