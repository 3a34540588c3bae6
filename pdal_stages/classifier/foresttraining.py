"""Training a forest: sample, compute features for the samples only, search, grow, score."""

from __future__ import annotations

import math
import os
import platform
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import DimensionError, OptionError
from ..base.progress import Progress
from ..base.threads import map_blocks
from ..base.version import __version__
from ..features import FeatureEngine, FeaturePlan, ShapeBins
from . import crossval
from .classes import ClassMap
from .clouds import TrainingCloud, class_positions
from .dimensions import gather, required
from .featureforest import FeatureForest
from .forest import Forest
from .growing import TreeOptions, grow
from .model import Model
from .sampling import Samples, draw_samples
from .trainoptions import TrainingOptions


class ForestTrainer:
    """How ``random_forest`` is trained."""

    @staticmethod
    def own_options(given: Any) -> None:
        """A forest has none beside ``TrainingOptions``."""

    @staticmethod
    def inputs(options: TrainingOptions) -> tuple[str, ...]:
        """Dimensions used as features."""
        return feature_plan(options).dimensions

    @staticmethod
    def train(clouds: Sequence[TrainingCloud], options: TrainingOptions, progress: bool) -> Model:
        """See :func:`pdal_stages.classifier.train`."""
        return _train(clouds, options, progress)


def feature_plan(options: TrainingOptions) -> FeaturePlan:
    """The features that options ask for."""
    return FeaturePlan.parse(
        options.neighborhoods, feature_set=options.feature_set, dimensions=options.dimensions
    )


def _train(clouds: Sequence[TrainingCloud], options: TrainingOptions, progress: bool) -> Model:
    started = time.perf_counter()
    plan = feature_plan(options)
    for cloud in clouds:  # before any work
        for name in required(plan.dimensions):
            if name not in cloud.dimensions:
                gather((name,), cloud.dimensions, len(cloud.xyz), where=cloud.name)
    classes, samples = _sample(clouds, options)
    _must_fit(plan, len(samples))
    values, fitted = _features(clouds, samples, plan, options, progress)
    timed = {"features": time.perf_counter() - started}
    low, high = _percentiles(values, plan, options, samples)
    xy = np.empty((len(samples), 2))
    for number, cloud in enumerate(clouds):
        mine = samples.cloud == number
        xy[mine] = np.asarray(cloud.xyz, dtype=np.float64)[samples.row[mine], :2]

    chosen, validation = _validate(values, samples, xy, classes, plan, options, progress)
    started = time.perf_counter()
    forest, importance, bag = _grow(values, samples, classes, chosen, options, progress)
    timed["trees"] = time.perf_counter() - started
    info = {
        "strategy": options.strategy,
        "target": options.target,
        "background": options.background if options.strategy == "binary" else None,
        "classes": [
            {"code": code, "name": name, "labels": list(labels), **samples.counts(position)}
            for position, (code, name, labels) in enumerate(
                zip(classes.codes, classes.names, classes.labels, strict=True)
            )
        ],
        "training": {
            "clouds": [{"name": os.path.basename(c.name), "points": len(c.xyz)} for c in clouds],
            "count": options.count,
            "seed": options.seed,
            "samples": len(samples),
            "max_samples": float(options.max_samples),
            "max_features": options.max_features,
            "min_samples_leaf": chosen["min_samples_leaf"],
            "max_depth": chosen["max_depth"],
            **fitted.notes,
        },
        "priors": _priors(samples, len(classes.codes), float(options.prior_weight)),
        "percentiles": {"low": low, "high": high, "limited": options.scale},
        "accuracy": {"out_of_bag": bag, "cross_validation": validation},
        "importances": importance,
        "created_by": _versions(),
    }
    made = FeatureForest(plan, forest, fitted.bins, fitted.copt_threshold, options.seed)
    return Model(made, list(zip(classes.codes, classes.names, strict=True)), info, timed)


# ---- samples -----------------------------------------------------------------------------------------------


def _sample(clouds: Sequence[TrainingCloud], options: TrainingOptions) -> tuple[ClassMap, Samples]:
    classes, positions = class_positions(clouds, options)
    inputs = [
        (np.asarray(cloud.xyz, dtype=np.float64), position)
        for cloud, position in zip(clouds, positions, strict=True)
    ]
    return classes, draw_samples(inputs, len(classes.codes), options.count, options.seed)


