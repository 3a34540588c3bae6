"""Options of training, checked once, before any work is done."""

from __future__ import annotations

# ruff: noqa: RUF009  options are declared, nothing is shared
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ..base import checks
from ..base.asprs import NOISE
from ..base.errors import OptionError
from ..base.settings import Settings, setting
from ..base.threads import resolve_threads
from ..features import FeaturePlan
from ..features.voxels import LARGEST, check_side
from .class_map import MAX_LABEL
from .context_features import OWN, Context
from .recipes import with_recipe
from .registry import kinds, trainer_of

#: Most passes a model can have.
MOST_PASSES = 3
#: Where `max_samples` is not given a tree draws a third of the samples, on average at least and at most so many of a class.
LEAST_PER_TREE, PER_TREE = 1_000, 10_000
#: How many it has by default, and on top of a base, where labels are few.
DEFAULT_PASSES, PASSES_ON_BASE = 2, 1
#: What passes after the first read of the surroundings.
DEFAULT_CONTEXT = ("box1", "box4", "columnvotes1", "columnvotes4", "columnvotes8")
#: The same of a forest on top of a base.
CONTEXT_OF_BASE = ("own", "box1", "columnvotes2", "columnvotes8")


@dataclass(frozen=True)
class TrainingOptions(Settings):
    """How a model is trained."""

    neighborhoods: Any = setting(
        ("s5", "k10", "k20", "k50"),
        "list",
        "Neighborhoods: tokens (c2, s1, k50, kopt, ropt, copt) or a preset (blomley2016, weinmann2018, he2017)",
    )
    feature_set: Any = setting(
        ("covariance", "Verticality", "HeightRange", "HeightStd", "HeightAboveLowest"),
        "list",
        "Groups (covariance, geometric, shapes, surfaces, all) or single features. 'all' is the papers' set",
    )
    dimensions: Sequence[str] = setting(
        ("HeightAboveGround",),
        "list",
        "Dimensions of the points to use as features as well, e.g. HeightAboveGround, Intensity, or returns (all return "
        "features)",
    )
    classes: Any = setting(
        None,
        "mapping",
        'Class codes, e.g. 2,5,6, or labels and their classes: {"2": "Ground", "3,4,5": "5 Vegetation", "6": 6}; default: '
        "every label but 0, 1, 7, 12 and 18, and these where the base has them",
    )
    strategy: str = setting(
        "multiclass",
        "string",
        "All classes at once, or 'target' against all the others",
        choices=("multiclass", "binary"),
    )
    target: int | None = setting(None, "integer", "Class to find with the binary strategy", 0, 255)
    background: int = setting(
        1, "integer", "Code given to all other classes with the binary strategy", 0, 255
    )
    count: int = setting(
        40_000,
        "integer",
        "Samples per class; smaller classes are filled up with duplicates",
        1,
        10**8,
    )
    sampling: str = setting(
        "spread",
        "string",
        "How samples are drawn: spread evenly over the ground, or at random from all points of a class",
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
    )
    max_depth: str | int | None = setting(
        None,
        "string",
        "Maximum depth of a tree: a number, or sqrt for the root of the number of features; default: no limit",
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
        "percentiles: limit shape measures and heights to their 1st and 99th percentile among the samples, which is "
        "what scaling to [0, 1] changes for trees",
        choices=("none", "percentiles"),
    )
    copt_threshold: float | None = setting(
        None,
        "number",
        "Curvature from which on copt treats a point as scattered; default: by 2-means over the training clouds",
        *(0, 1),
    )
    min_samples_leaf: int = setting(3, "integer", "Minimum number of samples in a leaf", 1, 10**6)
    max_samples: float | None = setting(
        None,
        "number",
        f"Share of the samples drawn for each tree; default: a third, on average {LEAST_PER_TREE:,} to {PER_TREE:,} of each "
        "class",
        *(0, 1),
        exclusive=True,
    )
    max_features: str | int | float = setting(
        "auto",
        "string",
        "Features tried at each split: auto (a tenth, at least the square root), sqrt, log2, a number or a share",
    )
    prior_weight: float = setting(
        0.2,
        "number",
        "Weight of class frequency, from 0 (all equally frequent, as sampled) to 1 (as in the training points)",
        *(0, 1),
    )
    thin: Sequence[float] = setting(
        (),
        "numbers",
        "Densities of thinned copies to train on as well, points/m2, so that the model also works on sparse clouds",
    )
    voxel: float = setting(
        0.125,
        "number",
        "Voxel size: in training and classifying one point represents each voxel, the others get its class; 0 for none",
        *(0, LARGEST),
        unit="m",
    )
    ignore: Sequence[int] = setting(
        NOISE,
        "list",
        "Labels of points to leave out, even as neighbors, unless 'classes' names them; default: noise",
    )
    folds: int | None = setting(
        None,
        "integer",
        "Folds of cross-validation by group, survey or block of ground; 0 for none; default: 5, with a quarter of the trees",
        *(0, 1000),
    )
    groups: str = setting(
        "",
        "string",
        "Dimension, such as the number of a tile or flight, whose points of the same value are held out together, so that "
        "the score is for tiles or flights that the model has not seen",
    )
    passes: Any = setting(
        None,
        "integer",
        "Number of forests in succession, each using what the previous one found around a point; default 2, or 1 on a base",
        *(1, MOST_PASSES),
    )
    context: Any = setting(
        None,
        "list",
        "What passes after the first use: own, or box, boxvotes, column, columnvotes and a cell size (box0.5); default: "
        f"{','.join(DEFAULT_CONTEXT)}; with a base {','.join(CONTEXT_OF_BASE)}, or for several passes own and the former",
    )
    base: Any = setting(
        None,
        "model",
        "A model to build on, so that a few labels suffice; it still decides on classes without labels",
    )
    algorithm: str = setting(
        "random_forest",
        "string",
        "A forest on computed features, or a network on the points themselves (needs PyTorch)",
    )
    alsnet: Any = setting(
        None,
        "mapping",
        'Options of the network: {"configuration": "small", "epochs": 60, ...}; see the page on alsNet',
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
        def put(name: str, check: Any) -> None:
            object.__setattr__(self, name, check(f"'{name}'", getattr(self, name)))

        super().__post_init__()
        if not isinstance(self.groups, str):
            raise OptionError(
                "'groups' must be the name of a dimension", found=repr(self.groups)[:60]
            )
        check_side(self.voxel)
        if self.folds == 1:
            raise OptionError("'folds' must be 0 or at least 2", found=1)
        self._check_algorithm()
        base = self.base
        if self.passes is None:
            object.__setattr__(self, "passes", DEFAULT_PASSES if base is None else PASSES_ON_BASE)
        if self.context is None:
            several = DEFAULT_CONTEXT if base is None else (OWN, *DEFAULT_CONTEXT)
            put("context", lambda *_: CONTEXT_OF_BASE if base and self.passes == 1 else several)
        if base is not None:
            if (passes := getattr(base, "passes", None)) is None:
                raise OptionError(
                    "'base' must be a model",
                    found=type(base).__name__,
                    cure="Load it with load_model",
                )
            if len(passes) > MOST_PASSES:
                raise OptionError(
                    f"a base may have {MOST_PASSES} passes",
                    found=len(passes),
                    cure="Start from the model that it was built on, with all labels together",
                )
            if self.algorithm != "random_forest":
                raise OptionError(
                    "only a forest is built on a 'base'",
                    found=self.algorithm,
                    cure="Leave 'algorithm' out",
                )
            if self.passes == 1:
                object.__setattr__(self, "voxel", base.voxel)
        put("context", lambda _, tokens: Context.parse(tokens).tokens)
        if self.passes > 1 and not self.context:
            raise OptionError(
                "several passes need a context", found="an empty list", cure="Leave 'context' out"
            )
        if base is not None and OWN not in self.context:
            raise OptionError(
                f"with a 'base', 'context' must have '{OWN}'", found=", ".join(self.context)
            )
        if self.strategy == "binary" and self.target is None:
            raise OptionError("the binary strategy needs 'target', the code of the class to find")
        if self.strategy == "multiclass" and self.target is not None:
            raise OptionError("'target' applies only to strategy 'binary'", found=self.target)
        m = self.max_features
        share = isinstance(m, float | np.floating) and 0.0 < m <= 1.0
        whole = isinstance(m, int | np.integer) and not isinstance(m, bool) and m >= 1
        if not (share or whole or (isinstance(m, str) and m in ("auto", "sqrt", "log2"))):
            raise OptionError(
                "'max_features' must be auto, sqrt, log2, a number of features, or a share up to 1.0",
                found=repr(m),
            )
        depth = self.max_depth
        if not (
            depth in (None, "sqrt")
            or (isinstance(depth, int | np.integer) and not isinstance(depth, bool) and depth >= 1)
        ):
            raise OptionError(
                "'max_depth' must be a whole number of at least 1, or sqrt", found=repr(depth)
            )
        put("trees_grid", lambda what, _: _tree_numbers(what, self.trees_grid))
        put("dimensions", checks.names)
        thin = [self.thin] if isinstance(self.thin, int | float) else self.thin
        put(
            "thin",
            lambda what, _: tuple(checks.number(what, one, 0, 10**6, above=True) for one in thin),
        )
        ignore = [self.ignore] if isinstance(self.ignore, int) else self.ignore
        put(
            "ignore", lambda what, _: tuple(checks.whole(what, one, 0, MAX_LABEL) for one in ignore)
        )
        resolve_threads(self.threads)

    def _check_algorithm(self) -> None:
        checks.one_of("'algorithm'", self.algorithm, kinds())
        for name in kinds():  # an algorithm's own options stand under its name
            if name != self.algorithm and getattr(self, name, None):
                raise OptionError(
                    f"'{name}' applies only to algorithm '{name}'", found=self.algorithm
                )
        own = trainer_of(self.algorithm).own_options(getattr(self, self.algorithm, None))
        if own is not None:
            object.__setattr__(self, self.algorithm, own)

    @classmethod
    def from_recipe(cls, recipe: str, **options: Any) -> TrainingOptions:
        """Return the options of a paper's experiment, a key of ``recipes.RECIPES``; `options` replace some."""
        values = with_recipe({"recipe": recipe, **options})
        del values["recipe"]
        return cls(**values)

    @property
    def inputs(self) -> tuple[str, ...]:
        """Dimensions of the points that the classifier will use, X, Y and Z among them."""
        return trainer_of(self.algorithm).inputs(self)


def _tree_numbers(what: str, numbers: Any) -> tuple[int, ...]:
    """Return the candidates of a grid of numbers of trees, ascending; OptionError for other values."""
    numbers = [numbers] if isinstance(numbers, int | float) else numbers
    return tuple(sorted({checks.whole(what, number, 1, 10_000) for number in numbers}))


def feature_plan(options: TrainingOptions) -> FeaturePlan:
    """The features that options ask for."""
    return FeaturePlan.parse(
        options.neighborhoods, feature_set=options.feature_set, dimensions=options.dimensions
    )


def _documented() -> str:
    lines = ["How a model is trained.", "", "Attributes", "----------"]
    for one in fields(TrainingOptions):
        unit = f", {one.metadata['unit']}" if one.metadata.get("unit") else ""
        what = textwrap.fill(f"{one.metadata['help']}.", 110)
        lines += [f"{one.name} : {one.type}{unit}", textwrap.indent(what, "    ")]
    return "\n".join([*lines, ""])


TrainingOptions.__doc__ = _documented()
