"""Recipes of training: the options of a paper, or for a kind of scan, under one word.

Each option has the value that the paper gives and where it says so. ``not stated`` marks what the
paper leaves open and what this package takes instead; an option that is not listed has its default.
Options given beside a recipe replace its values.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ..base import checks

#: Where a paper leaves an option open.
NOT_STATED = "not stated"


@dataclass(frozen=True)
class Recipe:
    """Options of one paper's experiment, or for one kind of scan."""

    source: str  #: the paper, as docs/papers.md cites it, or the kind of scan
    #: option of ``writers.classifiermodel`` -> (value, section of the paper)
    options: Mapping[str, tuple[Any, str]]

    def values(self) -> dict[str, Any]:
        """Return each option's value."""
        return {name: value for name, (value, _) in self.options.items()}


#: One classifier for all points as they are: no auto-context passes, no voxels.
_ONE_PASS = {
    "passes": (1, "one classifier, no context"),
    "voxel": (0, "every point by itself"),
    "prior_weight": (0, "classes balanced, no priors"),
}
#: A Random Forest of Breiman's, as B16 and W18 use it.
_BREIMAN = {
    "sampling": ("random", "3.3 class re-balancing by random selection"),
    "scaling": ("percentiles", "3.3 [B16], 3.2 [W18]: 1st and 99th percentile"),
    "max_samples": (1, "3.4 bagging: bootstrap of all samples"),
    "vote": ("majority", "3.4 [B16], 3.3 [W18]: majority vote"),
    "min_samples_leaf": (1, NOT_STATED),
    "max_features": ("sqrt", NOT_STATED),
    **_ONE_PASS,
}
_WEINMANN = {
    "neighborhoods": (("weinmann2018",), "3.1 ten neighborhoods"),
    "feature_set": (("all",), "3.2 560 features"),
    "dimensions": (("HeightAboveGround",), "3.2 normalized height"),
    "count": (100_000, "4.3 (10,000 for the first figures)"),
    "trees": (100, NOT_STATED),
    **_BREIMAN,
}

#: By the word that users type.
RECIPES: dict[str, Recipe] = {
    "blomley2016": Recipe(
        "[B16]",
        {
            "neighborhoods": (("blomley2016",), "3.1 four cylinders and k_opt"),
            "feature_set": (("all",), "3.2 shape measures and shape distributions"),
            "dimensions": ((), "3.2.1 the height Z comes with the neighborhoods"),
            "count": (1_000, "4.2 N_E = 1000"),
            "trees_grid": ((50, 100, 200, 400), "4.2 grid search; its values are not stated"),
            **_BREIMAN,
        },
    ),
    "weinmann2018": Recipe("[W18]", _WEINMANN),
    "weinmann2018-binary": Recipe(
        "[W18]",
        {**_WEINMANN, "strategy": ("binary", "3.3, 4.3 one class against all others")},
    ),
    "he2017": Recipe(
        "[H17]",
        {
            "neighborhoods": (("he2017",), "2.1 curvature-adaptive neighborhood"),
            "feature_set": (
                (
                    "Verticality",
                    "HeightRange",
                    "Linearity",
                    "Planarity",
                    "Scattering",
                    "SurfaceVariation",
                ),
                "2.2 V, D_z and four of the eigenvalues",
            ),
            "dimensions": ((), "2.2 coordinates alone"),
            "count": (1_000, "3.1 1,000 examples per class"),
            "trees": (200, "2.3"),
            "max_depth": ("sqrt", "2.3 depth sqrt(d)"),
            "sampling": ("random", "2.3 random resampling, 3.1"),
            "max_samples": (1, NOT_STATED),
            "min_samples_leaf": (1, NOT_STATED),
            "max_features": ("sqrt", NOT_STATED),
            **_ONE_PASS,
        },
    ),
    "winiwarter2019": Recipe(
        "[WM19]",
        {
            "algorithm": ("alsnet", "3"),
            "dimensions": (
                ("Intensity", "ReturnNumber", "NumberOfReturns"),
                "4.1, 4.2 amplitude, echo number, number of echoes",
            ),
            "voxel": (0, "every point by itself"),
            "alsnet": (
                {
                    "configuration": "alsnet4",
                    "coordinates": "",
                    "learning_rate": 0.001,
                    "batches_per_step": 1,
                    "class_weights": "none",
                    "histogram_threshold": 20,
                    "augment": False,
                    "validation": 0,
                },
                "3, 4.1 (no batch is left out of Vaihingen, 4.2: histogram_threshold 100)",
            ),
        },
    ),
}

#: Recipes that no paper gives. Chosen on the validation cloud of Oakland 3-D, where the defaults
#: leave poles and wires out.
RECIPES["mobile"] = Recipe(
    "scans from vehicles",
    {
        "neighborhoods": (("s1", "s2", "k10", "k20", "k50", "kopt"), "objects are thin"),
        "voxel": (0.05, "ten times denser than airborne scans"),
        "prior_weight": (0, "poles and wires are rare"),
        "count": (10_000, "rare classes: more samples of the others drown them"),
        "context": (("own", "box1", "columnvotes2", "columnvotes8"), "its own votes first"),
        "trees": (150, "validation cloud"),
    },
)


def with_recipe(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return options with those of the recipe that they name filled in.

    OptionError for an unknown recipe.

    Options of the network are merged one by one.
    """
    name = options.get("recipe")
    if not name:
        return dict(options)
    checks.one_of("option 'recipe'", name, tuple(RECIPES))
    recipe = RECIPES[name]
    values = recipe.values() | dict(options)
    if isinstance(network := options.get("alsnet"), Mapping) and "alsnet" in recipe.options:
        values["alsnet"] = {**recipe.options["alsnet"][0], **network}
    return values


def describe_recipes() -> str:
    """Return what each recipe sets, and where its paper says so, as text."""
    lines = ["Recipes, and where the paper says so:"]
    for name, recipe in RECIPES.items():
        lines += ["", f"  {name} {recipe.source}"]
        for option, (value, where) in recipe.options.items():
            shown = value if isinstance(value, str) else json.dumps(value)
            lines.append(f"      {option}: {shown}   ({where})")
    return "\n".join(lines)
