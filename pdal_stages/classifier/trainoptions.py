"""Options of training, checked once, before any work is done."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ..base import checks
from ..base.asprs import NOISE
from ..base.errors import OptionError, suggest
from ..base.threads import resolve_threads
from ..features.voxels import LARGEST
from .algorithms import ALGORITHMS, trainer
from .classes import MAX_LABEL
from .context import Context

STRATEGIES = ("multiclass", "binary")
#: Most passes a model can have.
MOST_PASSES = 3
#: What passes after the first read of the surroundings.
DEFAULT_CONTEXT = ("own", "box1", "columnvotes2", "columnvotes8")


@dataclass(frozen=True)
class TrainingOptions:
    """How a model is trained.

    Attributes
    ----------
    neighborhoods : str or sequence of str
        Preset or tokens, as for features. The default has one sphere and three numbers of neighbors: on surveys a
        model has not seen these four beat the papers' nine, at a fraction of the time.
    feature_set : str or sequence of str
        Which features, as for features. The default leaves out density, which belongs to the sensor, and shape
        distributions, and adds the height above the lowest point of each neighborhood [HWS16], which tells low
        vegetation from sloping ground.
    dimensions : sequence of str
        Dimensions of the points used as features beside the geometric ones. HeightAboveGround alone by
        default: Intensity depends on sensor, flying height and calibration, and return numbers
        on the sensor, so a model that uses them seldom fits another flight. ``ReturnRatio`` is
        ReturnNumber / NumberOfReturns.
    classes : None, str, sequence of int or mapping
        Labels and what they become; see ``ClassMap.parse``.
    strategy : {"multiclass", "binary"}
        All classes, or `target` against all the others, which become `background`.
    target, background : int
        Codes of the binary strategy.
    count : int
        Samples of each class. A class with fewer points has them counted several times.
    seed : int
        Seed of everything random: sampling, bootstrap, splits, shape distributions.
    trees, max_depth, min_samples_leaf : int, or a list of values to search (grid search)
        `max_depth` None or 0: unlimited.
    max_samples : float
        Size of each tree's bootstrap sample, as a share of all samples.
    max_features : "auto", "sqrt", "log2", int or float
        Features tried at a split; a float is a share of them. Auto: a tenth, but at least the square root.
    prior_weight : float
        0: classes are taken as equally frequent, as they are sampled; rare ones are then called too often.
        1: as frequent as in the training clouds; rare ones are then hardly called at all. Between: each class's
        probability is multiplied by its frequency to this power. The default lies between what suits new ground
        (held-out tiles gain up to 0.3 and more) and held-out blocks amid the training points (0 to 0.1).
    balance : bool
        Whether every survey, and every thinned copy of one, gives as many samples of a class as the others, as far as
        it has them. Without, each gives as many as its share of the class's points.
    thin : sequence of float
        Points per square metre of sparser copies that each cloud is also trained in. Features are computed on the
        copies; dimensions keep the values they have in the whole cloud.
    voxel : float
        Side in metres, 0 for none: one point represents each voxel, in training and in classifying, and the others get its
        class. Bounds the cost of a point in a drone's cloud, and keeps a model near the densities it knows.
    ignore : sequence of int
        Labels whose points are not even neighbors, unless `classes` names them: noise.
    scale : bool
        Limit features to the 1st and 99th percentile of the samples, from 0 where the smallest value is 0
        [B16 3.3].
    folds : int, optional
        Folds of the spatial cross-validation; 0: none (5 where there is a grid to search). None: 5 with a quarter of the
        trees, by survey where there are several, so that every model has an honest score; it chooses nothing then.
    groups : str
        Dimension whose points of one value are held out together in cross-validation: a tile, a file. Where that takes all
        samples of a class away, blocks of ground are held out instead. It changes the score alone, unless there is a grid
        to search.
    block_size : float
        Side of the cross-validation's blocks in metres.
    gap : float or None
        Training samples nearer than this (metres, in plan) to a validation sample are left out of that fold.
        None: the largest radius of the neighborhoods.
    leave_one_survey_out : bool
        Whether to score each survey with forests grown without it, all passes.
    passes : int
        1 to 3. Every pass after the first reads, beside the features, what the one before says all around
        (`context`), and is trained on what it says of ground it has not seen.
    context : sequence of str
        What of the surroundings is read; see :class:`pdal_stages.classifier.context.Context`.
    pass_folds : int
        Parts of the training ground that are held out in turn for that: whole surveys where there are three or
        more, else every so many-th strip of 10 m.
    algorithm : {"random_forest", "alsnet"}
        A forest on features, or a network on the points themselves [WM19], which uses `dimensions`, `classes`,
        `strategy`, `seed` and `threads` of these options and all of `alsnet`.
    alsnet : mapping or NetworkOptions, optional
        How the network is trained; see :class:`pdal_stages.alsnet.NetworkOptions`.
    threads : int or None
    memory_mb : float
        For blocks of features under way; the matrix of all samples comes on top.
    """

    neighborhoods: Any = ("s5", "k10", "k20", "k50")
    feature_set: Any = ("covariance", "Verticality", "HeightRange", "HeightStd", "HeightAboveLowest")
    dimensions: Sequence[str] = ("HeightAboveGround",)
    classes: Any = None
    strategy: str = "multiclass"
    target: int | None = None
    background: int = 1
    count: int = 10_000
    seed: int = 0
    trees: int | Sequence[int] = 50
    max_depth: int | Sequence[int | None] | None = None
    min_samples_leaf: int | Sequence[int] = 3
    max_samples: float = 1.0
    max_features: str | int | float = "auto"
    prior_weight: float = 0.2
    balance: bool = True
    thin: Sequence[float] = ()
    voxel: float = 0.125
    ignore: Sequence[int] = NOISE
    scale: bool = True
    folds: int | None = None
    groups: str = ""
    block_size: float = 25.0
    gap: float | None = None
    leave_one_survey_out: bool = False
    passes: int = 2
    context: Sequence[str] = DEFAULT_CONTEXT
    pass_folds: int = 5
    algorithm: str = "random_forest"
    alsnet: Any = None
    threads: int | None = None
    memory_mb: float = 512.0

    def __post_init__(self) -> None:
        def put(name: str, check: Any, *bounds: float, **more: Any) -> None:
            object.__setattr__(self, name, check(f"'{name}'", getattr(self, name), *bounds, **more))

        put("count", checks.whole, 1, 10**8)
        put("seed", checks.whole, 0, 2**63 - 1)
        put("passes", checks.whole, 1, MOST_PASSES)
        put("pass_folds", checks.whole, 2, 100)
        self.searches  # noqa: B018  wrong values to search are refused here
        if self.folds is not None:
            put("folds", checks.whole, 0, 1000)
        if not isinstance(self.groups, str):
            raise OptionError("'groups' must be the name of a dimension", found=repr(self.groups)[:60])
        if self.folds == 1:
            raise OptionError("'folds' must be 0 or at least 2", found=1)
        checks.one_of("'strategy'", self.strategy, STRATEGIES)
        self._check_algorithm()
        put("context", lambda _, tokens: Context.parse(tokens).tokens)
        if self.passes > 1 and not self.context:
            raise OptionError(
                "several passes need a context", found="an empty list", cure="Leave 'context' out"
            )
        if self.strategy == "binary" and self.target is None:
            raise OptionError("the binary strategy needs 'target', the code of the class to find")
        if self.strategy == "multiclass" and self.target is not None:
            raise OptionError("'target' means something only with strategy 'binary'", found=self.target)
        if self.target is not None:
            put("target", checks.whole, 0, 255)
        put("background", checks.whole, 0, 255)
        put("max_samples", checks.number, 0, 1, above=True)
        put("block_size", checks.number, 0, 10**6, above=True, unit="m")
        put("memory_mb", checks.number, 0, 10**9, above=True)
        put("prior_weight", checks.number, 0, 1)
        put("voxel", checks.number, 0, LARGEST, unit="m")
        if self.gap is not None:
            put("gap", checks.number, 0, 10**6, unit="m")
        m = self.max_features
        if isinstance(m, str):
            good = m in ("auto", "sqrt", "log2")
        elif isinstance(m, float | np.floating):
            good = 0.0 < m <= 1.0
        else:
            good = isinstance(m, int | np.integer) and not isinstance(m, bool) and m >= 1
        if not good:
            raise OptionError(
                "'max_features' must be auto, sqrt, log2, a number of features, or a share up to 1.0",
                found=repr(m),
            )
        put("dimensions", checks.names)
        for name in ("scale", "balance", "leave_one_survey_out"):
            put(name, checks.flag)
        thin = [self.thin] if isinstance(self.thin, int | float) else self.thin
        rule: Any = {"low": 0, "high": 10**6, "above": True, "unit": "points/m2"}
        put("thin", lambda what, _: tuple(checks.number(what, one, **rule) for one in thin))
        ignore = [self.ignore] if isinstance(self.ignore, int) else self.ignore
        put("ignore", lambda what, _: tuple(checks.whole(what, one, 0, MAX_LABEL) for one in ignore))
        resolve_threads(self.threads)

    def _check_algorithm(self) -> None:
        checks.one_of("'algorithm'", self.algorithm, ALGORITHMS)
        for name in ALGORITHMS:  # an algorithm's own options stand under its name
            if name != self.algorithm and getattr(self, name, None):
                raise OptionError(
                    f"'{name}' means something only with algorithm '{name}'", found=self.algorithm
                )
        own = trainer(self.algorithm).own_options(getattr(self, self.algorithm, None))
        if own is not None:
            object.__setattr__(self, self.algorithm, own)

    @property
    def inputs(self) -> tuple[str, ...]:
        """Dimensions of the points that the classifier will use, X, Y and Z among them."""
        return trainer(self.algorithm).inputs(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> TrainingOptions:
        """Options by name; an unknown name is an error."""
        known = [f.name for f in fields(cls)]
        for name in values:
            if name not in known:
                raise OptionError(f"unknown training option '{name}'", cure=suggest(name, known))
        return cls(**values)

    def candidates(self) -> list[dict[str, Any]]:
        """Every combination of `max_depth` and `min_samples_leaf` to search."""
        return [
            {"max_depth": depth, "min_samples_leaf": leaf}
            for depth in _values("max_depth", self.max_depth, 1, 10_000, none=True)
            for leaf in _values("min_samples_leaf", self.min_samples_leaf, 1, 10**6)
        ]

    def tree_counts(self) -> list[int]:
        """Numbers of trees to search, ascending."""
        return sorted(set(_values("trees", self.trees, 1, 10_000)))

    @property
    def searches(self) -> bool:
        """Whether there is more than one combination to try."""
        return len(self.candidates()) * len(self.tree_counts()) > 1


def _values(name: str, value: Any, low: int, high: int, none: bool = False) -> list[Any]:
    """One value or a list of them, each a whole number (or unlimited: None or 0)."""
    many = list(value) if isinstance(value, Sequence) and not isinstance(value, str) else [value]
    if not many:
        raise OptionError(f"'{name}' is an empty list", cure="Give a number")
    return [None if none and (v is None or v == 0) else checks.whole(f"'{name}'", v, low, high) for v in many]
