"""PDAL pipeline stages that turn raw airborne laser scans into classified ones.

The public API. Names are imported when first used, so ``import pdal_stages`` is quick and
needs neither PDAL nor numba.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from . import alsnet, stages
from .base.version import __version__

_WHERE = {
    "Accuracy": "accuracy",
    "Cells": "objects.cells",
    "ComparedClasses": "accuracy.labels",
    "Filter": "pipeline.python_pdal",
    "Model": "classifier.model",
    "ObjectSettings": "objects.results",
    "FeatureTable": "features",
    "Pipeline": "pipeline.run",
    "Place": "reports.accuracy_page",
    "StageError": "base.errors",
    "SurfaceOptions": "surfaces",
    "TrainingCloud": "classifier.training_clouds",
    "TrainingOptions": "classifier.training_options",
    "Writer": "pipeline.python_pdal",
    "compute_features": "features",
    "detached_noise": "terrain",
    "find_objects": "objects.detect",
    "filtered_ground": "terrain",
    "hag_minima": "terrain",
    "load_model": "classifier.model",
    "make_town": "synthetic",
    "object_layers": "reports.object_layers",
    "parse_neighborhoods": "features.neighborhoods",
    "run_pipeline": "pipeline.run",
    "run_stage": "pipeline.runtime",
    "run_tiled": "tiling.tiled_run",
    "TilingOptions": "tiling.options",
    "train": "classifier.training",
    "write_accuracy_report": "reports.accuracy_page",
    "write_report": "surfaces",
    "write_surfaces": "surfaces",
}

__all__ = [*_WHERE, "__version__"]

if TYPE_CHECKING:
    from .accuracy.labels import ComparedClasses
    from .accuracy.measures import Accuracy
    from .base.errors import StageError
    from .classifier.model import Model, load_model
    from .classifier.training import train
    from .classifier.training_clouds import TrainingCloud
    from .classifier.training_options import TrainingOptions
    from .features import FeatureTable, compute_features
    from .features.neighborhoods import parse_neighborhoods
    from .objects.cells import Cells
    from .objects.detect import find_objects
    from .objects.results import ObjectSettings
    from .pipeline.python_pdal import Filter, Writer
    from .pipeline.run import Pipeline, run_pipeline
    from .reports.accuracy_page import Place, write_accuracy_report
    from .reports.object_layers import object_layers
    from .surfaces import SurfaceOptions, write_report, write_surfaces
    from .synthetic import make_town
    from .terrain import detached_noise, filtered_ground, hag_minima
    from .tiling.options import TilingOptions
    from .tiling.tiled_run import run_tiled


def __getattr__(name: str):
    if name in _WHERE:
        value = getattr(importlib.import_module(f".{_WHERE[name]}", __name__), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'pdal_stages' has no attribute {name!r}")


def __dir__():
    return sorted(__all__)
