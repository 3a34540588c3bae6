"""alsNet: PointNet++ for airborne laser scans [WM19], a kind of classifier of model files."""

from ..classifier.interface import register_kind


def _network():
    from .classifier import AlsNet

    return AlsNet


def _network_trainer():
    from . import training

    return training


register_kind("alsnet", _network, _network_trainer)