def _priors(samples: Samples, n_classes: int, weight: float) -> dict[str, Any] | None:
    """Factors of the classes' probabilities: frequency in the clouds over frequency in the samples, tempered."""
    if weight == 0:
        return None
    drawn = np.bincount(samples.label, samples.weight, n_classes)
    factors = (np.array(samples.available) / drawn) ** weight
    return {"weight": weight, "factors": (factors / factors.max()).tolist()}


def _must_fit(plan: FeaturePlan, n: int) -> None:
    """An error where this machine cannot hold the matrix of all samples."""
    needed = n * len(plan.names) * 4
    try:
        there = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return  # a system that does not tell
    if needed > 0.8 * there:
        raise OptionError(
            f"{n:,} samples of {len(plan.names)} features do not fit in this machine's memory",
            found=f"{needed / 2**30:.1f} GiB needed, {there / 2**30:.1f} GiB there",
            cure="Lower 'count', or use fewer neighborhoods or features",
        )


# ---- features ----------------------------------------------------------------------------------------------


@dataclass
class _Fitted:
    """What the feature engine fitted, and what it counted."""

    bins: ShapeBins | None = None
    copt_threshold: float | None = None
    notes: dict[str, Any] = field(default_factory=dict)


def _engine(
    cloud: TrainingCloud, plan: FeaturePlan, options: TrainingOptions, fitted: _Fitted
) -> FeatureEngine:
    return FeatureEngine(
        np.asarray(cloud.xyz, dtype=np.float64),
        plan,
        bins=fitted.bins,
        copt_threshold=fitted.copt_threshold,
        seed=options.seed,
        threads=options.threads,
    )


def _fit(clouds: Sequence[TrainingCloud], share, plan: FeaturePlan, options: TrainingOptions) -> _Fitted:
    """Histogram and curvature thresholds: the mean of each cloud's own, weighted by its samples."""
    fitted = _Fitted()
    engines = [_engine(c, plan, options, fitted).fit() for c, n in zip(clouds, share, strict=True) if n]
    weight = [n / sum(share) for n in share if n]

    def mean(values) -> float:  # exactly rounded, so the order of the clouds does not matter
        return math.fsum(w * v for w, v in zip(weight, values, strict=True)) if len(weight) > 1 else values[0]

    if engines[0].copt_threshold is not None:
        fitted.copt_threshold = mean([e.copt_threshold for e in engines])
    if engines[0].bins is not None:
        each = [e.bins.to_dict() for e in engines if e.bins is not None]
        fitted.bins = ShapeBins.from_dict(
            {
                token: {
                    metric: [
                        mean(values) for values in zip(*(one[token][metric] for one in each), strict=True)
                    ]
                    for metric in rows
                }
                for token, rows in each[0].items()
            }
        )
    return fitted


def _features(
    clouds: Sequence[TrainingCloud],
    samples: Samples,
    plan: FeaturePlan,
    options: TrainingOptions,
    progress: bool,
) -> tuple[npt.NDArray[np.float32], _Fitted]:
    """The (samples, features) float32 matrix, filled cloud by cloud."""
    values = np.empty((len(samples), len(plan.names)), np.float32)
    share = np.bincount(samples.cloud, minlength=len(clouds)).tolist()
    fitted = _fit(clouds, share, plan, options)
    with Progress(len(samples), "features of the samples", enabled=None if progress else False) as bar:
        for number, cloud in enumerate(clouds):
            at = np.flatnonzero(samples.cloud == number)
            if not len(at):
                continue
            at = at[np.argsort(samples.row[at], kind="stable")]
            rows = samples.row[at]
            engine = _engine(cloud, plan, options, fitted)
            fed, notes = gather(plan.dimensions, cloud.dimensions, len(cloud.xyz), rows, cloud.name)
            for name, n in notes.items():
                fitted.notes[name] = fitted.notes.get(name, 0) + n
            for part, block in engine.blocks(
                queries=rows,
                dimensions=fed,
                threads=options.threads,
                memory_mb=options.memory_mb,
                progress=bar,
            ):
                values[at[np.searchsorted(rows, part)]] = block  # `part` are rows of the cloud
    if not np.isfinite(values).all():
        column = int(np.argmin(np.isfinite(values).all(axis=0)))
        raise DimensionError(f"the feature {plan.names[column]} is not finite for some samples")
    return values, fitted


