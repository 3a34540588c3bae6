"""Multi-scale features of point clouds: plan what to compute, compute it block by block.

Importing this package is light: numba is imported when a kernel is first called.
"""

from .engine import FeatureEngine, FeatureTable, compute_features, warmup
from .plan import FeaturePlan
from .shape_distributions import ShapeBins

__all__ = [
    "FeatureEngine",
    "FeaturePlan",
    "FeatureTable",
    "ShapeBins",
    "compute_features",
    "warmup",
]
