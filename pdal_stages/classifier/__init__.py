"""Classifiers: training on labelled clouds, the model file, classifying clouds. NumPy in and out; no PDAL."""

from .clouds import TrainingCloud
from .forest import Forest
from .model import Model, Prediction, load_model
from .training import train
from .trainoptions import TrainingOptions

__all__ = ["Forest", "Model", "Prediction", "TrainingCloud", "TrainingOptions", "load_model", "train"]
