"""Training a forest: samples, their features, growing, and a score on ground held out."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import DimensionError, OptionError
from ..base.json_types import JsonObject
from ..base.memory import free_memory
from ..base.progress import Progress
from ..features import FeaturePlan
from ..features.engine import fit_clouds
from ..features.registry import SHAPE_FEATURES
from ..features.return_features import SOURCES
from .auto_context import FoldForests, WeightedPass, sample_context
from .calibration import Calibration
from .context_features import Context
from .feature_forest import Blend, CloudFeatures, FeatureForest, Features
from .input_dimensions import OPTIONAL_DIMENSIONS
from .interface import PredictRequest, weigh
from .learner import Learner
from .model import Model
from .model_info import ClassInfo, ModelInfo, PassScores, Priors, SampleCounts
from .sampling import BLOCK_M, Folds, Samples, draw_samples, figures, split
from .training_clouds import TrainingCloud, label_classes
from .training_options import LEAST_PER_TREE, PER_TREE, TrainingOptions, feature_plan
from .training_percentiles import percentiles_by_class

#: Trees of a forest that judges a fold, as a share of the final one's: five folds then cost about
#: as much as it (not tuned).
FOLD_TREES = 0.25
#: Parts of the training ground held out in turn to train the passes after the first, where they are
#: blocks; of whole surveys there are up to twice as many (not tuned).
PASS_FOLDS = 5
#: Labeled points of the rarest class with which a forest counts as much as its base (not
#: tuned).
EVEN = 30
#: Options of growing that the model file stores.
_STORED = (
    *("max_samples", "max_features", "min_samples_leaf", "max_depth"),
    *("vote", "sampling", "scaling"),
)


@dataclass(frozen=True)
class FeatureTrainer:
    """Trains a kind that learns on features; see :class:`.interface.Trainer`."""

    name: str  #: of the kind
    learner: type[Learner]

    @property
    def optional_inputs(self) -> Mapping[str, Sequence[str]]:
        """Dimensions used where the points have them, each with those that it is computed from."""
        return {**{name: (name,) for name in OPTIONAL_DIMENSIONS}, "returns": SOURCES}

    def own_options(self, options: Any) -> None:
        """Return None: there are no options beside ``TrainingOptions``."""
        if options:
            raise OptionError("'alsnet' is for the algorithm of that name", found=self.name)

    def inputs(self, options: TrainingOptions) -> tuple[str, ...]:
        """Return dimensions used as features, by the forest or the model it is built on."""
        dimensions = feature_plan(options).dimensions
        if options.base is None:
            return dimensions
        return tuple(dict.fromkeys([*dimensions, *options.base.plan.dimensions]))

    def train(
        self, clouds: Sequence[TrainingCloud], options: TrainingOptions, progress: bool
    ) -> Model:
        """Train all passes, see :func:`pdal_stages.classifier.train`."""
        return ForestTraining(clouds, options, progress, self).model()


def fold_trees(trees: int) -> int:
    """Return the trees of a forest that judges a fold, of those of the final one."""
    return max(1, math.ceil(trees * FOLD_TREES))


class ForestTraining:
    """Samples of labeled clouds and what is computed of them."""

    def __init__(
        self,
        clouds: Sequence[TrainingCloud],
        options: TrainingOptions,
        progress: bool,
        trainer: FeatureTrainer,
    ) -> None:
        """Draw samples, and compute their features."""
        self.trainer = trainer
        self.clouds, self.options, self.base = clouds, options, options.base
        self.progress = partial(Progress, enabled=progress)
        self.labeled = label_classes(clouds, options, progress)
        self.codes = self.labeled.classes.codes
        self.surveys = [cloud.survey for cloud in clouds]
        self.samples = self._draw_samples()
        weight = self.samples.weight
        drawn = np.bincount(self.samples.label, weight, len(self.codes))
        frequent = np.array(self.samples.available) / drawn
        #: How many points each sample stands for.
        self.stands_for = weight * frequent[self.samples.label]
        factors = frequent**options.prior_weight
        self.factors = factors / factors.max() if options.prior_weight else None
        self.features = self._fit_features()
        self.values = self._features_of_samples()
        if options.scaling == "percentiles":
            limit_to_percentiles(self.values, self.features.plan)
        self.context = Context(tuple(options.context))
        known = self.codes if self.base is None else self.base.codes.tolist()
        if options.passes > 1 or self.base is not None:
            self.context.check_codes(known, trainer.inputs(options))
        self.blend: Blend | None = None
        #: What the first pass reads of the samples.
        self.first = self.values
        if self.base is not None:  # it has not seen the labels, so no ground need be held out
            fewest = int(np.bincount(self.samples.label).min())
            self.blend = Blend(tuple(known), tuple(self.codes), fewest / (fewest + EVEN))
            self.first = _join_columns(self.values, self._context_of_samples())
        self.xy = self.samples.take(lambda number: clouds[number].xyz[:, :2])
        self.growth = self._growth()
        self.fold_trees = fold_trees(options.trees)

    def _draw_samples(self) -> Samples:
        """Draw as many samples of each class."""
        options = self.options
        groups = [f"{cloud.survey} {cloud.copy}" for cloud in self.clouds]
        # All points are read once, and once more for each class.
        total = sum(map(len, self.clouds)) * (1 + len(self.codes))
        with self.progress(total, "drawing samples") as bar:
            return draw_samples(
                self.labeled,
                len(self.codes),
                options.count,
                options.seed,
                groups,
                fill_up=options.fill_up,
                random_order=options.sampling == "random",
                progress=bar,
            )

    def _fit_features(self) -> Features:
        """Fit what the features need to the clouds that have samples."""
        options, plan = self.options, feature_plan(self.options)
        used = [self.clouds[number].xyz for number in np.unique(self.samples.cloud).tolist()]
        bins, threshold = fit_clouds(
            used,
            plan,
            copt_threshold=options.copt_threshold,
            seed=options.seed,
            threads=options.threads,
        )
        return Features(plan, bins, threshold, options.seed)

    def _growth(self) -> TrainingOptions:
        """Return the options; by default a tree draws a third of the samples, in bounds."""
        share = self.options.max_samples
        if share is None:
            per_class = int(self.samples.weight.sum()) / len(self.codes)
            share = min(max(per_class / 3, LEAST_PER_TREE), PER_TREE) / per_class
        return replace(self.options, max_samples=min(1.0, share))

    def _features_of_samples(self) -> npt.NDArray[np.float32]:
        """Compute the features (samples, features) cloud by cloud."""
        o, samples, names = self.options, self.samples, self.features.plan.names
        if (needed := 4 * len(samples) * len(names)) > free_memory():
            raise OptionError(
                f"{len(samples):,} samples of {len(names)} features do not fit into the free "
                "memory",
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
        bad = ~np.isfinite(values).all(axis=0)
        if bad.any():
            raise DimensionError(
                f"the feature {names[int(bad.argmax())]} is not finite for a sample"
            )
        return values

    def model(self) -> Model:
        """Score, grow all passes, and return the model."""
        o, base = self.options, self.base
        validation, notes = self._validate()
        forests, importances = self._passes()
        priors: Priors | None = (
            None
            if self.factors is None
            else {"weight": o.prior_weight, "factors": self.factors.tolist()}
        )
        training = {
            "count": o.count,
            "seed": o.seed,
            "samples": len(self.samples),
            **{name: getattr(self.growth, name) for name in _STORED},
            **notes,
            **self._held_by_base(),
        }
        counts = map(self.samples.counts, range(len(self.codes)))
        packages = ("numpy", "scikit-learn", "numba")
        info = self.labeled.describe(
            o, counts, training, importances, packages, validation, priors=priors
        )
        if validation is not None and self.calibration.right:
            info["sureness"] = self.calibration.to_dict()
        columns = self.features.plan.names
        ranges = percentiles_by_class(self.values, self.samples.label, columns, self.codes)
        if ranges is not None:
            info["passes"][0]["percentiles"] = ranges
        names = dict(zip(self.codes, self.labeled.classes.names, strict=True))
        if base is None:
            return Model(tuple(forests), list(names.items()), info)
        names |= dict(base.classes)
        classes = [(code, names[code]) for code in sorted(names)]
        return Model(
            (*base.passes, *forests), classes, describe_refinement(base, info, names, sorted(names))
        )

    def _grow(
        self,
        values: npt.NDArray[np.float32],
        weight: npt.NDArray[np.int64],
        trees: int | Sequence[int],
        bar: Progress,
    ) -> tuple[Learner, npt.NDArray[np.float64] | None]:
        """Grow a forest on the samples, and return its importances."""
        label, growth = self.samples.label, self.growth
        return self.trainer.learner.fit(values, label, weight, trees, growth, bar)

    def _without_each(
        self,
        values: npt.NDArray[np.float32],
        fold: npt.NDArray[np.int16],
        what: str,
        gap: float = 0.0,
        needed: int = 2,
    ) -> Iterator[tuple[npt.NDArray[np.int64], Learner]]:
        """Yield for each fold the samples held out, and a forest grown without them.

        Samples within `gap` meters of the fold are left out as well. OptionError where fewer than
        `needed` classes have samples left.
        """
        label, weight, count = self.samples.label, self.samples.weight, int(fold.max()) + 1
        with self.progress(count * self.fold_trees, what, "trees") as bar:
            for number in range(count):
                train, rows = split(self.xy, fold, number, gap)
                there = np.bincount(label[train], minlength=len(self.codes)) > 0
                if np.count_nonzero(there) < needed:
                    raise OptionError(
                        f"without fold {number + 1} and its gap of {gap:g} m a class has no "
                        "samples left",
                        found=f"class {self.codes[int(np.argmin(there))]}",
                        cure="Give more training data, or set passes to 1",
                    )
                yield rows, self._grow(values, weight * train, self.fold_trees, bar)[0]

    def _validate(self) -> tuple[JsonObject | None, dict[str, str]]:
        """Hold out surveys, or blocks of one survey: return the scores, or why there are none."""
        o, samples, codes = self.options, self.samples, self.codes
        if o.folds == 0:
            return None, {}
        reaches = (each.reach or 0.0 for each in self.features.plan.neighborhoods)
        gap = max(reaches, default=0.0)
        names, index = np.unique(np.array(self.surveys)[samples.cloud], return_inverse=True)
        for by in ["surveys"] * (len(names) > 1) + ["blocks"]:
            about = f"{by} held out, forests of {self.fold_trees} trees"
            self.calibration = Calibration(about=about)
            # Surveys do not see each other, whatever their coordinates.
            here = 0.0 if by == "surveys" else gap
            try:
                fold = (index % o.folds).astype(np.int16)
                if by == "blocks":
                    label, weight = samples.label, samples.weight
                    blocks = Folds.of_blocks(self.xy, label, weight, o.folds, BLOCK_M)
                    fold = blocks.points(self.xy)
                matrix = np.zeros((len(codes), len(codes)), np.int64)
                each = self._without_each(self.first, fold, "cross-validation", here, len(codes))
                for rows, forest in each:
                    p = forest.predict_proba(self.first[rows])
                    np.add.at(matrix, (samples.label[rows], p.argmax(axis=1)), samples.weight[rows])
                    self._calibrate(rows, p)
            except OptionError as error:  # too little ground, or a class in one place
                reason = f"{error.what}: {error.found}"
                continue
            score = {"trees": self.fold_trees, **figures(matrix, codes)}
            cut = {"folds": int(fold.max()) + 1, "block_size": BLOCK_M, "gap": here}
            return {"by": by, **cut, "chosen": score}, {}
        why = f"there is no score on ground held out: {reason}. Label in more places"
        return None, {"unscored": why}

    def _calibrate(self, rows: npt.NDArray[np.int64], p: npt.NDArray[np.float64]) -> None:
        """Count right and wrong samples that were held out, by reliability."""
        codes: Sequence[int] = self.codes
        if self.blend is None:
            p = weigh(p, self.factors)
        else:
            codes, p = self.blend.codes, self.blend(self._base_probabilities(rows), p)
        predicted = np.asarray(codes)[p.argmax(axis=1)]
        true = np.asarray(self.codes)[self.samples.label[rows]]
        self.calibration.add(predicted, true, p.max(axis=1), self.stands_for[rows])

    def _passes(self) -> tuple[list[FeatureForest], list[list[float] | None]]:
        """Grow one forest after the other; each reads the one before on ground it has not seen."""
        o, samples = self.options, self.samples
        forests, importances = [], []
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
                # Ground beside a fold is not left out as for the score: the forests miss the fold's
                # samples already, and the next pass should see probabilities as good as those it
                # will see when the model is used.
                each = self._without_each(values, fold, f"pass {number} without each fold")
                held_out.append([self._read_by(number - 1, forest) for _, forest in each])
                values = _join_columns(self.values, self._context_of_samples(held_out, folds))
            grid: Sequence[int] = o.trees_grid or (o.trees,)
            with self.progress(grid[-1], f"growing pass {number + 1}", "trees") as bar:
                trees = grid[0] if len(grid) == 1 else grid
                forest, shares = self._grow(values, samples.weight, trees, bar)
            forests.append(self._read_by(number, forest))
            importances.append(None if shares is None else shares.tolist())
        return forests, importances

    def _read_by(self, number: int, forest: Learner) -> FeatureForest:
        """Return a forest with what a pass reads."""
        context = None if number == 0 and self.base is None else self.context
        return FeatureForest(self.features, forest, context, self.blend, self.trainer.name)

    def _context_of_samples(
        self, held_out: Sequence[Sequence[FeatureForest]] = (), folds: Folds | None = None
    ) -> npt.NDArray[np.float32]:
        """Return the context (samples, columns) that a pass reads of those before.

        The passes before are those of the base, or forests that have not seen the samples.
        """
        o, base, context = self.options, self.base, self.context
        codes = self.codes if base is None else base.codes
        passes: list[WeightedPass] = [] if base is None else base.weighted_passes
        out = np.empty((len(self.samples), len(context.names(codes))), np.float32)
        what = f"context for pass {len(held_out) + 1}" if base is None else "context by the base"
        with self.progress(len(out), what) as bar:
            for place, cloud in enumerate(self.clouds):
                at, rows = self.samples.of_cloud(place)
                if not len(at):
                    continue
                if folds is not None:
                    fold = folds.points(cloud.xyz, self.surveys[place])
                    each = (FoldForests(forests, fold) for forests in held_out)
                    passes = [WeightedPass(forests, self.codes) for forests in each]
                request = PredictRequest(
                    cloud.xyz, cloud.dimensions, rows, o.threads, o.memory_mb, bar
                )
                out[at] = sample_context(passes, request, context)
        return out

    def _base_probabilities(self, rows: Any = slice(None)) -> npt.NDArray[np.float64]:
        """Return the probabilities (m, classes) of the base at samples."""
        columns = self.first[rows, self.values.shape[1] :]
        return self.context.own_probabilities(columns, len(self.base.classes))

    def _held_by_base(self) -> JsonObject:
        """Return by new class the samples, and those that the base calls a class without labels.

        Points of classes without labels keep the class of the base.
        """
        if self.base is None:
            return {}
        by_base, out = self.base.codes[self._base_probabilities().argmax(axis=1)], {}
        for place, code in enumerate(self.codes):
            rows = self.samples.label == place
            held = int(np.count_nonzero(~np.isin(by_base[rows], self.codes)))
            if code not in self.base.codes and held:
                out[str(code)] = [int(np.count_nonzero(rows)), held]
        return {"held_by_base": out} if out else {}


def limit_to_percentiles(values: npt.NDArray[np.float32], plan: FeaturePlan) -> None:
    """Limit features (n, features) of samples to their 1st and 99th percentile, in place.

    The lower limit is 0 where the minimum is 0; shape distributions are not limited [B16 3.3, W18
    3.2]. A linear map to [0, 1] would change nothing for trees but the place of rounding.
    Thresholds lie between the limits, so a value beyond one takes the same branch as the limit
    itself, and points to classify need none of this.
    """
    bins = {part.at[name] for part in plan.layout for name in part.at if name in SHAPE_FEATURES}
    measures = [column for column in range(len(plan.names)) if column not in bins]
    low, high = np.percentile(values[:, measures], [1, 99], axis=0).astype(np.float32)
    low[values[:, measures].min(axis=0) == 0] = 0
    values[:, measures] = np.clip(values[:, measures], low, high)


def _join_columns(
    values: npt.NDArray[np.float32], more: npt.NDArray[np.float32]
) -> npt.NDArray[np.float32]:
    """Return both side by side, in Fortran order."""
    return np.asfortranarray(np.concatenate([values, more], axis=1))


def describe_refinement(
    base: Model, info: ModelInfo, names: Mapping[int, str], codes: Sequence[int]
) -> ModelInfo:
    """Return the manifest's entries for a model that is a base's passes and a forest on top.

    Parameters
    ----------
    base : Model
    info : mapping
        The entries that training of the forest on top gives alone.
    names : mapping of int to str
        Name of each class.
    codes : sequence of int
        Classes of the last pass.
    """
    none = SampleCounts(available=0, samples=0, duplicates=0)
    known: dict[int, ClassInfo] = {each["code"]: {**each, **none} for each in base.info["classes"]}
    known |= {each["code"]: each for each in info["classes"]}
    classes: list[ClassInfo] = [
        {**known[code], "code": code, "name": names[code]} for code in codes
    ]
    scores: list[PassScores] = [
        {**entry, "codes": own_codes}
        for own_codes, entry in zip(base.codes_of, base.info["passes"], strict=True)
    ]
    if base.factors is not None:
        scores[-1]["factors"] = base.factors.tolist()
    both = info["densities"], base.info["densities"]
    lines = {*info.get("lines", ()), *base.info.get("lines", ())}
    low, high = min(each["low"] for each in both), max(each["high"] for each in both)
    return {
        **info,
        **({"lines": sorted(lines)} if lines else {}),
        "strategy": "multiclass",
        "target": None,
        "background": None,
        "classes": classes,
        "priors": None,
        "densities": {"low": low, "high": high},
        "preparation": base.preparation,
        "algorithms": base.info["algorithms"],
        "passes": [*scores, *info["passes"]],
    }
