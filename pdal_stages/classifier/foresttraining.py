"""Training a forest: sample, compute features for the samples only, grow, score on ground held out."""

from __future__ import annotations

import math
import platform
import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import DimensionError, OptionError
from ..base.memory import free_memory
from ..base.outputs import Output
from ..base.progress import Progress
from ..base.version import __version__
from ..features.engine import fit_clouds
from ..features.returns import SOURCES
from .algorithms import PredictRequest
from .clouds import TrainingCloud, densities, label_classes, listed
from .context import Context
from .dimensions import WHERE_THERE, gather, required, with_returns
from .featureforest import FeatureForest, Features
from .forest import Forest, TreeOptions, grow_forest
from .holdout import BLOCK, FoldForests, Folds, figures, sample_context, split
from .model import Model
from .passes import weighed
from .refinement import Below, Blend, blended, held_by_base, on_top
from .sampling import draw_samples
from .sureness import Sureness, counted
from .trainoptions import PER_TREE, TrainingOptions, feature_plan

#: Trees of a forest that judges a fold, as a share of the final one's.
FOLD_TREES = 0.25
#: In the counts: samples of tiles whose nearest neighbors lie beyond the halo of their features.
SHORT = "short_of_neighbors"

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
    return _ForestTraining(clouds, options, progress).model()


