"""Recipes of training: the options of a paper, or for a kind of scan, under one word.

Beside each value stands the section of the paper that gives it; ``not stated`` marks what the paper
leaves open and what this package takes instead. An option that is not listed has its default.
Options given beside a recipe replace its values.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from ..base import checks

#: One classifier for all points as they are: no auto-context passes, no voxels; classes balanced.
_ONE_PASS = {"passes": 1, "voxel": 0, "prior_weight": 0}
#: A Random Forest of Breiman's, as B16 and W18 use it.
_BREIMAN = {
    "sampling": "random",  # 3.3 class re-balancing by random selection
    "scaling": "percentiles",  # 3.3 [B16], 3.2 [W18]: 1st and 99th percentile
    "max_samples": 1,  # 3.4 bagging: bootstrap of all samples
    "vote": "majority",  # 3.4 [B16], 3.3 [W18]: majority vote
    "min_samples_leaf": 1,  # not stated
    "max_features": "sqrt",  # not stated
    **_ONE_PASS,
}

#: Options of ``writers.classifiermodel``, by the word that users type.
RECIPES: dict[str, dict[str, Any]] = {
    "blomley2016": {
        "neighborhoods": ("blomley2016",),  # 3.1 four cylinders and k_opt
        "feature_set": ("all",),  # 3.2 shape measures and shape distributions
        "dimensions": (),  # 3.2.1 the height Z comes with the neighborhoods
        "count": 1_000,  # 4.2 N_E = 1000
        "trees_grid": (50, 100, 200, 400),  # 4.2 grid search; its values are not stated
        **_BREIMAN,
    },
    # With `target` one class against all others [W18 3.3, 4.3].
    "weinmann2018": {
        "neighborhoods": ("weinmann2018",),  # 3.1 ten neighborhoods
        "feature_set": ("all",),  # 3.2 560 features
        "dimensions": ("HeightAboveGround",),  # 3.2 normalized height
        "count": 100_000,  # 4.3 (10,000 for the first figures)
        "trees": 100,  # not stated
        **_BREIMAN,
    },
    "he2017": {
        "neighborhoods": ("he2017",),  # 2.1 curvature-adaptive neighborhood
        "feature_set": ("he2017",),  # 2.2 V, D_z and four of the eigenvalues
        "dimensions": (),  # 2.2 coordinates alone
        "count": 1_000,  # 3.1 1,000 examples per class
        "trees": 200,  # 2.3
        "max_depth": "sqrt",  # 2.3 depth sqrt(d)
        "sampling": "random",  # 2.3 random resampling, 3.1
        "max_samples": 1,  # not stated
        "min_samples_leaf": 1,  # not stated
        "max_features": "sqrt",  # not stated
        **_ONE_PASS,
    },
    "winiwarter2019": {
        "algorithm": "alsnet",  # 3
        # 4.1, 4.2 amplitude, echo number, number of echoes
        "dimensions": ("Intensity", "ReturnNumber", "NumberOfReturns"),
        "voxel": 0,  # every point by itself
        "alsnet": {  # 3, 4.1 (no batch is left out of Vaihingen, 4.2: histogram_threshold 100)
            "configuration": "alsnet4",
            "coordinates": "",
            "learning_rate": 0.001,
            "batches_per_step": 1,
            "class_weights": "none",
            "histogram_threshold": 20,
            "augment": False,
            "validation": 0,
        },
    },
    # Scans from vehicles. No paper gives it: chosen on the validation cloud of Oakland 3-D, where
    # the defaults leave poles and wires out.
    "mobile": {
        "neighborhoods": ("s1", "s2", "k10", "k20", "k50", "kopt"),  # objects are thin
        "voxel": 0.05,  # ten times denser than airborne scans
        "prior_weight": 0,  # poles and wires are rare
        "count": 10_000,  # rare classes: more samples of the others drown them
        "context": ("own", "box1", "columnvotes2", "columnvotes8"),  # its own votes first
        "trees": 150,
    },
}


def with_recipe(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return options with those of the recipe that they name filled in.

    Options of the network are merged one by one. OptionError for an unknown recipe.
    """
    if not (name := options.get("recipe")):
        return dict(options)
    checks.one_of("option 'recipe'", name, tuple(RECIPES))
    values = {**RECIPES[name], **options}
    if isinstance(network := options.get("alsnet"), Mapping):
        values["alsnet"] = {**RECIPES[name].get("alsnet", {}), **network}
    return values


def describe_recipes() -> str:
    """Return what each recipe sets, as text."""
    lines = ["Recipes:"]
    for name, values in RECIPES.items():
        lines += ["", f"  {name}", *(f"      {k}: {json.dumps(v)}" for k, v in values.items())]
    return "\n".join(lines)
