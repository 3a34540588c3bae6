"""Training a forest: sample, compute features for the samples only, grow, score on ground held out."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import DimensionError, OptionError
from ..base.files import Output
from ..base.memory import free_memory
from ..base.progress import Progress
from ..features import FeaturePlan
from ..features.engine import fit_clouds
from ..features.registry import SHAPE_FEATURES
from ..features.return_features import SOURCES
from .auto_context import FoldForests, WeightedPass, sample_context
from .calibration import Calibration
from .context_features import OWN, Context
from .feature_forest import FeatureForest
from .fitted_features import CloudFeatures, Features
from .input_dimensions import OPTIONAL_DIMENSIONS, required_dimensions, take_dimensions
from .interface import PredictRequest, weigh
from .model import Model
from .random_forest import Forest, grow_forest
from .refinement import Blend, describe_refinement, trust
from .sampling import BLOCK, Folds, draw_samples, figures, split
from .training_clouds import TrainingCloud, label_classes
from .training_options import LEAST_PER_TREE, PER_TREE, TrainingOptions, feature_plan

#: Trees of a forest that judges a fold, as a share of the final one's.
FOLD_TREES = 0.25
#: Parts of the training ground held out in turn to train the passes after the first.
PASS_FOLDS = 5
#: In the counts: samples of tiles whose nearest neighbors lie beyond the halo of their features.
SHORT = "short_of_neighbors"

optional_inputs = {**{name: (name,) for name in OPTIONAL_DIMENSIONS}, "returns": SOURCES}


def outputs(options: TrainingOptions) -> list[Output]:
    """The model alone."""
    return []


def own_options(given: Any) -> None:
    """A forest has none beside ``TrainingOptions``."""


def inputs(options: TrainingOptions) -> tuple[str, ...]:
    """Dimensions used as features, by the forest or by the model it is built on."""
    own = feature_plan(options).dimensions
    return (
        own if options.base is None else tuple(dict.fromkeys([*own, *options.base.plan.dimensions]))
    )


def train(clouds: Sequence[TrainingCloud], options: TrainingOptions, progress: bool) -> Model:
    """See :func:`pdal_stages.classifier.train`."""
    return _ForestTraining(clouds, options, progress).model()


class _ForestTraining:
    """Samples of labeled clouds and what is computed of them."""

    def __init__(
        self, clouds: Sequence[TrainingCloud], options: TrainingOptions, progress: bool
    ) -> None:
        self.clouds, self.options, self.base = clouds, options, options.base
        self.progress = partial(Progress, enabled=progress)
        if options.groups and required_dimensions((options.groups,)) != (options.groups,):
            raise OptionError(
                "'groups' must name a dimension other than coordinates and what is made of them",
                found=options.groups,
            )
        for cloud in clouds if options.groups else ():  # before any work: it may be missing
            take_dimensions(
                (options.groups,), cloud.dimensions, len(cloud), np.zeros(0, np.int64), cloud.name
            )
        self.labeled = label_classes(clouds, options, progress)
        self.codes = self.labeled.classes.codes
        self.surveys = [cloud.survey for cloud in clouds]
        shares = [f"{cloud.survey} {cloud.copy}" for cloud in clouds]
        total = sum(map(len, clouds)) * (1 + len(self.codes))  # which are read for each class
        with self.progress(total, "drawing samples") as bar:
            self.samples = draw_samples(
                self.labeled,
                len(self.codes),
                options.count,
                options.seed,
                shares,
                random_order=options.sampling == "random",
                progress=bar,
            )
        weight = self.samples.weight
        drawn = np.bincount(self.samples.label, weight, len(self.codes))
        frequent = np.array(self.samples.available) / drawn
        #: How many points each sample stands for.
        self.stands_for = weight * frequent[self.samples.label]
        factors = frequent**options.prior_weight
        self.factors = factors / factors.max() if options.prior_weight else None
        self.short = (
            0  # samples of tiles whose nearest neighbors lie beyond the halo of their features
        )
        plan = feature_plan(options)
        used = [clouds[number].xyz for number in np.unique(self.samples.cloud).tolist()]
        bins, threshold = fit_clouds(used, plan, seed=options.seed, threads=options.threads)
        if options.copt_threshold is not None:
            threshold = options.copt_threshold
        self.features = Features(plan, bins, threshold, options.seed)
        self.own = self._features_of_samples()
        if options.scaling == "percentiles":
            limit_to_percentiles(self.own, plan)
        context = Context(tuple(options.context))
        if options.passes > 1 or self.base is not None:
            codes = self.codes if self.base is None else self.base.codes.tolist()
            context.check_segments(codes, inputs(options))
        self.reads: list[Context | None] = [None, *[context] * (options.passes - 1)]
        self.blends = self._blends()
        #: What the first pass reads of the samples.
        self.first = self.own
        if self.base is not None:  # which has not seen their labels, so no ground need be held out
            self.reads[0] = context if options.passes == 1 else Context((OWN,))
            self.first = _beside(self.own, self._around(0))
        self.xy = self.samples.take(lambda number: clouds[number].xyz[:, :2])
        share = options.max_samples
        if share is None:
            each = int(weight.sum()) / len(self.codes)
            share = min(1.0, min(max(each / 3, LEAST_PER_TREE), PER_TREE) / each)
        self.setting: dict[str, Any] = {
            "seed": options.seed,
            "min_samples_leaf": options.min_samples_leaf,
            "max_samples": share,
            "max_features": options.max_features,
            "max_depth": options.max_depth,
            "vote": options.vote,
            "threads": options.threads,
        }
        self.fold_trees = max(1, math.ceil(options.trees * FOLD_TREES))

    def _features_of_samples(self) -> npt.NDArray[np.float32]:
        """(samples, features), filled cloud by cloud."""
        o, samples, names = self.options, self.samples, self.features.plan.names
        if (needed := 4 * len(samples) * len(names)) > free_memory():
            raise OptionError(
                f"{len(samples):,} samples of {len(names)} features do not fit into the free memory",
                found=f"{needed / 2**30:.1f} GiB needed",
                cure="Lower 'count', or use fewer neighborhoods or features",
            )
        values = np.empty((len(samples), len(names)), np.float32, order="F")
        with self.progress(len(samples), "features of the samples") as bar:
            for number, cloud in enumerate(self.clouds):
                at, rows = samples.of_cloud(number)
                if not len(at):
                    continue
                request = PredictRequest(cloud.xyz, cloud.dimensions, rows, o.threads, o.memory_mb)
                for block in CloudFeatures(self.features, request).blocks(rows, bar):
                    values[at[np.searchsorted(rows, block.rows)]] = block.values
                if cloud.inside is not None:
                    self.short += max(request.report.beyond_halo.values(), default=0)
        bad = ~np.isfinite(values).all(axis=0)
        if bad.any():
            raise DimensionError(
                f"the feature {names[int(bad.argmax())]} is not finite for some samples"
            )
        return values

    def _blends(self) -> Sequence[Blend | None]:
        """What each pass on top of a base makes of the one before."""
        o = self.options
        out: list[Blend] = []
        if self.base is None:
            return [None] * o.passes
        before, trusted = (
            self.base.codes.tolist(),
            trust(int(np.bincount(self.samples.label).min())),
        )
        for _ in range(o.passes):
            out.append(Blend(tuple(before), tuple(self.codes), trusted, o.target))
            before = out[-1].codes
        if (
            o.passes > 1 and self.factors is not None
        ):  # a few labels say nothing of how frequent a class is
            out[-1] = replace(out[-1], factors=tuple(self.factors.tolist()))
        return out

    def model(self) -> Model:
        """Score, grow, and put together."""
        o, base = self.options, self.base
        validation, notes = self._validate()
        forests, importances = self._passes()
        priors = (
            None
            if self.factors is None
            else {"weight": o.prior_weight, "factors": self.factors.tolist()}
        )
        training = {
            "count": o.count,
            "seed": o.seed,
            "samples": len(self.samples),
            "max_samples": self.setting["max_samples"],
            "max_features": o.max_features,
            "min_samples_leaf": o.min_samples_leaf,
            "max_depth": o.max_depth,
            "vote": o.vote,
            "sampling": o.sampling,
            "scaling": o.scaling,
            **notes,
            **self._held_by_base(),
            **({SHORT: self.short} if self.short else {}),
        }
        counts = map(self.samples.counts, range(len(self.codes)))
        packages = ("numpy", "scikit-learn", "numba")
        info = self.labeled.describe(
            o, counts, training, importances, packages, validation, priors=priors
        )
        if validation is not None and self.calibration.right:
            info["sureness"] = self.calibration.to_dict()
        names = dict(zip(self.codes, self.labeled.classes.names, strict=True))
        if base is None:
            return Model(tuple(forests), list(names.items()), info)
        codes = self._codes_after(o.passes - 1)
        names |= dict(base.classes)
        classes = [(code, names[code]) for code in codes]
        return Model(
            (*base.passes, *forests), classes, describe_refinement(base, info, names, codes)
        )

    def _codes_after(self, number: int) -> Sequence[int]:
        """The classes of a pass."""
        blend = self.blends[number]
        return self.codes if blend is None else blend.codes

    def _grow(
        self,
        values: npt.NDArray[np.float32],
        weight: npt.NDArray[np.int64],
        trees: int | Sequence[int],
        bar: Progress,
    ) -> tuple[Forest, npt.NDArray[np.float64]]:
        return grow_forest(values, self.samples.label, weight, trees, progress=bar, **self.setting)

    def _without_each(
        self,
        values: npt.NDArray[np.float32],
        fold: npt.NDArray[np.int16],
        what: str,
        gap: float = 0.0,
        needed: int = 2,
    ) -> Iterator[tuple[npt.NDArray[np.int64], Forest]]:
        """For each fold the samples held out, and a forest grown on those that are farther from them than `gap` meters.

        OptionError where so few samples are left that fewer classes have any than are `needed`.
        """
        label, weight, count = self.samples.label, self.samples.weight, int(fold.max()) + 1
        with self.progress(count * self.fold_trees, what, "trees") as bar:
            for number in range(count):
                train, rows = split(self.xy, fold, number, gap)
                there = np.bincount(label[train], minlength=len(self.codes)) > 0
                if np.count_nonzero(there) < needed:
                    raise OptionError(
                        f"without fold {number + 1} and its gap of {gap:g} m a class has no samples left",
                        found=f"class {self.codes[int(np.argmin(there))]}",
                        cure="Give more training data, or set passes to 1",
                    )
                yield rows, self._grow(values, weight * train, self.fold_trees, bar)[0]

    # ---- score ---------------------------------------------------------------------------------------------

    def _validate(self) -> tuple[dict[str, Any] | None, dict[str, str]]:
        """The cross-validation for the manifest, over groups or surveys where there are several, else over blocks; and
        why there is none, where one was wanted."""
        o, samples, codes = self.options, self.samples, self.codes
        if o.folds == 0:
            return None, {}
        folds, gap = (
            o.folds or 5,
            max((one.reach or 0.0 for one in self.features.plan.neighborhoods), default=0.0),
        )
        group = samples.take(self._groups)
        names, index = np.unique(group, return_inverse=True)
        asked = {"groups": o.groups} if o.groups else {}
        for by in (["groups" if o.groups else "surveys"] if len(names) > 1 else []) + ["blocks"]:
            self.calibration = Calibration(
                about=f"{by} held out, forests of {self.fold_trees} trees"
            )
            here = (
                0.0 if by == "surveys" else gap
            )  # which do not see each other, whatever their coordinates
            try:
                if by == "blocks":
                    blocks = Folds.of_blocks(self.xy, samples.label, samples.weight, folds, BLOCK)
                    fold = blocks.points(self.xy)
                else:
                    fold = (index % folds).astype(np.int16)
                matrix = np.zeros((len(codes), len(codes)), np.int64)
                each = self._without_each(self.first, fold, "cross-validation", here, len(codes))
                for rows, forest in each:
                    p = forest.predict_proba(self.first[rows])
                    np.add.at(matrix, (samples.label[rows], p.argmax(axis=1)), samples.weight[rows])
                    self._count_sure(rows, p)
            except OptionError as error:  # too little ground, or a class in one place
                reason = f"{error.what}: {error.found}"
                if by == "groups":
                    asked["instead"] = reason
                continue
            score = {"trees": self.fold_trees, **figures(matrix, codes)}
            more = {"folds": int(fold.max()) + 1, "block_size": BLOCK, "gap": here, "chosen": score}
            return {"by": by, **asked, **more}, {}
        return None, {"unscored": self._unscored(reason, gap)}

    def _groups(self, number: int) -> npt.NDArray[Any]:
        """What a cloud's points are held out with: their `groups`, or all of them with the survey."""
        cloud, name = self.clouds[number], self.options.groups
        if not name:
            return np.broadcast_to(np.array(cloud.survey), len(cloud))
        return take_dimensions((name,), cloud.dimensions, len(cloud), where=cloud.name)[name]

    def _count_sure(self, rows: npt.NDArray[np.int64], p: npt.NDArray[np.float64]) -> None:
        """Count in how far samples that were held out were right where they were sure, as the points lie."""
        blend = self.blends[0]
        if blend is None:
            p = weigh(p, self.factors)
        elif self.options.target is not None:
            return  # what the others truly are is not known
        else:
            p = replace(blend, factors=None)(self._said_by_base(rows), p)
        given = np.asarray(self._codes_after(0))[p.argmax(axis=1)]
        true = np.asarray(self.codes)[self.samples.label[rows]]
        self.calibration.add(given, true, p.max(axis=1), self.stands_for[rows])

    def _unscored(self, reason: str, gap: float) -> str:
        """Why there is no score, and which class to label next, and where not: that of the fewest blocks of ground."""
        cell = np.floor(self.xy / BLOCK)
        mine = [self.samples.label == place for place in range(len(self.codes))]
        least = int(np.argmin([len(np.unique(cell[one], axis=0)) for one in mine]))
        x, y = (self.xy[mine[least]].min(axis=0) + self.xy[mine[least]].max(axis=0)) / 2
        return (
            f"there is no score on ground held out: {reason}. Label next, at least {BLOCK + gap:.0f} m away: "
            f"{self.codes[least]} {self.labeled.classes.names[least]}, which lies around {x:.0f}, {y:.0f}"
        )

    # ---- passes --------------------------------------------------------------------------------------------

    def _passes(self) -> tuple[list[FeatureForest], list[list[float]]]:
        """One forest after the other, each reading what the one before says of ground it has not seen."""
        o, samples = self.options, self.samples
        made, importances = [], []
        held_out: list[list[FeatureForest]] = []
        values, folds = self.first, None
        if o.passes > 1:
            folds = Folds.of_ground(
                self.xy, samples.label, samples.weight, self.surveys, PASS_FOLDS
            )
            fold = samples.take(
                lambda number: folds.points(self.clouds[number].xyz, self.surveys[number])
            )
        for number in range(o.passes):
            if number:
                # Ground beside a fold is not left out as for the score: the forests miss the fold's samples already,
                # and the next pass should see probabilities as good as those it will see when the model is used.
                each = self._without_each(values, fold, f"pass {number} without each fold")
                held_out.append([self._read_by(number - 1, forest) for _, forest in each])
                values = _beside(self.own, self._around(number, held_out, folds))
            grid: Sequence[int] = o.trees_grid or (o.trees,)
            with self.progress(grid[-1], f"growing pass {number + 1}", "trees") as bar:
                forest, shares = self._grow(values, samples.weight, grid, bar)
            made.append(self._read_by(number, forest))
            importances.append(shares.tolist())
        return made, importances

    def _read_by(self, number: int, forest: Forest) -> FeatureForest:
        """A forest with what a pass reads."""
        return FeatureForest(self.features, forest, self.reads[number], self.blends[number])

    def _around(
        self,
        number: int,
        held_out: Sequence[Sequence[FeatureForest]] = (),
        folds: Folds | None = None,
    ) -> npt.NDArray[np.float32]:
        """(samples, columns): what a pass reads of those before, a base's and forests that have not seen the samples."""
        o, context = self.options, self.reads[number]
        assert context is not None
        base = [] if self.base is None else self.base.weighted_passes
        codes = self._codes_after(number - 1) if number else base[-1].codes
        out = np.empty((len(self.samples), len(context.names(codes))), np.float32)
        with self.progress(
            len(out), f"context for pass {number + 1}" if number else "what the base says"
        ) as bar:
            for place, cloud in enumerate(self.clouds):
                at, rows = self.samples.of_cloud(place)
                if not len(at):
                    continue
                mine = []
                if folds is not None:
                    fold = folds.points(cloud.xyz, self.surveys[place])
                    each = (FoldForests(forests, fold) for forests in held_out)
                    mine = [WeightedPass(one, self._codes_after(k)) for k, one in enumerate(each)]
                request = PredictRequest(
                    cloud.xyz, cloud.dimensions, rows, o.threads, o.memory_mb, bar
                )
                out[at] = sample_context([*base, *mine], request, context)
        return out

    # ---- on top of a base ----------------------------------------------------------------------------------

    def _said_by_base(self, rows: Any = slice(None)) -> npt.NDArray[np.float64]:
        """(m, classes) the base's probabilities of samples themselves."""
        context = self.reads[0]
        assert context is not None
        return context.own(self.first[rows, self.own.shape[1] :], len(self.base.classes))

    def _held_by_base(self) -> dict[str, Any]:
        """Labeled classes new to the base: [different samples, of these what it calls a class that the labels lack].

        Such points stay what the base calls them.
        """
        if self.base is None or self.options.target is not None:
            return {}
        said, out = self.base.codes[self._said_by_base().argmax(axis=1)], {}
        for place, code in enumerate(self.codes):
            mine = self.samples.label == place
            held = int(np.count_nonzero(~np.isin(said[mine], self.codes)))
            if code not in self.base.codes and held:
                out[str(code)] = [int(np.count_nonzero(mine)), held]
        return {"held_by_base": out} if out else {}


def limit_to_percentiles(values: npt.NDArray[np.float32], plan: FeaturePlan) -> None:
    """Limit features (n, features) of samples to their 1st and 99th percentile, in place.

    The lower limit is 0 where the minimum is 0; shape distributions are not limited [B16 3.3, W18 3.2]. A linear map
    to [0, 1] would change nothing for trees but the place of rounding. Thresholds lie between the limits, so a value
    beyond one takes the same branch as the limit itself, and points to classify need none of this.
    """
    bins = {part.at[name] for part in plan.layout for name in part.at if name in SHAPE_FEATURES}
    measures = [column for column in range(len(plan.names)) if column not in bins]
    low, high = np.percentile(values[:, measures], [1, 99], axis=0).astype(np.float32)
    low[values[:, measures].min(axis=0) == 0] = 0
    values[:, measures] = np.clip(values[:, measures], low, high)


def _beside(
    values: npt.NDArray[np.float32], more: npt.NDArray[np.float32]
) -> npt.NDArray[np.float32]:
    return np.asfortranarray(np.concatenate([values, more], axis=1))