class _ForestTraining:
    """Samples of labeled clouds and what is computed of them."""

    def __init__(self, clouds: Sequence[TrainingCloud], options: TrainingOptions, progress: bool) -> None:
        self.started = time.perf_counter()
        self.clouds, self.options, self.progress = clouds, options, progress
        _check_groups(clouds, options)  # before any work: a dimension may be missing
        plan = feature_plan(options)
        self.labeled = label_classes(clouds, options, progress)
        self.codes = self.labeled.classes.codes
        self.flights = [cloud.flight for cloud in clouds]
        shares = [f"{cloud.flight} {cloud.copy}" for cloud in clouds]
        total = sum(map(len, clouds)) * (1 + len(self.codes))  # which are read for each class
        with Progress(total, "drawing samples", enabled=progress) as bar:
            self.samples = draw_samples(
                self.labeled, len(self.codes), options.count, options.seed, shares, progress=bar
            )
        used = [clouds[number].xyz for number in np.unique(self.samples.cloud).tolist()]
        bins, threshold = fit_clouds(used, plan, seed=options.seed, threads=options.threads)
        self.features = Features(plan, bins, threshold, options.seed)
        self.context = Context(tuple(options.context))
        self.counts: dict[str, int] = {}
        self.own = self._features_of_samples()
        self.below = (
            None if options.base is None else Below(options.base, clouds, self.samples, options, progress)
        )
        #: What the first pass reads of the samples.
        self.first = self.own if self.below is None else _beside(self.own, self.below.columns)
        self.xy = self.samples.take(lambda number: clouds[number].xyz[:, :2])
        weight = self.samples.weight
        drawn = np.bincount(self.samples.label, weight, len(self.codes))
        frequent = np.array(self.samples.available) / drawn
        #: How many points each sample stands for.
        self.stands_for = weight * frequent[self.samples.label]
        factors = frequent**options.prior_weight
        self.factors = factors / factors.max() if options.prior_weight else None
        share = options.max_samples
        if share is None:
            share = min(1.0, PER_TREE * len(self.codes) / int(weight.sum()))
        self.setting = TreeOptions(options.min_samples_leaf, share, options.max_features)
        self.fold_trees = max(1, math.ceil(options.trees * FOLD_TREES))

    def _features_of_samples(self) -> npt.NDArray[np.float32]:
        """(samples, features), filled cloud by cloud."""
        o, samples, names, own = (
            self.options,
            self.samples,
            self.features.plan.names,
            self.features.plan.dimensions,
        )
        if (needed := 4 * len(samples) * len(names)) > free_memory():
            raise OptionError(
                f"{len(samples):,} samples of {len(names)} features do not fit into the free memory",
                found=f"{needed / 2**30:.1f} GiB needed",
                cure="Lower 'count', or use fewer neighborhoods or features",
            )
        values = np.empty((len(samples), len(names)), np.float32, order="F")
        with Progress(len(samples), "features of the samples", enabled=self.progress) as bar:
            for number, cloud in enumerate(self.clouds):
                at, rows = samples.of_cloud(number)
                if not len(at):
                    continue
                engine = self.features.engine(cloud.xyz, o.threads)
                there = with_returns(own, cloud.xyz, cloud.dimensions, o.threads)
                fed, counts = gather(own, there, len(cloud), rows, cloud.name)
                if cloud.own is not None:
                    counts[SHORT] = 0
                for part, block in engine.blocks(
                    queries=rows, dimensions=fed, threads=o.threads, memory_mb=o.memory_mb, progress=bar
                ):
                    values[at[np.searchsorted(rows, part)]] = block
                if cloud.own is not None:
                    counts[SHORT] = max(engine.report.beyond_halo.values(), default=0)
                for key, n in counts.items():
                    self.counts[key] = self.counts.get(key, 0) + n
        bad = ~np.isfinite(values).all(axis=0)
        if bad.any():
            raise DimensionError(f"the feature {names[int(bad.argmax())]} is not finite for some samples")
        return values

    def model(self) -> Model:
        """Score, grow, and put together."""
        o = self.options
        timed = {"features": time.perf_counter() - self.started}
        validation, notes = self._validate()
        started = time.perf_counter()
        forests, importances = self._passes()
        timed["trees"] = time.perf_counter() - started
        priors = (
            None if self.factors is None else {"weight": o.prior_weight, "factors": self.factors.tolist()}
        )
        info = {
            **self.labeled.described(o, map(self.samples.counts, range(len(self.codes)))),
            "training": {
                "clouds": listed(self.clouds),
                "count": o.count,
                "seed": o.seed,
                "samples": len(self.samples),
                "max_samples": self.setting.max_samples,
                "max_features": o.max_features,
                "min_samples_leaf": o.min_samples_leaf,
                **({"pass_folds": o.pass_folds} if o.passes > 1 else {}),
                **notes,
                **(held_by_base(self.below, self.codes) if self.below else {}),
                **{key: n for key, n in self.counts.items() if n},
            },
            "priors": priors,
            "densities": densities(self.clouds),
            "voxel": o.voxel,
            "accuracy": {"cross_validation": validation},
            "passes": [{"importances": one} for one in importances],
            "created_by": _versions(),
        }
        if validation is not None and self.sureness.right:
            info["sureness"] = self.sureness.to_dict()
        names = list(zip(self.codes, self.labeled.classes.names, strict=True))
        made = Model(tuple(forests), names, info, timed)
        return made if self.below is None else on_top(self.below, made)

    def _grow(
        self, values: npt.NDArray[np.float32], weight: npt.NDArray[np.int64], trees: int, bar: Progress
    ) -> tuple[Forest, npt.NDArray[np.float64]]:
        o = self.options
        return grow_forest(values, self.samples.label, weight, trees, self.setting, o.seed, o.threads, bar)

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
        with Progress(count * self.fold_trees, what, "trees", enabled=self.progress) as bar:
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
        folds, gap = o.folds or 5, _gap(self.features.plan)
        group = samples.take(lambda number: _groups(self.clouds[number], o))
        names, index = np.unique(group, return_inverse=True)
        asked = {"groups": o.groups} if o.groups else {}
        for by in (["groups" if o.groups else "surveys"] if len(names) > 1 else []) + ["blocks"]:
            self.sureness = Sureness(about=f"{by} held out, forests of {self.fold_trees} trees")
            here = 0.0 if by == "surveys" else gap  # which do not see each other, whatever their coordinates
            try:
                if by == "blocks":
                    fold = Folds.of_blocks(self.xy, samples.label, samples.weight, folds, BLOCK).points(
                        self.xy
                    )
                else:
                    fold = (index % folds).astype(np.int16)
                matrix = np.zeros((len(codes), len(codes)), np.int64)
                for rows, forest in self._without_each(
                    self.first, fold, "cross-validation", here, len(codes)
                ):
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

    def _count_sure(self, rows: npt.NDArray[np.int64], p: npt.NDArray[np.float64]) -> None:
        """Count in how far samples that were held out were right where they were sure, as the points lie."""
        codes: Sequence[int] = self.codes
        if self.below is None:
            p = weighed(p, self.factors)
        elif self.options.target is not None:
            return  # what the others truly are is not known
        else:
            before = self.below.base.codes.tolist()
            p = blended(self.below.own[rows], p, before, codes, self.below.trusted)
            codes = sorted({*before, *codes})
        true = np.asarray(self.codes)[self.samples.label[rows]]
        counted(p, codes, true, self.stands_for[rows], self.sureness)

    def _unscored(self, reason: str, gap: float) -> str:
        """Why there is no score, and which class to label next, and where not: that of the fewest blocks of ground."""
        cell = np.floor(self.xy / BLOCK)
        mine = [self.samples.label == place for place in range(len(self.codes))]
        least = int(np.argmin([len(np.unique(cell[one], axis=0)) for one in mine]))
        low, high = self.xy[mine[least]].min(axis=0), self.xy[mine[least]].max(axis=0)
        x, y = (low + high) / 2
        return (
            f"there is no score on ground held out: {reason}. Label next, at least {BLOCK + gap:.0f} m away: "
            f"{self.codes[least]} {self.labeled.classes.names[least]}, which lies around {x:.0f}, {y:.0f}"
        )

    # ---- passes --------------------------------------------------------------------------------------------

    def _passes(self) -> tuple[list[FeatureForest], list[list[float]]]:
        """One forest after the other, each reading what the one before says of ground it has not seen."""
        o, samples = self.options, self.samples
        made, importances = [], []
        held_out: list[list[Forest]] = []
        values = self.first
        if o.passes > 1:
            folds = Folds.of_ground(self.xy, samples.label, samples.weight, self.flights, o.pass_folds)
            fold = samples.take(lambda number: folds.points(self.clouds[number].xyz, self.flights[number]))
        for number in range(o.passes):
            if number:
                # Ground beside a fold is not left out as for the score: the forests miss the fold's samples already,
                # and the next pass should see probabilities as good as those it will see when the model is used.
                what = f"pass {number} without each fold"
                held_out.append([forest for _, forest in self._without_each(values, fold, what)])
                values = _beside(self.own, self._context(folds, held_out))
            with Progress(o.trees, f"growing pass {number + 1}", "trees", enabled=self.progress) as bar:
                forest, shares = self._grow(values, samples.weight, o.trees, bar)
            made.append(FeatureForest(self.features, forest, self._read_by(number)))
            importances.append(shares.tolist())
        return made, importances

    def _read_by(self, number: int) -> Context | None:
        """What a pass reads of the one before."""
        if number:
            return self.context
        return None if self.below is None else self.below.context

    def _context(self, folds: Folds, held_out: Sequence[Sequence[Forest]]) -> npt.NDArray[np.float32]:
        """The samples' context, (samples, columns), by passes that have not seen them."""
        o, below, count = self.options, self.below, len(held_out)
        reads = [self._read_by(number) for number in range(count)]
        blends: Sequence[Blend | None] = [None] * count
        classes = [len(self.codes)] * count
        first: Sequence[Any] = ()
        factors: Sequence[Any] = ()
        if below is not None:
            blends = below.blends(self.codes, len(self.features.plan.names), reads)
            classes = [*below.classes, *(len(one.codes) for one in blends if one)]
            first, factors = below.passes, below.factors
        out = np.empty((len(self.samples), len(self.context.tokens) * classes[-1]), np.float32)
        with Progress(len(out), f"context for pass {count + 1}", enabled=self.progress) as bar:
            for number, cloud in enumerate(self.clouds):
                at, rows = self.samples.of_cloud(number)
                if not len(at):
                    continue
                fold = folds.points(cloud.xyz, self.flights[number])
                passes = [
                    FoldForests(self.features, context, forests, fold, blend)
                    for context, forests, blend in zip(reads, held_out, blends, strict=True)
                ]
                request = PredictRequest(cloud.xyz, cloud.dimensions, rows, o.threads, o.memory_mb, bar)
                out[at] = sample_context(request, [*first, *passes], self.context, classes, factors)
        return out


def _beside(values: npt.NDArray[np.float32], more: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    return np.asfortranarray(np.concatenate([values, more], axis=1))


def _gap(plan: Any) -> float:
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
