"""alsNet: PointNet++ for airborne laser scans [WM19], a kind of classifier of model files."""

from ..classifier.interface import KINDS


class _NetworkKind:
    """See :class:`..classifier.interface.EstimatorKind`."""

    @property
    def rules(self):
        from .classifier import AlsNet

        return AlsNet.rules

    @property
    def trainer(self):
        from . import training

        return training

    def from_file(self, entry, arrays, codes):
        from .classifier import AlsNet

        return AlsNet.from_file(entry, arrays, codes)


KINDS["alsnet"] = _NetworkKind()
