"""alsNet [WM19]: PointNet++ for airborne scans, in circular batches. Applying it needs NumPy; training, PyTorch."""

from .algorithm import AlsNet
from .circles import Circles
from .configuration import CONFIGURATIONS, Configuration, Level, NetworkOptions, parse_configuration

__all__ = [
    "CONFIGURATIONS",
    "AlsNet",
    "Circles",
    "Configuration",
    "Level",
    "NetworkOptions",
    "parse_configuration",
]
