"""Classifiers of points: the model file, the random forest, auto-context passes, and training."""

from .interface import FOREST, register_kind


def _forest():
    from .feature_forest import FeatureForest

    return FeatureForest


def _forest_trainer():
    from . import train_forest

    return train_forest


register_kind(FOREST, _forest, _forest_trainer)
