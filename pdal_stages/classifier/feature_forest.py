"""Features with what training fitted, and the forest that classifies points by them and context."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from ..base.errors import ModelError
from ..base.grid import cell_numbers
from ..base.json_types import JsonObject
from ..base.progress import Progress
from ..features import FeatureEngine, FeaturePlan, ShapeBins
from ..features.engine import FeatureBlock, Run
from .context_features import OWN, Context
from .input_dimensions import add_surroundings, required_dimensions, take_dimensions
from .interface import FOREST, REFINED_FOREST, Estimator, PredictRequest
from .learner import ContributingLearner, Learner

#: Blocks of features get so many megabytes at least, whatever the request says (not tuned).
_LEAST_MB = 16.0
#: Least sum of probabilities that is divided by.
_SMALLEST = 1e-300


@dataclass(frozen=True, eq=False)
class Features:
    """Features and what training fitted to compute them."""

    plan: FeaturePlan
    bins: ShapeBins | None = None  #: thresholds of the shape distributions' histograms
    copt_threshold: float | None = None  #: curvature threshold of ``copt``
    seed: int = 0  #: of the shape distributions' random pulls

    def __post_init__(self) -> None:
        """Raise a ModelError where something is missing that the features need."""
        stored = {} if self.bins is None else self.bins.to_dict()
        for part in self.plan.layout:
            token = part.neighborhood.token
            if part.shapes and token not in stored:
                raise ModelError("the model lacks thresholds of shape distributions", found=token)
            if part.neighborhood.kind == "copt" and self.copt_threshold is None:
                raise ModelError("the model lacks the curvature threshold of copt")

    def to_dict(self) -> JsonObject:
        """Return what a manifest stores beside the names of the columns."""
        plan = self.plan.to_dict()
        del plan["features"], plan["dimensions"]
        return {
            **plan,
            "shape_bins": None if self.bins is None else self.bins.to_dict(),
            "copt_threshold": self.copt_threshold,
            "feature_seed": self.seed,
        }

    @classmethod
    def from_dict(cls, entry: JsonObject, names: Sequence[str]) -> Features:
        """Return the features of a manifest's pass; `names` are those of the columns, in order."""
        bins = entry["shape_bins"]
        return cls(
            FeaturePlan.from_dict({**entry, "features": list(names)}),
            None if bins is None else ShapeBins.from_dict(bins),
            entry["copt_threshold"],
            entry["feature_seed"],
        )


class CloudFeatures:
    """Features of the points of a request, computed in blocks and counted in its report."""

    def __init__(self, features: Features, request: PredictRequest) -> None:
        self.features, self._request = features, request
        self._engine: FeatureEngine | None = None
        # An error of these is raised here, before any work.
        names = required_dimensions(features.plan.dimensions)
        take_dimensions(names, request.dimensions, len(request.xyz), request.rows)

    def run(self, rows: npt.NDArray[np.int64] | None, memory_share: float = 1.0) -> Run:
        """Return blocks of some rows (None: all) that take `memory_share` of the memory."""
        request, features = self._request, self.features
        if self._engine is None:
            grid = request.grid
            self._engine = FeatureEngine(
                request.xyz,
                features.plan,
                bins=features.bins,
                copt_threshold=features.copt_threshold,
                seed=features.seed,
                threads=request.threads,
                grid=grid if grid is not None and grid.cell == features.plan.cell else None,
            )
        return self._engine.run(
            rows,
            dimensions=self._dimensions_around(rows),
            memory_mb=max(request.memory_mb * memory_share, _LEAST_MB),
        )

    def blocks(
        self, rows: npt.NDArray[np.int64] | None, progress: Progress | None = None
    ) -> Iterator[FeatureBlock]:
        """Yield the computed blocks of some rows (None: all)."""
        run = self.run(rows)
        for block in run.computed(progress):
            self._report(run)
            yield block

    def count(self, run: Run, block: FeatureBlock) -> None:
        """Add a computed block of a run to the request's report."""
        run.count(block)
        self._report(run)

    def _report(self, run: Run) -> None:
        report, computed = self._request.report, run.engine.report
        few = {token: k for token, k in computed.figures["fewer_than_three"].items() if k}
        if few:
            report.figures.setdefault("fewer_than_three", {}).update(few)
        report.beyond_halo.update(computed.beyond_halo)
        report.reach = max(report.reach, computed.reach)

    def _dimensions_around(
        self, rows: npt.NDArray[np.int64] | None
    ) -> Callable[[npt.NDArray[np.int64]], dict[str, npt.NDArray]]:
        """Return what gives the dimensions at some of these rows (None: all).

        What is computed from the points around is so for these rows alone.
        """
        request, names = self._request, self.features.plan.dimensions
        near = self._slice_around(rows)
        columns = {name: np.asarray(values)[near] for name, values in request.dimensions.items()}
        xyz = request.xyz[near]
        known = add_surroundings(names, xyz, columns, request.threads)

        def take(some: npt.NDArray[np.int64]) -> dict[str, npt.NDArray]:
            return take_dimensions(names, known, len(xyz), some - near.start)

        return take

    def _slice_around(self, rows: npt.NDArray[np.int64] | None) -> slice:
        """Return a part of the cloud that holds rows and all that their dimensions depend on."""
        grid, xyz = self._request.grid, self._request.xyz
        if grid is None or rows is None or not len(rows):
            return slice(0, len(xyz))
        y, reach = xyz[rows, 1], self.features.plan.reach_of_dimensions
        first, last = cell_numbers(np.array([y.min() - reach, y.max() + reach]), grid.cell)
        cells = grid.row_start[np.searchsorted(grid.row_iy, [first, last + 1])]
        return slice(*grid.cell_start[cells].tolist())


