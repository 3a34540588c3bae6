"""Classifiers: training on labeled clouds, the model file, classifying clouds. NumPy in and out; no PDAL."""

from .algorithms import Prediction
from .clouds import TrainingCloud
from .featureforest import FeatureForest
from .forest import Forest
from .model import Model, load_model
from .training import train
from .trainoptions import TrainingOptions

__all__ = [
    "FeatureForest",
    "Forest",
    "Model",
    "Prediction",
    "TrainingCloud",
    "TrainingOptions",
    "load_model",
    "train",
]
