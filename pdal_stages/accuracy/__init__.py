"""Agreement of classes with a reference: labels, measures, reliability, text."""

from .measures import Accuracy

__all__ = ["Accuracy"]
