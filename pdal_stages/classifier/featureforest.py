"""A forest that classifies clouds: features are computed block by block and handed to the trees at once."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from ..base.errors import ModelError
from ..base.report import Report
from ..features import FeatureEngine, FeaturePlan, ShapeBins
from ..features.index import CellGrid
from ..features.names import GROUPS, RELATIVE
from .algorithms import ArrayRule, Block, Column, PredictRequest, PredictResult
from .context import Context
from .dimensions import gather, with_returns
from .forest import Forest


@dataclass(frozen=True, eq=False)
class Features:
    """Features and what training fitted to compute them; ModelError where something is missing that they need."""

    plan: FeaturePlan
    bins: ShapeBins | None = None  #: thresholds of the shape distributions' histograms
    copt_threshold: float | None = None  #: curvature threshold of ``copt``
    seed: int = 0  #: of the shape distributions' random pulls

    def __post_init__(self) -> None:
        there = {} if self.bins is None else self.bins.to_dict()
        for part in self.plan.layout:
            token = part.neighborhood.token
            if part.shapes and token not in there:
                raise ModelError("the model lacks the thresholds of shape distributions", found=token)
            if part.neighborhood.kind == "copt" and self.copt_threshold is None:
                raise ModelError("the model lacks the curvature threshold of copt")

    def to_dict(self) -> dict[str, Any]:
        """As a manifest has it."""
        return {
            "features": self.plan.to_dict(),
            "shape_bins": None if self.bins is None else self.bins.to_dict(),
            "copt_threshold": self.copt_threshold,
            "feature_seed": self.seed,
        }

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Features:
        """From what a manifest says of a pass; passes that read the same share one object."""
        keys = ("features", "shape_bins", "copt_threshold", "feature_seed")
        return shared_features(json.dumps({key: entry[key] for key in keys}))

    def engine(
        self, xyz: npt.NDArray[np.float64], threads: int | None = None, grid: CellGrid | None = None
    ) -> FeatureEngine:
        """What computes them over a cloud; `grid`: its index, where there is one of the right cells."""
        return FeatureEngine(
            xyz,
            self.plan,
            bins=self.bins,
            copt_threshold=self.copt_threshold,
            seed=self.seed,
            threads=threads,
            grid=grid if grid is not None and grid.cell == self.plan.cell else None,
        )


@lru_cache(maxsize=4)
def shared_features(text: str) -> Features:
    """What a manifest says of features, as JSON."""
    entry = json.loads(text)
    bins = entry["shape_bins"]
    return Features(
        FeaturePlan.from_dict(entry["features"]),
        None if bins is None else ShapeBins.from_dict(bins),
        entry["copt_threshold"],
        entry["feature_seed"],
    )


@dataclass(frozen=True, eq=False)
class FeatureForest:
    """A forest and what it reads."""

    features: Features
    forest: Forest
    context: Context | None = None  #: what it reads of the pass before, after the features

    name: ClassVar[str] = "random_forest"
    rules: ClassVar[Mapping[str, ArrayRule]] = Forest.rules
    gives_variance: ClassVar[bool] = False

    @property
    def plan(self) -> FeaturePlan:
        """Its features."""
        return self.features.plan

    # ---- file ----------------------------------------------------------------------------------------------

    @classmethod
    def from_file(
        cls, entry: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]], codes: Sequence[int]
    ) -> FeatureForest:
        """Made from what a model file says of a pass, everything checked."""
        features = Features.from_dict(entry)
        context = Context(tuple(entry["context"])) if entry["context"] else None
        check_names(features.plan, () if context is None else context.names(codes), entry)
        return cls(features, Forest.from_arrays(arrays, len(entry["feature_names"]), len(codes)), context)

    def to_file(self, codes: Sequence[int]) -> dict[str, Any]:
        """What a model file says of it beside its arrays."""
        return {
            "parameters": self.forest.parameters(),
            "feature_names": [column.name for column in self.columns(codes)],
            "dimensions": list(self.plan.dimensions),
            "context": [] if self.context is None else list(self.context.tokens),
            **self.features.to_dict(),
        }

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """The arrays a model file stores."""
        return self.forest.arrays()

    def classes_before(self, codes: Sequence[int]) -> list[int]:
        """Classes of the pass before, whose probabilities it reads; `codes` are its own."""
        return list(codes)

    def columns(self, codes: Sequence[int]) -> list[Column]:
        """The features; a histogram's bins are one feature."""
        group_of = {
            name: group
            for group in ("covariance", "geometric", "shapes", "surfaces")
            for name in GROUPS[group]
        }
        group_of.update(dict.fromkeys(RELATIVE, "geometric"))
        found = []
        for part in self.plan.layout:
            for name in part.at:
                group = group_of[name]
                feature = name.split("_")[0] if group == "shapes" else name
                found.append((feature, group, part.neighborhood.token))
        found += [(name, "dimension", "(dimension)") for name in self.plan.dimensions]
        columns = [Column(name, *rest) for name, rest in zip(self.plan.names, found, strict=True)]
        codes = self.classes_before(codes)
        for token in () if self.context is None else self.context.tokens:
            for name, code in zip(Context((token,)).names(codes), codes, strict=True):
                columns.append(Column(name, f"Probability_{code}", "context", token))
        return columns

    # ---- applying it ---------------------------------------------------------------------------------------

    def probabilities(
        self, values: npt.NDArray[np.float32], rows: npt.NDArray[np.int64] | None = None
    ) -> npt.NDArray[np.float64]:
        """Probabilities (b, classes) of points by their features and context; `rows`, which they are, plays no part."""
        return self.forest.predict_proba(values)

    def predict(
        self, request: PredictRequest, finish: Callable[[npt.NDArray[np.float64]], Any]
    ) -> PredictResult:
        """Classify; see ``Algorithm.predict``. Not for one that reads context, which :class:`Passes` gives it."""
        features_here = CloudFeatures(self.features, request)
        blocks = features_here.blocks(
            request.rows, lambda values, rows: finish(self.probabilities(values)), progress=request.progress
        )
        return PredictResult((Block(rows, result) for rows, result in blocks), features_here.report)


