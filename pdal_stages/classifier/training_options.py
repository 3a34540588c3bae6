"""Options of training, checked once, before any work is done; and recipes, which set several."""

from __future__ import annotations

# ruff: noqa: RUF009  options are declared, nothing is shared
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ..base import checks
from ..base.asprs import BUILDING, NOISE
from ..base.errors import OptionError
from ..base.json_types import JsonObject
from ..base.options import Check, Settings, setting
from ..base.threads import resolve_threads
from ..features import FeaturePlan
from ..features.voxels import LARGEST, check_side
from .class_map import MAX_LABEL
from .context_features import OWN, Context
from .interface import FOREST, Estimator, PointEstimator, kinds, trainer_of

#: Most passes that training makes: a third one gained nothing (docs/trials.md).
MOST_PASSES = 3
#: Without `max_samples` a tree draws a third of the samples of a class, on average at least so many
#: (not tuned)
LEAST_PER_TREE = 1_000
#: and at most so many: as in the trials of 40,000 samples of a class (docs/trials.md).
PER_TREE = 10_000
#: Passes by default.
DEFAULT_PASSES = 2
#: Context of passes after the first by default: the five sizes of docs/trials.md.
DEFAULT_CONTEXT = ("box1", "box4", "columnvotes1", "columnvotes4", "columnvotes8")
#: Context of the pass on top of a base by default (not tuned).
CONTEXT_OF_BASE = ("own", "box1", "columnvotes2", "columnvotes8")


def _each(check: Callable[..., float], *limits: float, **more: bool) -> Check:
    """Return a check of a number, or of each number in a list."""

    def check_all(what: str, value: object) -> tuple[float, ...]:
        numbers = value if isinstance(value, Iterable) else [value]
        return tuple(check(what, each, *limits, **more) for each in numbers)

    return check_all


def _check_voxel(what: str, value: object) -> float:
    return check_side(checks.number(what, value))


