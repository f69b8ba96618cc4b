"""Planning an experiment: what a model predicts before any movie is taken."""

from napari_mufasa.design.predict import Prediction, design, predict

__all__ = ["Prediction", "design", "predict"]
