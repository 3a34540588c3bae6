"""Features with what training fitted, and the forest that classifies points by them and context."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from ..base.errors import ModelError
from ..features import FeatureEngine, FeaturePlan, ShapeBins
from ..features.engine import FeatureBlock, Run
from ..features.registry import BY_NAME
from .context_features import OWN, Context
from .input_dimensions import add_return_features, take_dimensions
from .interface import ArrayRule, Column, PredictRequest
from .random_forest import Forest
from .refinement import Blend
from .registry import FOREST, REFINED_FOREST

#: Blocks of features get so many megabytes at least, whatever the request says (not tuned).
_LEAST_MB = 16.0


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

    def to_dict(self) -> dict[str, Any]:
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
    def from_dict(cls, entry: Mapping[str, Any], names: Sequence[str]) -> Features:
        """Return the features of a manifest's pass; `names` are those of the columns, in order."""
        bins = entry["shape_bins"]
        return cls(
            FeaturePlan.from_dict({**entry, "features": list(names)}),
            None if bins is None else ShapeBins.from_dict(bins),
            entry["copt_threshold"],
            entry["feature_seed"],
        )


class CloudFeatures:
    """Features of the points of a request, computed in blocks.

    Counts go into the request's report.
    """

    def __init__(self, features: Features, request: PredictRequest) -> None:
        self.features, self._request = features, request
        self._engine: FeatureEngine | None = None
        names = features.plan.dimensions
        self._dimensions = add_return_features(
            names, request.xyz, request.dimensions, request.threads
        )
        # An error of these is raised here, before any work.
        take_dimensions(names, self._dimensions, len(request.xyz), request.rows)

    def run(self, rows: npt.NDArray[np.int64] | None, memory_share: float = 1.0) -> Run:
        """Return the blocks of some rows (None: all) to compute.

        They take `memory_share` of the request's memory.
        """
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
            dimensions=self._take,
            memory_mb=max(request.memory_mb * memory_share, _LEAST_MB),
        )

    def blocks(
        self, rows: npt.NDArray[np.int64] | None, progress: Any = None
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

    def _take(self, rows: npt.NDArray[np.int64]) -> dict[str, npt.NDArray[Any]]:
        names = self.features.plan.dimensions
        return take_dimensions(names, self._dimensions, len(self._request.xyz), rows)


@dataclass(frozen=True, eq=False)
class FeatureForest:
    """A forest and what it reads."""

    features: Features
    forest: Forest
    context: Context | None = None  #: read of the pass before; its columns follow the features
    blend: Blend | None = None  #: of a forest on top of a base

    rules: ClassVar[Mapping[str, ArrayRule]] = Forest.rules

    @property
    def name(self) -> str:
        """The kind, as a manifest has it."""
        return FOREST if self.blend is None else REFINED_FOREST

    @property
    def plan(self) -> FeaturePlan:
        """The features' plan."""
        return self.features.plan

    @classmethod
    def from_file(
        cls, entry: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]], codes: Sequence[int]
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
            context.check_segments(before, entry["dimensions"])
        features = Features.from_dict(entry, names[:count])
        return cls(features, Forest.from_arrays(arrays, len(names), len(labeled)), context, blend)

    def to_file(self, codes: Sequence[int]) -> dict[str, Any]:
        """Return what a manifest says of it beside its arrays."""
        blend = {} if self.blend is None else self.blend.to_dict()
        return {
            "parameters": {**self.forest.parameters(), **blend},
            "feature_names": [column.name for column in self.columns(codes)],
            "dimensions": list(self.plan.dimensions),
            "context": [] if self.context is None else list(self.context.tokens),
            **self.features.to_dict(),
        }

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return the arrays that a model file stores."""
        return self.forest.arrays()

    def classes_before(self, codes: Sequence[int]) -> list[int]:
        """Return the classes of the pass before; `codes` are its own."""
        return list(codes if self.blend is None else self.blend.before)

    def columns(self, codes: Sequence[int]) -> list[Column]:
        """Return the inputs, in order; bins of a histogram are one feature."""
        described: dict[int, tuple[str, str, str]] = {}
        for part in self.plan.layout:
            for name, number in part.at.items():
                group = BY_NAME[name].group
                feature = name.split("_")[0] if group == "shapes" else name
                described[number] = (feature, group, part.neighborhood.token)
        columns = [
            Column(name, *described[number]) for number, name in enumerate(self.plan.features)
        ]
        columns += [Column(name, name, "dimension", "(dimension)") for name in self.plan.dimensions]
        if self.context is not None:
            read = self.context.describe_columns(self.classes_before(codes))
            columns += [Column(name, feature, "context", token) for name, feature, token in read]
        return columns

    def probabilities(
        self, values: npt.NDArray[np.float32], rows: npt.NDArray[np.int64] | None = None
    ) -> npt.NDArray[np.float64]:
        """Return probabilities (b, classes) from features and context (b, inputs)."""
        by_forest = self.forest.predict_proba(values)
        if self.blend is None or self.context is None:
            return by_forest
        read = values[:, len(self.plan.names) :]
        return self.blend(self.context.own_probabilities(read, len(self.blend.before)), by_forest)
