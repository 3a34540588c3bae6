"""Training a forest: sample, compute features for the samples only, search, grow, score."""

from __future__ import annotations

import math
import os
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
from .clouds import Labeled, TrainingCloud, label_classes, listed
from .context import Context
from .dimensions import WHERE_THERE, gather, required
from .featureforest import FeatureForest, Features
from .folds import FoldForests, Folds, sample_context
from .forest import Forest
from .growing import TreeOptions, grow
from .model import Model
from .passes import weighed
from .refinement import Blend, blended
from .refining import Below, held_by_base, on_top
from .samplefeatures import SHORT, fitted, must_fit, percentiles, sample_features
from .sampling import Samples, draw_samples
from .sureness import Sureness, counted
from .surroundings import Looks, Seen, wider, work_on
from .thinning import density_range
from .trainoptions import PER_TREE, TrainingOptions
from .trees import GrownTree, Ranked
from .unscored import why_unscored

#: Trees of a forest that judges a fold, as a share of the final one's.
FOLD_TREES = 0.25


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


def feature_plan(options: TrainingOptions) -> FeaturePlan:
    """The features that options ask for."""
    return FeaturePlan.parse(
        options.neighborhoods, feature_set=options.feature_set, dimensions=options.dimensions
    )


def train(clouds: Sequence[TrainingCloud], options: TrainingOptions, progress: bool) -> Model:
    """See :func:`pdal_stages.classifier.train`."""
    started = time.perf_counter()
    plan = feature_plan(options)
    _check_groups(clouds, options)  # before any work: a dimension may be missing
    labeled = label_classes(clouds, options, progress)
    classes = labeled.classes
    shares = [f"{cloud.flight} {cloud.copy}" for cloud in clouds] if options.balance else None
    total = sum(map(len, clouds)) * (1 + len(classes.codes))  # which are read for each class
    with Progress(total, "drawing samples", enabled=progress) as bar:
        samples = draw_samples(labeled, len(classes.codes), options.count, options.seed, shares, progress=bar)
    base = options.base
    known = set() if base is None else set(base.codes.tolist())
    read = 0 if options.passes == 1 and base is None else len(known | set(classes.codes))
    of_context = len(options.context) * read
    must_fit(len(plan.names) + of_context, len(samples))
    features = Features(plan, *fitted(clouds, samples, plan, options), options.seed)
    values, counted = sample_features(clouds, samples, features, options, progress)
    timed = {"features": time.perf_counter() - started}
    limits = percentiles(values, plan, options)
    below = None if base is None else Below(base, clouds, samples, options, progress)
    xy = samples.take(lambda number: clouds[number].xyz[:, :2])
    priors = _priors(samples, len(classes.codes), options.prior_weight)
    heard = _Heard(samples, classes.codes, priors, below, options)
    ranked = alone = Ranked.of(values, options.threads)
    del values  # as large again
    if below is not None:
        ranked = ranked.beside(Ranked.of(below.columns, options.threads))
    chosen, validation = _validate(
        ranked,
        samples,
        xy,
        samples.take(lambda number: _groups(clouds[number], options)),
        classes.codes,
        plan,
        options,
        progress,
        heard,
    )
    started = time.perf_counter()
    passes = _Passes(labeled, samples, (alone, ranked), features, chosen, options, progress, below)
    passes.grow(*limits)
    left_out = passes.without_each_survey() if options.leave_one_survey_out else None
    timed["trees"] = time.perf_counter() - started
    info = {
        **labeled.described(options, map(samples.counts, range(len(classes.codes)))),
        "training": {
            "clouds": listed(clouds),
            "count": options.count,
            "seed": options.seed,
            "samples": len(samples),
            **labeled.training_notes(options),
            "max_samples": _share_drawn(options, samples, len(classes.codes)),
            "max_features": options.max_features,
            "min_samples_leaf": chosen["min_samples_leaf"],
            "max_depth": chosen["max_depth"],
            **passes.notes,
            **_unscored(heard, validation, xy, samples, labeled, options, _gap(plan, options)),
            **({} if below is None or options.target is not None else _held(below, classes.codes)),
            **_with_short(counted, passes.short + (0 if below is None else below.short)),
        },
        "priors": priors,
        **heard.of(chosen, validation, below),
        "densities": density_range(cloud.density for cloud in clouds),
        "voxel": options.voxel,
        "accuracy": {"cross_validation": validation, "leave_one_survey_out": left_out},
        "passes": passes.scores,
        "created_by": _versions(),
    }
    made = Model(tuple(passes.made), list(zip(classes.codes, classes.names, strict=True)), info, timed)
    return made if below is None else on_top(below, made)


