"""alsNet [WM19]: PointNet++ for airborne scans, in circular batches. Applying it needs NumPy; training, PyTorch."""

from ..classifier.algorithms import register
from .algorithm import AlsNet, InputPlan
from .circles import Circles
from .configuration import CONFIGURATIONS, Configuration, Level, parse_configuration
from .networkoptions import NetworkOptions

__all__ = [
    "CONFIGURATIONS",
    "AlsNet",
    "Circles",
    "Configuration",
    "InputPlan",
    "Level",
    "NetworkOptions",
    "parse_configuration",
]

register("alsnet", "pdal_stages.alsnet.algorithm:AlsNet", "pdal_stages.alsnet.networkmodel:NetworkTrainer")
