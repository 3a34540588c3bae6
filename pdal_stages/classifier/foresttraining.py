"""Training a forest: sample, compute features for the samples only, search, grow, score."""

from __future__ import annotations

import math
import platform
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import OptionError
from ..base.outputs import Output
from ..base.progress import Progress
from ..base.version import __version__
from ..features import FeaturePlan
from ..features.returns import SOURCES
from . import crossval
from .algorithms import PredictRequest
from .clouds import Labeled, TrainingCloud, densities, label_classes, listed
from .context import Context
from .dimensions import WHERE_THERE, gather, required
from .featureforest import FeatureForest, Features
from .folds import FoldForests, Folds, sample_context
from .forest import Forest
from .model import Model
from .passes import weighed
from .refinement import Below, Blend, blended, held_by_base, on_top
from .samplefeatures import fitted, must_fit, percentiles, sample_features
from .sampling import Samples, draw_samples
from .sureness import Sureness, counted
from .trainoptions import PER_TREE, TrainingOptions, feature_plan
from .trees import GrownTree, Ranked, TreeOptions, grow
from .unscored import why_unscored

#: Trees of a forest that judges a fold, as a share of the final one's.
FOLD_TREES = 0.25
#: Side in meters of blocks of ground that are held out.
BLOCK = 25.0


optional_inputs = {**{name: (name,) for name in WHERE_THERE}, "returns": SOURCES}
reports_training = False


def outputs(options: TrainingOptions) -> list[Output]:
    """The model alone."""
    return []


def own_options(given: Any) -> None:
    """A forest has none beside ``TrainingOptions``."""


def inputs(options: TrainingOptions) -> tuple[str, ...]:
    """Dimensions used as features, by the forest or by the model it is built on."""
    own = feature_plan(options).dimensions
    return own if options.base is None else tuple(dict.fromkeys([*own, *options.base.plan.dimensions]))


def train(clouds: Sequence[TrainingCloud], options: TrainingOptions, progress: bool) -> Model:
    """See :func:`pdal_stages.classifier.train`."""
    started = time.perf_counter()
    plan = feature_plan(options)
    _check_groups(clouds, options)  # before any work: a dimension may be missing
    labeled = label_classes(clouds, options, progress)
    classes = labeled.classes
    shares = [f"{cloud.flight} {cloud.copy}" for cloud in clouds]
    total = sum(map(len, clouds)) * (1 + len(classes.codes))  # which are read for each class
    with Progress(total, "drawing samples", enabled=progress) as bar:
        samples = draw_samples(labeled, len(classes.codes), options.count, options.seed, shares, progress=bar)
    base = options.base
    known = set() if base is None else set(base.codes.tolist())
    read = 0 if options.passes == 1 and base is None else len(known | set(classes.codes))
    must_fit(len(plan.names) + len(options.context) * read, len(samples))
    features = Features(plan, *fitted(clouds, samples, plan, options), options.seed)
    values, counted = sample_features(clouds, samples, features, options, progress)
    timed = {"features": time.perf_counter() - started}
    limits = percentiles(values, plan, options)
    below = None if base is None else Below(base, clouds, samples, options, progress)
    xy = samples.take(lambda number: clouds[number].xyz[:, :2])
    priors = _priors(samples, len(classes.codes), options.prior_weight)
    ranked = alone = Ranked.of(values, options.threads)
    del values  # as large again
    if below is not None:
        ranked = ranked.beside(Ranked.of(below.columns, options.threads))
    heard = _Heard(samples, classes.codes, priors, below, options)
    group = samples.take(lambda number: _groups(clouds[number], options))
    setting = TreeOptions(
        options.min_samples_leaf, _share_drawn(options, samples, len(classes.codes)), options.max_features
    )
    validation = _validate(ranked, samples, xy, group, classes.codes, plan, setting, options, progress, heard)
    started = time.perf_counter()
    passes = _Passes(labeled, samples, (alone, ranked), features, setting, options, progress, below)
    passes.grow(*limits)
    timed["trees"] = time.perf_counter() - started
    info = {
        **labeled.described(options, map(samples.counts, range(len(classes.codes)))),
        "training": {
            "clouds": listed(clouds),
            "count": options.count,
            "seed": options.seed,
            "samples": len(samples),
            **({"contradicted": dict(labeled.left_out)} if labeled.left_out else {}),
            "max_samples": setting.max_samples,
            "max_features": options.max_features,
            "min_samples_leaf": options.min_samples_leaf,
            **passes.notes,
            **_unscored(heard, validation, xy, samples, labeled, options, _gap(plan)),
            **({} if below is None or options.target is not None else _held(below, classes.codes)),
            **counted,
        },
        "priors": priors,
        **heard.of(validation),
        "densities": densities(clouds),
        "voxel": options.voxel,
        "accuracy": {"cross_validation": validation},
        "passes": passes.scores,
        "created_by": _versions(),
    }
    made = Model(tuple(passes.made), list(zip(classes.codes, classes.names, strict=True)), info, timed)
    return made if below is None else on_top(below, made)