def _with_short(counted: Mapping[str, Any], more: int) -> dict[str, Any]:
    """What was counted of the samples' features, with those of contexts whose neighbors lie too far away."""
    short = counted.get(SHORT, 0) + more
    return {**counted, **({SHORT: short} if short else {})}


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
    return {"unscored": why_unscored(heard.errors, xy, samples.label, named, options.block_size, gap)}


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


def _tree_options(
    options: TrainingOptions, drawn: float, max_depth: int | None, min_samples_leaf: int
) -> TreeOptions:
    return TreeOptions(max_depth, min_samples_leaf, drawn, options.max_features)


def _share_drawn(options: TrainingOptions, samples: Samples, classes: int) -> float:
    """The share of the samples that each tree draws."""
    if options.max_samples is not None:
        return options.max_samples
    return min(1.0, PER_TREE * classes / int(samples.weight.sum()))


def _gap(plan: FeaturePlan, options: TrainingOptions) -> float:
    """Meters between samples trained on and ground held out."""
    if options.gap is not None:
        return options.gap
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
    options: TrainingOptions,
    progress: bool,
    heard: _Heard,
) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """(chosen trees, depth, leaf size; the cross-validation for the manifest or None)."""
    counts, candidates = options.tree_counts(), options.candidates()
    as_given = {"trees": counts[-1], **candidates[0]}
    if options.folds == 0 and not options.searches:
        return as_given, None
    quick = options.folds is None and not options.searches
    if quick:
        counts = [max(1, math.ceil(counts[-1] * FOLD_TREES))]
    ways: list[tuple[str, int, npt.NDArray[np.int16] | None]] = [("blocks", options.folds or 5, None)]
    names, index = np.unique(group, return_inverse=True)
    if len(names) > 1 and (quick or options.groups):
        folds = min(options.folds or 5, len(names))
        ways.insert(0, ("groups" if options.groups else "surveys", folds, (index % folds).astype(np.int16)))
    asked = {"groups": options.groups} if options.groups else {}
    drawn = _share_drawn(options, samples, len(codes))
    for by, folds, fold in ways:
        heard.tables.clear()
        try:
            rows = crossval.search(
                ranked,
                samples.label,
                samples.weight,
                xy,
                codes,
                [_tree_options(options, drawn, **candidate) for candidate in candidates],
                counts,
                folds=folds,
                block_size=options.block_size,
                gap=_gap(plan, options),
                seed=options.seed,
                fold=fold,
                threads=options.threads,
                progress=progress,
                heard=heard,
            )
        except OptionError as error:  # too little ground, or a class in one place
            heard.errors.append(error)
            if not quick and by == "blocks":
                raise
            if options.groups and by == "groups":
                asked["instead"] = f"{error.what}: {error.found}"
            continue
        chosen = crossval.choose(rows)
        return as_given if quick else chosen, {
            "by": by,
            **asked,
            "folds": folds,
            "block_size": options.block_size,
            "gap": _gap(plan, options),
            "tried": rows,
            "chosen": chosen,
        }
    return as_given, None


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
        self.tables: dict[tuple[int, int], Sureness] = {}
        self.errors: list[OptionError] = []

    def __call__(
        self, candidate: int, trees: int, rows: npt.NDArray[np.int64], p: npt.NDArray[np.float64]
    ) -> None:
        """Rows of the samples, and their probabilities (rows, classes)."""
        codes, o = self.codes, self._options
        if self._below is not None and o.target is not None:
            return  # what the others truly are is not known
        if self._below is None:
            p = weighed(p, self._factors)
        else:
            before = self._below.base.codes.tolist()
            p = blended(self._below.own[rows], p, before, codes, self._below.trusted)
            codes = sorted({*before, *codes})
        true = np.asarray(self.codes)[self.samples.label[rows]]
        counted(p, codes, true, self._weight[rows], self.tables.setdefault((candidate, trees), Sureness()))

    def of(
        self, chosen: Mapping[str, Any], validation: Mapping[str, Any] | None, below: Below | None
    ) -> dict[str, Any]:
        """What a manifest says, where anything was heard."""
        if validation is None or not self.tables:
            return {}
        rows = validation["tried"]
        place = rows.index(validation["chosen"])
        found = list(self.tables.values())[place]
        passes = "" if self._options.passes == 1 else ", of the first pass"
        found.about = f"{validation['by']} held out, forests of {validation['chosen']['trees']} trees{passes}"
        return {"sureness": found.to_dict()}


