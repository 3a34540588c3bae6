"""Classifiers: training on labelled clouds, the model file, classifying clouds. NumPy in and out; no PDAL."""

from .algorithms import register
from .clouds import TrainingCloud
from .deciding import Prediction
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

register(
    "random_forest",
    "pdal_stages.classifier.featureforest:FeatureForest",
    "pdal_stages.classifier.foresttraining:ForestTrainer",
)