@dataclass(frozen=True, eq=False)
class Blend:
    """Rule of a forest that refines a trained model, its base: joins the probabilities of both.

    Classes that only the base knows stay. Of the others the forest counts the more, the more labels
    it was trained on.
    """

    before: tuple[int, ...]  #: classes of the pass before
    labeled: tuple[int, ...]  #: classes of the forest, in the order of its columns
    #: weight of the forest, 0 to 1, where both know a class; the base has the rest
    trusted: float = 1.0

    @classmethod
    def from_dict(cls, entry: JsonObject, codes: Sequence[int]) -> Blend:
        """Return the blend that a manifest describes for a pass whose classes are `codes`.

        ModelError where its classes contradict each other.
        """
        blend = cls(tuple(entry["before"]), tuple(entry["labeled"]), float(entry["trusted"]))
        ascending = all(sorted(set(each)) == list(each) for each in (blend.before, blend.labeled))
        if not ascending or blend.codes != list(codes):
            raise ModelError("classes of a refined forest do not fit", found=str(entry)[:100])
        return blend

    def to_dict(self) -> JsonObject:
        """Return the entry of a manifest."""
        classes = {"before": list(self.before), "labeled": list(self.labeled)}
        return {**classes, "trusted": self.trusted}

    @property
    def codes(self) -> list[int]:
        """Classes of the result."""
        return sorted({*self.before, *self.labeled})

    def __call__(
        self, base: npt.NDArray[np.float64], forest: npt.NDArray[np.float64]
    ) -> npt.NDArray[np.float64]:
        """Return probabilities (n, classes) in the order of :attr:`codes`.

        Parameters
        ----------
        base : (n, before) float64
            Probabilities of the pass before. Classes that only it knows keep theirs, and the
            labeled ones share the rest.
        forest : (n, labeled) float64
            Probabilities of the forest.
        """
        out = np.zeros((len(base), len(self.codes)))
        out[:, np.searchsorted(self.codes, self.before)] = base
        columns = np.searchsorted(self.codes, self.labeled)
        by_base = out[:, columns]
        share = by_base.sum(axis=1, keepdims=True)
        by_base = np.where(share > 0, by_base / np.maximum(share, _SMALLEST), forest)
        kept = np.delete(out, columns, axis=1).sum(axis=1, keepdims=True)
        mixed = self.trusted * forest + (1.0 - self.trusted) * by_base
        out[:, columns] = np.maximum(1.0 - kept, 0.0) * mixed
        return out


@runtime_checkable
class FeatureReader(Protocol):
    """A pass that reads features of the points, and context of the pass before."""

    @property
    def features(self) -> Features:
        """The features that it reads."""

    @property
    def context(self) -> Context | None:
        """The context features that it reads of the pass before; None of the first pass."""

    def probabilities(
        self, values: npt.NDArray[np.float32], rows: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.float64]:
        """Return probabilities (b, classes) from features and context (b, inputs) at `rows`."""


@runtime_checkable
class FeatureEstimator(FeatureReader, Estimator, Protocol):
    """An estimator that reads features and context."""

    def classes_before(self, codes: Sequence[int]) -> list[int]:
        """Return the classes of the pass before; `codes` are its own."""