class _Passes:
    """Growing one forest after the other, each reading what the one before says of ground it has not seen."""

    def __init__(
        self,
        labeled: Labeled,
        samples: Samples,
        ranked: tuple[Ranked, Ranked],
        features: Features,
        chosen: Mapping[str, Any],
        options: TrainingOptions,
        progress: bool,
        below: Below | None = None,
    ) -> None:
        self.below = below
        self.clouds, self.codes = labeled.clouds, labeled.classes.codes
        self.samples, self.features = samples, features
        self.alone, self.ranked = ranked  # the features, and all that the first pass reads
        self.chosen, self.options, self.progress = chosen, options, progress
        self.context = Context(tuple(options.context))
        drawn = _share_drawn(options, samples, len(self.codes))
        self.setting = _tree_options(options, drawn, chosen["max_depth"], chosen["min_samples_leaf"])
        self.made: list[FeatureForest] = []
        self.scores: list[dict[str, Any]] = []
        self.notes: dict[str, Any] = {}
        self.short = 0  #: samples whose neighbors lie farther away than the memory allowed to look
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

    def without_each_survey(self) -> dict[str, Any]:
        """Scores of each survey's samples by passes grown without that survey; OptionError where there is only one."""
        names = sorted(set(self.flights))
        if len(names) < 2:
            raise OptionError(
                "'leave_one_survey_out' needs clouds of at least two surveys", found=", ".join(names)
            )
        flight = np.array(self.flights)[self.samples.cloud]
        weight, trees, rows = self.samples.weight, self.chosen["trees"], []
        for name in names:
            mine = flight == name
            *_, ranked = self._ranked(weight * ~mine)
            total = np.zeros((np.count_nonzero(mine), len(self.codes)))
            with Progress(trees, f"growing without {name}", "trees", enabled=self.progress) as bar:
                judged = np.flatnonzero(mine)
                for _, _, shares in self._grown(ranked, weight * ~mine, trees, bar, score=judged):
                    total += shares
            best = total.argmax(axis=1)
            rows.append({"name": os.path.basename(name), **self._figures(mine, best)})
        means = {key: float(np.mean([row[key] for row in rows])) for key in ("overall_accuracy", "mean_f1")}
        return {"surveys": rows, **means}

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
        trees = max(1, math.ceil(self.chosen["trees"] * FOLD_TREES))
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
        plan = self.features.plan if below is None else wider(below.base.plan, self.features.plan)
        looks = Looks(plan, [self.context] * count)
        out = np.empty((len(self.samples), len(self.context.tokens) * classes[-1]), np.float32)
        what = f"context for pass {count + 1}"
        with Progress(len(self.samples), what, enabled=self.progress) as bar:
            for number, cloud in enumerate(self.clouds):
                at, rows = self.samples.of_cloud(number)
                if not len(at):
                    continue
                flight = self.flights[number]

                def compute(
                    places: npt.NDArray[np.int64],
                    seen: Seen,
                    again: bool,
                    at: npt.NDArray[np.int64] = at,
                    flight: str = flight,
                ) -> bool:
                    fold = self.folds.points(seen.xyz, flight)
                    passes = [
                        FoldForests(self.features, context, forests, fold, blend)
                        for context, forests, blend in zip(reads, held_out, blends, strict=True)
                    ]
                    shown = None if again else bar
                    request = PredictRequest(
                        seen.xyz, seen.dimensions, seen.rows, o.threads, o.memory_mb, shown
                    )
                    out[at[places]], beyond = sample_context(
                        request, [*first, *passes], self.context, classes, factors
                    )
                    return beyond

                self.short += work_on(cloud, rows, looks, compute, o.threads)
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
        count, weight = self.chosen["trees"], self.samples.weight
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
