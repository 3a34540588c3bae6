"""Classifiers of points: the model file, the random forest, auto-context passes, and training."""

from .feature_kind import FeatureKind
from .interface import FOREST, KINDS


def _forest():
    from .random_forest import Forest

    return Forest


KINDS[FOREST] = FeatureKind(FOREST, _forest)