@dataclass(frozen=True, eq=False)
class FeatureForest:
    """A forest, or another learner on features, and what it reads."""

    features: Features
    forest: Learner
    context: Context | None = None  #: read of the pass before; its columns follow the features
    blend: Blend | None = None  #: of a forest on top of a base
    kind: str = FOREST  #: of the learner

    @property
    def name(self) -> str:
        """The kind, as a manifest has it."""
        return self.kind if self.blend is None else REFINED_FOREST

    @property
    def plan(self) -> FeaturePlan:
        """The features' plan."""
        return self.features.plan

    @classmethod
    def from_file(
        cls,
        entry: JsonObject,
        arrays: Mapping[str, npt.NDArray],
        codes: Sequence[int],
        learner: type[Learner],
    ) -> FeatureForest:
        """Return the forest that a pass of a manifest describes; ModelError for contradictions."""
        context = Context(tuple(entry["context"])) if entry["context"] else None
        blend = None
        if entry["algorithm"] == REFINED_FOREST:
            blend = Blend.from_dict(entry["parameters"], codes)
            if context is None or OWN not in context.tokens:
                raise ModelError(f"a refined forest must read '{OWN}'", found=entry["context"][:10])
        before, labeled = (codes, codes) if blend is None else (blend.before, blend.labeled)
        names = entry["feature_names"]
        others = [*entry["dimensions"], *(() if context is None else context.names(before))]
        count = len(names) - len(others)
        if names[max(count, 0) :] != others:
            raise ModelError(
                "the model's last columns must be the points' dimensions and what it reads of the "
                "pass before",
                found=", ".join(names[-3:]),
            )
        if context is not None:
            context.check_codes(before, entry["dimensions"])
        features = Features.from_dict(entry, names[:count])
        forest = learner.from_arrays(arrays, len(names), len(labeled))
        kind = FOREST if blend is not None else entry["algorithm"]
        return cls(features, forest, context, blend, kind)

    def to_file(self, codes: Sequence[int]) -> JsonObject:
        """Return what a manifest says of it beside its arrays."""
        blend = {} if self.blend is None else self.blend.to_dict()
        return {
            "parameters": {**self.forest.parameters(), **blend},
            "feature_names": self.inputs(codes),
            "dimensions": list(self.plan.dimensions),
            "context": [] if self.context is None else list(self.context.tokens),
            **self.features.to_dict(),
        }

    def arrays(self) -> Mapping[str, npt.NDArray]:
        """Return the arrays that a model file stores."""
        return self.forest.arrays()

    def classes_before(self, codes: Sequence[int]) -> list[int]:
        """Return the classes of the pass before; `codes` are its own."""
        return list(codes if self.blend is None else self.blend.before)

    def inputs(self, codes: Sequence[int]) -> list[str]:
        """Return the names of the inputs, in order."""
        context = () if self.context is None else self.context.names(self.classes_before(codes))
        return [*self.plan.names, *context]

    def probabilities(
        self, values: npt.NDArray[np.float32], rows: npt.NDArray[np.int64] | None = None
    ) -> npt.NDArray[np.float64]:
        """Return probabilities (b, classes) from features and context (b, inputs)."""
        by_forest = self.forest.predict_proba(values)
        if self.blend is None or self.context is None:
            return by_forest
        read = values[:, len(self.plan.names) :]
        return self.blend(self.context.own_probabilities(read, len(self.blend.before)), by_forest)

    def contributions(
        self, values: npt.NDArray[np.float32]
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]] | None:
        """Return what each input adds to the probabilities; None of a learner that cannot tell.

        What a refined forest takes over from its base is added by the base's probabilities, all by
        the first of them.

        Parameters
        ----------
        values : (n, inputs) float32
            Features and context.

        Returns
        -------
        start : (classes,) float64
            Probabilities before any input.
        added : (n, inputs, classes) float64
            `start` plus the sum over the inputs are the probabilities.
        """
        if not isinstance(self.forest, ContributingLearner):
            return None
        start, added = self.forest.contributions(values)
        if self.blend is None or self.context is None:
            return start, added
        read = values[:, len(self.plan.names) :]
        base = self.context.own_probabilities(read, len(self.blend.before))
        roots = np.broadcast_to(start, (len(values), len(start)))
        before = self.blend(base, roots)
        out = np.stack(
            [self.blend(base, start + part) - before for part in added.swapaxes(0, 1)], axis=1
        )
        whole = np.zeros(len(self.blend.codes))
        whole[np.searchsorted(self.blend.codes, self.blend.labeled)] = start
        first = self.context.names(self.blend.before).index(
            f"Probability_{self.blend.before[0]}_{OWN}"
        )
        out[:, len(self.plan.names) + first] += before - whole
        return whole, out