class CloudFeatures:
    """Features of a request's points, block by block; `report` has what was counted."""

    def __init__(self, features: Features, request: PredictRequest) -> None:
        self.features, self._request = features, request
        self.report = Report()
        self._engine: FeatureEngine | None = None
        names = features.plan.dimensions
        self._dimensions = with_returns(names, request.xyz, request.dimensions, request.threads)
        _, counted = gather(names, self._dimensions, len(request.xyz), request.rows)
        self.report.figures.update({name: number for name, number in counted.items() if number})

    def blocks(
        self,
        rows: npt.NDArray[np.int64] | None,
        apply: Callable[[npt.NDArray[np.float32], npt.NDArray[np.int64]], Any],
        memory_share: float = 1.0,
        progress: Any = None,
    ) -> Iterator[tuple[npt.NDArray[np.int64], Any]]:
        """Yield (rows, ``apply(values, rows)``) for some rows (None: all points); `apply` runs in workers' threads."""
        asked = self._request
        if not (len(asked.xyz) if rows is None else len(rows)):
            return
        if self._engine is None:
            self._engine = self.features.engine(asked.xyz, asked.threads, asked.grid)
        engine = self._engine
        names, known, n = self.features.plan.dimensions, self._dimensions, len(asked.xyz)
        yield from engine.blocks(
            queries=rows,
            dimensions=lambda some: gather(names, known, n, some)[0],
            threads=asked.threads,
            memory_mb=max(asked.memory_mb * memory_share, 16.0),
            progress=progress,
            apply=apply,
        )
        few = engine.report.figures["fewer_than_three"]
        if any(few.values()):
            self.report.figures["fewer_than_three"] = {
                token: number for token, number in few.items() if number
            }
        self.report.beyond_halo.update(engine.report.beyond_halo)


def check_names(plan: FeaturePlan, context: Sequence[str], entry: Mapping[str, Any]) -> None:
    """Refuse a pass whose columns are not those its plan and its context give."""
    names, expected = entry["feature_names"], [*plan.names, *context]
    if expected == names and list(plan.dimensions) == entry["dimensions"]:
        return
    pairs = zip([*names, *entry["dimensions"]], [*expected, *plan.dimensions], strict=False)
    first = next((f"'{a}' where '{b}' belongs" for a, b in pairs if a != b), None)
    raise ModelError(
        "the model's features, or their order, are not those its neighborhoods give in this release",
        found=first or f"{len(names)} features, {len(expected)} belong",
        cure="Train the model again with this release",
    )