def _unscored(
    heard: _Heard,
    validation: Any,
    xy: npt.NDArray[np.float64],
    samples: Samples,
    labeled: Labeled,
    options: TrainingOptions,
    gap: float,
) -> dict[str, str]:
    if validation is not None or options.folds == 0:
        return {}
    named = list(zip(labeled.classes.codes, labeled.classes.names, strict=True))
    return {"unscored": why_unscored(heard.errors, xy, samples.label, named, BLOCK, gap)}


def _held(below: Below, codes: Sequence[int]) -> dict[str, Any]:
    held = held_by_base(below, codes)
    return {"held_by_base": held} if held else {}


def _priors(samples: Samples, n_classes: int, weight: float) -> dict[str, Any] | None:
    """Factors of the classes' probabilities: frequency in the clouds over frequency in the samples, tempered."""
    if weight == 0:
        return None
    drawn = np.bincount(samples.label, samples.weight, n_classes)
    factors = (np.array(samples.available) / drawn) ** weight
    return {"weight": weight, "factors": (factors / factors.max()).tolist()}


# ---- trees -------------------------------------------------------------------------------------------------


def _share_drawn(options: TrainingOptions, samples: Samples, classes: int) -> float:
    """The share of the samples that each tree draws."""
    if options.max_samples is not None:
        return options.max_samples
    return min(1.0, PER_TREE * classes / int(samples.weight.sum()))


def _gap(plan: FeaturePlan) -> float:
    """Meters between samples trained on and ground held out."""
    return max((one.reach or 0.0 for one in plan.neighborhoods), default=0.0)


def _check_groups(clouds: Sequence[TrainingCloud], options: TrainingOptions) -> None:
    """OptionError or DimensionError where clouds have not what is to be held out together."""
    name = options.groups
    if name and required((name,)) != (name,):
        raise OptionError(
            "'groups' must name a dimension other than coordinates and what is made of them", found=name
        )
    for cloud in clouds if name else ():
        gather((name,), cloud.dimensions, len(cloud), np.zeros(0, np.int64), cloud.name)


def _groups(cloud: TrainingCloud, options: TrainingOptions) -> npt.NDArray[Any]:
    """What a cloud's points are held out with: their `groups`, or all of them with the survey."""
    name = options.groups
    if not name:
        return np.broadcast_to(np.array(cloud.flight), len(cloud))
    return gather((name,), cloud.dimensions, len(cloud), where=cloud.name)[0][name]


def _validate(
    ranked: Ranked,
    samples: Samples,
    xy: npt.NDArray[np.float64],
    group: npt.NDArray[Any],
    codes: Sequence[int],
    plan: FeaturePlan,
    setting: TreeOptions,
    options: TrainingOptions,
    progress: bool,
    heard: _Heard,
) -> dict[str, Any] | None:
    """The cross-validation for the manifest, over groups where there are several, else over blocks; None without."""
    if options.folds == 0:
        return None
    trees = max(1, math.ceil(options.trees * FOLD_TREES))
    ways: list[tuple[str, int, npt.NDArray[np.int16] | None]] = [("blocks", options.folds or 5, None)]
    names, index = np.unique(group, return_inverse=True)
    if len(names) > 1:
        folds = min(options.folds or 5, len(names))
        ways.insert(0, ("groups" if options.groups else "surveys", folds, (index % folds).astype(np.int16)))
    asked = {"groups": options.groups} if options.groups else {}
    for by, folds, fold in ways:
        heard.said = Sureness()
        gap = (
            0.0 if by == "surveys" else _gap(plan)
        )  # which do not see each other, whatever their coordinates
        try:
            if fold is None:
                fold = crossval.block_folds(xy, samples.label, samples.weight, folds, BLOCK)
            row = crossval.score(
                ranked,
                samples.label,
                samples.weight,
                xy,
                codes,
                setting,
                trees,
                fold,
                gap=gap,
                seed=options.seed,
                threads=options.threads,
                progress=progress,
                heard=heard,
            )
        except OptionError as error:  # too little ground, or a class in one place
            heard.errors.append(error)
            if by == "groups":
                asked["instead"] = f"{error.what}: {error.found}"
            continue
        more = {"folds": folds, "block_size": BLOCK, "gap": gap, "tried": [row], "chosen": row}
        return {"by": by, **asked, **more}
    return None