def _percentiles(
    values: npt.NDArray[np.float32], plan: FeaturePlan, options: TrainingOptions, samples: Samples
) -> tuple[list[float], list[float]]:
    """1st and 99th percentile of each geometric feature, the values limited to them if so wanted.

    [B16 3.3] scales features to [0, 1] between the two and cuts off what is beyond. Splits of a tree do not
    change under scaling, so only the cut is done, on the training values: no threshold can then lie beyond
    the percentiles, and a value beyond goes the way its limit would. Inference needs neither.
    """
    computed = len(plan.names) - len(plan.dimensions)
    low = [0.0] * len(plan.names)
    high = [1.0] * len(plan.names)
    columns = range(len(plan.names))

    def one(j: int) -> None:
        column = values[:, j]
        if j >= computed:  # dimensions keep their own scale
            low[j], high[j] = float(column.min()), float(column.max())
            return
        first, last = np.percentile(column, [1.0, 99.0]).astype(np.float32)
        if np.abs(column).min() == 0.0 and first >= 0.0 and column.min() >= 0.0:
            first = np.float32(0.0)
        low[j], high[j] = float(first), float(last)
        if options.scale:
            np.clip(column, first, last, out=column)

    for _ in map_blocks(one, columns, options.threads):
        pass
    return low, high


# ---- trees -------------------------------------------------------------------------------------------------


def _tree_options(options: TrainingOptions, max_depth: int | None, min_samples_leaf: int) -> TreeOptions:
    return TreeOptions(max_depth, min_samples_leaf, float(options.max_samples), options.max_features)


def _validate(
    values,
    samples: Samples,
    xy,
    classes: ClassMap,
    plan: FeaturePlan,
    options: TrainingOptions,
    progress: bool,
) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """(chosen trees, depth, leaf size; the cross-validation for the manifest or None)."""
    counts = options.tree_counts()
    candidates = options.candidates()
    folds = options.folds or (5 if options.searches else 0)
    if not folds:
        return {"trees": counts[-1], **candidates[0]}, None
    gap = options.gap
    if gap is None:
        gap = max((one.reach or 0.0 for one in plan.neighborhoods), default=0.0)
    rows = crossval.search(
        values,
        samples.label,
        samples.weight,
        xy,
        classes.codes,
        [_tree_options(options, **candidate) for candidate in candidates],
        counts,
        folds=folds,
        block_size=float(options.block_size),
        gap=float(gap),
        seed=options.seed,
        threads=options.threads,
        progress=progress,
    )
    chosen = crossval.choose(rows)
    return chosen, {
        "folds": folds,
        "block_size": float(options.block_size),
        "gap": float(gap),
        "tried": rows,
        "chosen": chosen,
    }


def _grow(
    values,
    samples: Samples,
    classes: ClassMap,
    chosen: Mapping[str, Any],
    options: TrainingOptions,
    progress: bool,
) -> tuple[Forest, list[float], dict[str, Any] | None]:
    """(forest, importances, out-of-bag score)."""
    n, k = len(samples), len(classes.codes)
    total = np.zeros((n, k))
    trees = []
    importance = np.zeros(values.shape[1])
    setting = _tree_options(options, chosen["max_depth"], chosen["min_samples_leaf"])
    with Progress(chosen["trees"], "growing", "trees", enabled=None if progress else False) as bar:
        for tree, rows, shares in grow(
            values,
            samples.label,
            samples.weight,
            chosen["trees"],
            setting,
            options.seed,
            score="out of bag",
            threads=options.threads,
            progress=bar,
        ):
            trees.append(tree.tree_)
            importance += tree.feature_importances_
            total[rows] += shares
    scored = total.sum(axis=1) > 0
    bag = None
    if scored.any():
        matrix = np.zeros((k, k), np.int64)
        np.add.at(matrix, (samples.label[scored], total[scored].argmax(axis=1)), samples.weight[scored])
        bag = {**crossval.figures(matrix, classes.codes), "samples": int(np.count_nonzero(scored))}
    whole = importance.sum()
    return (
        Forest.from_sklearn(trees, values.shape[1]),
        (importance / whole if whole else importance).tolist(),
        bag,
    )


def _versions() -> dict[str, str]:
    import numba
    import sklearn

    return {
        "pdal_stages": __version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scikit-learn": sklearn.__version__,
        "numba": numba.__version__,
    }
