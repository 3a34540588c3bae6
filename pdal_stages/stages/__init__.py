"""Pipeline stages: one module for each type."""

from ..classifier.registry import register_preprocessing


def _preprocessing():
    from . import preprocessing

    return preprocessing


register_preprocessing(_preprocessing)
