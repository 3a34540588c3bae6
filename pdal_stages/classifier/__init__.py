"""Classifiers: training on labeled clouds, the model file, classifying clouds. NumPy in and out; no PDAL."""

import importlib

#: Public names and their modules, imported when first used: a run that classifies needs nothing of training.
_WHERE = {
    "FeatureForest": "featureforest",
    "Forest": "forest",
    "Model": "model",
    "Prediction": "algorithms",
    "TrainingCloud": "clouds",
    "TrainingOptions": "trainoptions",
    "load_model": "model",
    "train": "training",
}


def __getattr__(name: str):
    if name in _WHERE:
        return getattr(importlib.import_module(f".{_WHERE[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
