"""PDAL pipeline stages that turn raw airborne laser scans into classified ones.

The public API. Names are imported when first used, so ``import pdal_stages`` is quick and
needs neither PDAL nor numba.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

__version__ = "0.1.0"

_WHERE = {
    "Accuracy": "accuracy",
    "Filter": "native",
    "Model": "classifier",
    "Pipeline": "pipeline",
    "StageError": "errors",
    "TrainingCloud": "classifier",
    "TrainingOptions": "classifier",
    "Writer": "native",
    "compute_features": "features",
    "hag_minima": "terrain",
    "load_model": "classifier",
    "make_town": "synthetic",
    "parse_neighborhoods": "neighborhoods",
    "run_pipeline": "pipeline",
    "run_tiled": "tiling",
    "train": "classifier",
    "write_accuracy_report": "report",
}

__all__ = [*_WHERE, "__version__"]

if TYPE_CHECKING:
    from .accuracy import Accuracy
    from .classifier import Model, TrainingCloud, TrainingOptions, load_model, train
    from .errors import StageError
    from .features import compute_features
    from .native import Filter, Writer
    from .neighborhoods import parse_neighborhoods
    from .pipeline import Pipeline, run_pipeline
    from .report import write_accuracy_report
    from .synthetic import make_town
    from .terrain import hag_minima
    from .tiling import run_tiled


def __getattr__(name: str):
    if name in _WHERE:
        value = getattr(importlib.import_module(f".{_WHERE[name]}", __name__), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'pdal_stages' has no attribute {name!r}")


def __dir__():
    return sorted(__all__)
