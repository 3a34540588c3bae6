"""Agreement of classes with a reference: measures, confidence, text."""

from .measures import Accuracy

__all__ = ["Accuracy"]
