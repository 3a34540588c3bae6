"""The classifiers a model file can hold; adding one is adding a module and a line here.

An algorithm is a class with

- ``name`` : str, the word in the manifest;
- ``rules`` : dict of array name to ``ArrayRule``; a name that ends in ``*`` stands for many arrays;
- ``from_arrays(arrays, parameters, n_features, n_classes)`` : made from a file, everything checked;
- ``arrays()`` and ``parameters()`` : what a file stores;
- ``predict_proba(values)`` : (n, features) float32 to (n, classes) float64, thread-safe and without the GIL.

One that looks at neighbors by itself (a network) says ``whole_cloud = True`` and has instead of the last

- ``plan_of(manifest)`` : what it needs of the points, in place of a plan of features;
- ``predict_cloud(xyz, dimensions, rows, threads, memory_mb, progress)`` : mean probabilities, their variance, a report.
"""

from __future__ import annotations

import importlib
from typing import Any

from ..base.errors import ModelError

#: Word in the manifest -> module and class.
ALGORITHMS = {
    "random_forest": ("pdal_stages.classifier.forest", "Forest"),
    "alsnet": ("pdal_stages.alsnet.algorithm", "AlsNet"),
}


def algorithm(name: str) -> Any:
    """The class of an algorithm by its name."""
    if name not in ALGORITHMS:
        raise ModelError(
            "the model uses an algorithm this release does not know",
            found=repr(name)[:60],
            cure="Update pdal-stages",
        )
    module, kind = ALGORITHMS[name]
    return getattr(importlib.import_module(module), kind)