@dataclass(frozen=True)
class TrainingOptions(Settings):
    """Options of training a model, those of ``writers.classifiermodel``, which describes them."""

    neighborhoods: Any = setting(
        ("s5", "k10", "k20", "k50"),
        "list",
        "Neighborhoods: tokens (c2, s1, k50, kopt, ropt, rdim, copt) or a preset (blomley2016, "
        "weinmann2018, he2017)",
    )
    feature_set: Any = setting(
        ("covariance", "Verticality", "HeightRange", "HeightStd", "HeightAboveLowest"),
        "list",
        "Groups (covariance, geometric, shapes, surfaces, all) or single features. 'all' is the "
        "papers' set",
    )
    dimensions: Sequence[str] = setting(
        ("HeightAboveGround",),
        "list",
        "Dimensions of the points to use as features as well, e.g. HeightAboveGround, Intensity; "
        "or what is computed of points around: returns (all return features), GapBelow",
        check=checks.names,
    )
    classes: Any = setting(
        None,
        "classes",
        "Class codes, e.g. 2,5,6, or labels and their classes: "
        '{"2": "Ground", "3,4,5": "5 Vegetation", "6": 6}; default: every label but 0, 1, 7, 12 '
        "and 18, and these where the base has them",
    )
    target: int | None = setting(
        None, "integer", "Class to tell from all the others, which become class 1", 0, 255
    )
    count: int = setting(
        40_000,
        "integer",
        "Samples per class",
        1,
        10**8,
    )
    fill_up: bool = setting(
        True,
        "boolean",
        "Fill up smaller classes with duplicates, so that all weigh alike; without it a class that "
        "is rare in the labels is rare in the samples",
    )
    sampling: str = setting(
        "spread",
        "string",
        "How samples are drawn: spread evenly over the ground, or at random from all points of a "
        "class",
        choices=("spread", "random"),
    )
    seed: int = setting(
        0, "integer", "Seed for sampling, trees and shape distributions", 0, 2**31 - 1
    )
    trees: int = setting(50, "integer", "Number of trees", 1, 10_000)
    trees_grid: Sequence[int] = setting(
        (),
        "numbers",
        "Numbers of trees to choose from by out-of-bag accuracy on the samples, instead of 'trees'",
        may_be_empty=True,
        check=_each(checks.whole, 1, 10_000),
    )
    max_depth: str | None = setting(
        None,
        "string",
        "Maximum depth of a tree: sqrt for the root of the number of features; default: no limit",
        choices=("sqrt",),
    )
    vote: str = setting(
        "mean",
        "string",
        "How trees decide: by the mean of their class probabilities, or by majority vote",
        choices=("mean", "majority"),
    )
    scaling: str = setting(
        "none",
        "string",
        "percentiles: limit shape measures and heights to their 1st and 99th percentile among the "
        "samples, which is "
        "what scaling to [0, 1] changes for trees",
        choices=("none", "percentiles"),
    )
    copt_threshold: float | None = setting(
        None,
        "number",
        "Curvature from which on copt takes a point as scattered; default: by 2-means over the "
        "training clouds",
        *(0, 1),
    )
    min_samples_leaf: int = setting(3, "integer", "Minimum number of samples in a leaf", 1, 10**6)
    max_samples: float | None = setting(
        None,
        "number",
        "Share of the samples drawn for each tree; default: a third, on average "
        f"{LEAST_PER_TREE:,} to {PER_TREE:,} of each "
        "class",
        *(0, 1),
        exclusive=True,
    )
    max_features: str = setting(
        "auto",
        "string",
        "Features tried at each split: a tenth of them, at least the square root (auto), or that "
        "root (sqrt)",
        choices=("auto", "sqrt"),
    )
    prior_weight: float = setting(
        0.2,
        "number",
        "Weight of class frequency, from 0 (all equally frequent, as sampled) to 1 (as in the "
        "training points)",
        *(0, 1),
    )
    thin: Sequence[float] = setting(
        (),
        "numbers",
        "Densities of thinned copies to train on as well, points/m2, so that the model also works "
        "on sparse clouds",
        may_be_empty=True,
        check=_each(checks.number, 0, 10**6, above=True),
    )
    voxel: float = setting(
        0.125,
        "number",
        "Voxel size: in training and classifying one point represents each voxel, the others get "
        "its class; 0 for none",
        *(0, LARGEST),
        unit="m",
        check=_check_voxel,
    )
    ignore: Sequence[int] = setting(
        NOISE,
        "list",
        "Labels of points to leave out, even as neighbors, unless 'classes' names them; default: "
        "noise",
        check=_each(checks.whole, 0, MAX_LABEL),
    )
    folds: int = setting(
        5,  # not tuned
        "integer",
        "Folds of cross-validation by survey or block of ground, with a quarter of the trees; 0 "
        "for none",
        *(0, 1000),
    )
    passes: Any = setting(
        None,
        "integer",
        "Number of forests in succession, each using what the previous one found around a point; "
        "default 2; on a base there is one",
        *(1, MOST_PASSES),
    )
    context: Any = setting(
        None,
        "list",
        "What passes after the first use: own; box, boxvotes, column, columnvotes and a cell size "
        "(box0.5); segments or lines and a class (segments6, lines14); default: "
        f"{','.join(DEFAULT_CONTEXT)}; with a base {','.join(CONTEXT_OF_BASE)}",
    )
    lines: Sequence[int] = setting(
        (),
        "list",
        "Classes whose points lie on straight lines, as those of wires do: all that may be of them "
        "and lies on such a line is, and nothing else",
        may_be_empty=True,
        check=_each(checks.whole, 0, 255),
    )
    base: Any = setting(
        None,
        "model",
        "A model to build on, so that a few labels suffice; it still decides on classes without "
        "labels",
    )
    algorithm: str = setting(
        "random_forest",
        "string",
        "A forest on computed features, or a network on the points themselves (needs PyTorch)",
    )
    alsnet: Any = setting(
        None,
        "mapping",
        'Options of the network: {"configuration": "small", "epochs": 60, ...}; see the page on '
        "alsNet",
    )
    threads: int | None = setting(
        None, "integer", "Threads to use; by default every available core"
    )
    memory_mb: float = setting(
        512.0,
        "number",
        "Memory for blocks of points, in addition to the samples",
        *(0, 10**9),
        exclusive=True,
        unit="MB",
    )

    def __post_init__(self) -> None:
        """Check all options, and fill in those that follow from others."""
        super().__post_init__()
        checks.one_of("'algorithm'", self.algorithm, kinds())
        self._set(alsnet=trainer_of(self.algorithm).own_options(self.alsnet))
        if self.base is not None:
            self._check_base()
        if self.copt_threshold is not None and not feature_plan(self).copt:
            raise OptionError(
                "'copt_threshold' is for the neighborhood copt",
                found=", ".join(map(str, self.neighborhoods)),
                cure="Leave it out, or name copt among the neighborhoods",
            )
        passes = DEFAULT_PASSES if self.base is None else 1
        context = DEFAULT_CONTEXT if self.base is None else CONTEXT_OF_BASE
        self._set(
            passes=passes if self.passes is None else self.passes,
            context=Context.parse(context if self.context is None else self.context).tokens,
        )
        if self.folds == 1:
            raise OptionError(
                "one fold would hold out all samples",
                found="folds 1",
                cure="Use at least 2 folds, or 0 for no score",
            )
        if self.passes > 1 and not self.context:
            raise OptionError(
                "several passes need a context", found="an empty list", cure="Leave 'context' out"
            )
        resolve_threads(self.threads)

    def _set(self, **values: object) -> None:
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def _check_base(self) -> None:
        passes: Sequence[Estimator] = getattr(self.base, "passes", ())
        if not 0 < len(passes) <= MOST_PASSES or isinstance(passes[0], PointEstimator):
            raise OptionError(
                f"a base must be a model of up to {MOST_PASSES} forests",
                found=", ".join(each.name for each in passes) or repr(self.base)[:60],
                cure="Load it with load_model; of a refined model take the one that it was built "
                "on, with all labels together",
            )
        if self.algorithm != FOREST or self.target is not None or self.passes not in (None, 1):
            raise OptionError(
                "on a 'base' there is one forest that knows all labeled classes",
                found=f"algorithm {self.algorithm}, target {self.target}, passes {self.passes}",
                cure="Leave these options out",
            )
        if self.context is not None and OWN not in Context.parse(self.context).tokens:
            raise OptionError(f"on a base, 'context' needs '{OWN}'", found=str(self.context)[:60])
        self._set(voxel=self.base.voxel)

    @property
    def inputs(self) -> tuple[str, ...]:
        """Dimensions of the points that the classifier will use, X, Y and Z among them."""
        return trainer_of(self.algorithm).inputs(self)