class _Heard:
    """What forests said of ground they had not seen, for :class:`Sureness`: as the points lie, not as they were drawn."""

    def __init__(
        self,
        samples: Samples,
        codes: Sequence[int],
        priors: Mapping[str, Any] | None,
        below: Below | None,
        options: TrainingOptions,
    ) -> None:
        self.samples, self.codes, self._below, self._options = samples, codes, below, options
        self._factors = None if priors is None else np.array(priors["factors"])
        drawn = np.bincount(samples.label, samples.weight, len(codes))
        self._weight = samples.weight * (np.array(samples.available) / np.maximum(drawn, 1))[samples.label]
        self.said = Sureness()
        self.errors: list[OptionError] = []

    def __call__(self, rows: npt.NDArray[np.int64], p: npt.NDArray[np.float64]) -> None:
        """Rows of the samples, and their probabilities (rows, classes)."""
        codes = self.codes
        if self._below is None:
            p = weighed(p, self._factors)
        else:
            if self._options.target is not None:
                return  # what the others truly are is not known
            before = self._below.base.codes.tolist()
            p = blended(self._below.own[rows], p, before, codes, self._below.trusted)
            codes = sorted({*before, *codes})
        true = np.asarray(self.codes)[self.samples.label[rows]]
        counted(p, codes, true, self._weight[rows], self.said)

    def of(self, validation: Mapping[str, Any] | None) -> dict[str, Any]:
        """What a manifest says, where anything was heard."""
        if validation is None or not self.said.right:
            return {}
        passes = "" if self._options.passes == 1 else ", of the first pass"
        trees = validation["chosen"]["trees"]
        self.said.about = f"{validation['by']} held out, forests of {trees} trees{passes}"
        return {"sureness": self.said.to_dict()}


