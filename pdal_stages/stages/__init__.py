"""Pipeline stages: one module for each type."""

from ..classifier.interface import register_preprocessing


def _preprocessing():
    from . import preprocessing

    return preprocessing


register_preprocessing(_preprocessing)