def feature_plan(options: TrainingOptions) -> FeaturePlan:
    """Return the features that options ask for."""
    return FeaturePlan.parse(
        options.neighborhoods, feature_set=options.feature_set, dimensions=options.dimensions
    )


# Recipes: the options of a paper, or for a kind of scan, under one word. Beside each value stands
# the section of the paper that gives it; `not stated` marks what the paper leaves open and what
# this package takes instead. An option that is not listed has its default.

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
#: [W18]'s multi-class experiments.
_WEINMANN = {
    "neighborhoods": ("weinmann2018",),  # 3.1 ten neighborhoods
    "feature_set": ("all",),  # 3.2 560 features
    "dimensions": ("HeightAboveGround",),  # 3.2 normalized height
    "count": 100_000,  # 4.3 (10,000 for the first figures)
    "trees": 100,  # not stated
    **_BREIMAN,
}

#: Options of ``writers.classifiermodel``, by the word that users type.
RECIPES: dict[str, JsonObject] = {
    "blomley2016": {
        "neighborhoods": ("blomley2016",),  # 3.1 four cylinders and k_opt
        "feature_set": ("all",),  # 3.2 shape measures and shape distributions
        "dimensions": ("Z",),  # 3.2.1 the height, whatever neighborhoods are named
        "count": 1_000,  # 4.2 N_E = 1000
        "trees_grid": (50, 100, 200),  # 4.2 grid search; its values are not stated
        **_BREIMAN,
    },
    "weinmann2018": _WEINMANN,
    # 3.3, 4.3 binary: one class against all others, "Background"; buildings by default
    "weinmann2018-binary": {**_WEINMANN, "target": BUILDING},
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
            "reach": 4,  # 3 the nearest 200,000 points: not cut off at the default 1.5 spacings
            "coordinates": "",
            "learning_rate": 0.001,  # not stated; falls to 1 % of it, which is not stated either
            "batches_per_step": 1,
            "class_weights": "none",
            "histogram_threshold": 20,
            "augment": False,
            "validation": 0,
        },
    },
    # The labels of the ISPRS benchmark Vaihingen [W18 4.1, WM19 4.2], beside another recipe: all
    # nine are classes, 0, 1 and 7 too, under the benchmark's names and codes of ASPRS or above 63.
    "vaihingen": {
        "classes": {
            "0": "14 Powerline",
            "1": "3 Low vegetation",
            "2": "11 Impervious surfaces",
            "3": "64 Car",
            "4": "65 Fence/Hedge",
            "5": "6 Roof",
            "6": "67 Facade",
            "7": "4 Shrub",
            "8": "5 Tree",
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


def with_recipe(options: Mapping[str, object]) -> JsonObject:
    """Return options with those of the recipes that they name filled in, the last one first.

    Options of the network are merged one by one. OptionError for an unknown recipe.
    """
    values: JsonObject = {}
    for name in checks.names("option 'recipe'", options.get("recipe") or ()):
        checks.one_of("option 'recipe'", name, tuple(RECIPES))
        values |= RECIPES[name]
    network = options.get("alsnet")
    if isinstance(network, Mapping):
        network = {**values.get("alsnet", {}), **network}
    return {**values, **options, **({} if network is None else {"alsnet": network})}


def describe_recipes() -> str:
    """Return what each recipe sets, as text."""
    lines = ["Recipes:"]
    for name, values in RECIPES.items():
        lines += ["", f"  {name}", *(f"      {k}: {json.dumps(v)}" for k, v in values.items())]
    return "\n".join(lines)
