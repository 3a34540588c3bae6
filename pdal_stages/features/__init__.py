"""Multi-scale features of point clouds: plan what to compute, compute it block by block.

Importing this package is light; numba and the kernels are loaded when an engine is made.
"""

from .engine import FeatureEngine, compute_features, warmup
from .feature_table import FeatureTable
from .plan import FeaturePlan
from .shape_bins import ShapeBins

__all__ = [
    "FeatureEngine",
    "FeaturePlan",
    "FeatureTable",
    "ShapeBins",
    "compute_features",
    "warmup",
]
