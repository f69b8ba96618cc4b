"""Planning an experiment: what a model predicts before any movie is taken."""

from napari_mufasa.design.predict import Prediction, design, numbers, predict

__all__ = ["Prediction", "design", "numbers", "predict"]
