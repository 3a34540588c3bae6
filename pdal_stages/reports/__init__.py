"""Pages and pictures for people: the accuracy page, the page about a model, maps of a cloud."""

from .accuracypage import write_accuracy_report
from .modelpage import write_model_report

__all__ = ["write_accuracy_report", "write_model_report"]
