"""Features with what training fitted, and their values at the points of a cloud."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import ModelError
from ..features import FeatureEngine, FeaturePlan, ShapeBins
from ..features.engine import FeatureBlock, Run
from .input_dimensions import add_return_features, take_dimensions
from .interface import PredictRequest


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
                raise ModelError(
                    "the model lacks the thresholds of shape distributions", found=token
                )
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
            threads=request.threads,
            memory_mb=max(request.memory_mb * memory_share, 16.0),
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