class _Passes:
    """Growing one forest after the other, each reading what the one before says of ground it has not seen."""

    def __init__(
        self,
        labeled: Labeled,
        samples: Samples,
        ranked: tuple[Ranked, Ranked],
        features: Features,
        setting: TreeOptions,
        options: TrainingOptions,
        progress: bool,
        below: Below | None = None,
    ) -> None:
        self.below = below
        self.clouds, self.codes = labeled.clouds, labeled.classes.codes
        self.samples, self.features = samples, features
        self.alone, self.ranked = ranked  # the features, and all that the first pass reads
        self.setting, self.options, self.progress = setting, options, progress
        self.context = Context(tuple(options.context))
        self.made: list[FeatureForest] = []
        self.scores: list[dict[str, Any]] = []
        self.notes: dict[str, Any] = {}
        self.flights = [cloud.flight for cloud in self.clouds]
        if options.passes > 1:
            self.folds = Folds.of(labeled, self.flights, options.pass_folds)
            self.notes["pass_folds"] = self.folds.count

    def grow(self, low: list[float], high: list[float]) -> None:
        """Fill `made` and `scores`; `low` and `high` are the percentiles of the features."""
        for number, ranked in enumerate(self._ranked(self.samples.weight)):
            forest, importances, bag = self._forest(ranked, number)
            self.made.append(FeatureForest(self.features, forest, self._context_of(number)))
            least, largest = ranked.limits(len(low))
            percentiles = {
                "low": [*low, *least],
                "high": [*high, *largest],
                "limited": self.options.scale,
            }
            self.scores.append({"percentiles": percentiles, "importances": importances, "out_of_bag": bag})

    def _ranked(self, weight: npt.NDArray[np.int64]) -> Iterator[Ranked]:
        """What each pass reads of the samples; those of weight 0 teach none of them anything."""
        held_out: list[list[Forest]] = []
        ranked = self.ranked
        yield ranked
        for number in range(1, self.options.passes):
            held_out.append(self._hold_out(ranked, weight, number))
            ranked = self.alone.beside(Ranked.of(self._context(held_out), self.options.threads))
            yield ranked

    def _context_of(self, number: int) -> Context | None:
        """What a pass reads of the one before."""
        if number:
            return self.context
        return None if self.below is None else self.below.context

    def _hold_out(self, ranked: Ranked, weight: npt.NDArray[np.int64], number: int) -> list[Forest]:
        """The pass `number` once more, a forest without each fold.

        Ground beside a fold is not left out as in cross-validation: the forests miss the fold's samples already, and the
        next pass should see probabilities as good as those it will see when the model is used.
        """
        trees = max(1, math.ceil(self.options.trees * FOLD_TREES))
        fold = np.empty(len(self.samples), np.int16)
        for k, cloud in enumerate(self.clouds):
            mine = self.samples.cloud == k
            fold[mine] = self.folds.points(cloud.xyz[self.samples.row[mine]], self.flights[k])
        forests, what = [], f"pass {number} without each fold"
        with Progress(trees * self.folds.count, what, "trees", enabled=self.progress) as bar:
            for k in range(self.folds.count):
                train = (fold != k) & (weight > 0)
                if len(np.unique(self.samples.label[train])) < 2:
                    raise OptionError(
                        "without one of its folds the training ground has fewer than two classes left",
                        cure="Give more training data, or set passes to 1",
                    )
                grown = self._grown(ranked, weight * train, trees, bar)
                forests.append(Forest.from_trees([tree for tree, _, _ in grown], ranked.columns))
        return forests

    def _context(self, held_out: Sequence[Sequence[Forest]]) -> npt.NDArray[np.float32]:
        """The samples' context, (samples, columns), by passes that have not seen them."""
        o, below, count = self.options, self.below, len(held_out)
        reads = [self._context_of(number) for number in range(count)]
        first: Any = () if below is None else below.passes
        factors = () if below is None else below.factors
        blends: Sequence[Blend | None] = [None] * count if below is None else self._blends(reads)
        classes = [] if below is None else list(below.classes)
        classes += [len(self.codes) if one is None else len(one.codes) for one in blends]
        out = np.empty((len(self.samples), len(self.context.tokens) * classes[-1]), np.float32)
        with Progress(len(self.samples), f"context for pass {count + 1}", enabled=self.progress) as bar:
            for number, cloud in enumerate(self.clouds):
                at, rows = self.samples.of_cloud(number)
                if not len(at):
                    continue
                fold = self.folds.points(cloud.xyz, self.flights[number])
                passes = [
                    FoldForests(self.features, context, forests, fold, blend)
                    for context, forests, blend in zip(reads, held_out, blends, strict=True)
                ]
                request = PredictRequest(cloud.xyz, cloud.dimensions, rows, o.threads, o.memory_mb, bar)
                out[at] = sample_context(request, [*first, *passes], self.context, classes, factors)
        return out

    def _blends(self, reads: Sequence[Context | None]) -> list[Blend]:
        """What each pass on top of the base makes of the one before."""
        assert self.below is not None
        blends, before = [], self.below.base.codes.tolist()
        for context in reads:
            assert context is not None
            blends.append(self.below.blend(before, self.codes, len(self.features.plan.names), context))
            before = blends[-1].codes
        return blends

    def _grown(
        self,
        ranked: Ranked,
        weight: npt.NDArray[np.int64],
        trees: int,
        bar: Progress,
        **more: Any,
    ) -> Iterator[tuple[GrownTree, Any, Any]]:
        """The trees of a forest, as :func:`grow` gives them."""
        label, o = self.samples.label, self.options
        return grow(
            ranked, label, weight, trees, self.setting, o.seed, threads=o.threads, progress=bar, **more
        )

    def _forest(self, ranked: Ranked, number: int) -> tuple[Forest, list[float], dict[str, Any] | None]:
        """(forest, importances, out-of-bag score)."""
        total = np.zeros((len(self.samples), len(self.codes)))
        trees = []
        importance = np.zeros(ranked.columns)
        what = f"growing pass {number + 1}" if self.options.passes > 1 else "growing"
        count, weight = self.options.trees, self.samples.weight
        # Trees that draw few of the samples leave nearly all out of their bags: a share of these is judged.
        every = max(1, round(1.0 / self.setting.max_samples))
        with Progress(count, what, "trees", enabled=self.progress) as bar:
            for tree, rows, shares in self._grown(
                ranked, weight, count, bar, score="out of bag", every=every
            ):
                trees.append(tree)
                importance += tree.importances(ranked.columns)
                total[rows] += shares
        scored = total.sum(axis=1) > 0
        bag = None
        if scored.any():
            bag = self._figures(scored, total[scored].argmax(axis=1))
            bag["samples"] = int(np.count_nonzero(scored))
        whole = importance.sum()
        importances = (importance / whole if whole else importance).tolist()
        return Forest.from_trees(trees, ranked.columns), importances, bag

    def _figures(self, mine: npt.NDArray[np.bool_], best: npt.NDArray[np.int64]) -> dict[str, Any]:
        """Scores of some samples by their most probable classes."""
        matrix = np.zeros((len(self.codes), len(self.codes)), np.int64)
        np.add.at(matrix, (self.samples.label[mine], best), self.samples.weight[mine])
        return crossval.figures(matrix, self.codes)


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
