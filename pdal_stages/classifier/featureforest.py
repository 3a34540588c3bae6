"""A forest that classifies clouds: features are computed block by block and handed to the trees at once."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from ..base.errors import ModelError
from ..features import FeatureEngine, FeaturePlan, ShapeBins
from ..features.names import GROUPS, RELATIVE
from .algorithms import REFINED, ArrayRule, Column, PredictRequest
from .context import OWN, Context
from .dimensions import gather, with_returns
from .forest import Forest
from .refinement import Blend


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
        """From what a manifest says of a pass."""
        bins = entry["shape_bins"]
        return cls(
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
    blend: Blend | None = None  #: of a forest on top of a base: how it changes what is said before

    rules: ClassVar[Mapping[str, ArrayRule]] = Forest.rules

    @property
    def name(self) -> str:
        return "random_forest" if self.blend is None else REFINED

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
        blend = None
        if entry["algorithm"] == REFINED:
            blend = Blend.from_dict(entry["parameters"], codes)
            if context is None or OWN not in context.tokens:
                raise ModelError(f"a refined forest must read '{OWN}'", found=entry["context"][:10])
        labeled = codes if blend is None else blend.labeled
        forest = Forest.from_arrays(arrays, len(entry["feature_names"]), len(labeled))
        made = cls(features, forest, context, blend)
        names, expected = entry["feature_names"], [column.name for column in made.columns(codes)]
        if expected != names or list(made.plan.dimensions) != entry["dimensions"]:
            odd = [f"'{a}' where '{b}' belongs" for a, b in zip(names, expected, strict=False) if a != b]
            raise ModelError(
                "the model's features, or their order, are not those its neighborhoods give in this release",
                found=odd[0] if odd else f"{len(names)} features, {len(expected)} belong",
                cure="Train the model again with this release",
            )
        return made

    def to_file(self, codes: Sequence[int]) -> dict[str, Any]:
        """What a model file says of it beside its arrays."""
        return {
            "parameters": self.forest.parameters() | ({} if self.blend is None else self.blend.to_dict()),
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
        return list(codes if self.blend is None else self.blend.before)

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
        grown = self.forest.predict_proba(values)
        if self.blend is None or self.context is None:
            return grown
        return self.blend(self.context.own(values[:, len(self.plan.names) :], len(self.blend.before)), grown)


class CloudFeatures:
    """Features of a request's points, block by block; what is counted goes into its report."""

    def __init__(self, features: Features, request: PredictRequest) -> None:
        self.features, self._request = features, request
        self._engine: FeatureEngine | None = None
        names = features.plan.dimensions
        self._dimensions = with_returns(names, request.xyz, request.dimensions, request.threads)
        gather(names, self._dimensions, len(request.xyz), request.rows)  # says what is wrong with them

    def blocks(
        self,
        rows: npt.NDArray[np.int64] | None,
        apply: Callable[[npt.NDArray[np.float32], npt.NDArray[np.int64]], Any],
        memory_share: float = 1.0,
        progress: Any = None,
    ) -> Iterator[tuple[npt.NDArray[np.int64], Any]]:
        """Yield (rows, ``apply(values, rows)``) for some rows (None: all points); `apply` runs in workers' threads."""
        asked, features, report = self._request, self.features, self._request.report
        n = len(asked.xyz)
        if not (n if rows is None else len(rows)):
            return
        if self._engine is None:
            grid = asked.grid
            self._engine = FeatureEngine(
                asked.xyz,
                features.plan,
                bins=features.bins,
                copt_threshold=features.copt_threshold,
                seed=features.seed,
                threads=asked.threads,
                grid=grid if grid is not None and grid.cell == features.plan.cell else None,
            )
        yield from self._engine.blocks(
            queries=rows,
            dimensions=lambda some: gather(features.plan.dimensions, self._dimensions, n, some),
            threads=asked.threads,
            memory_mb=max(asked.memory_mb * memory_share, 16.0),
            progress=progress,
            apply=apply,
        )
        few = {token: k for token, k in self._engine.report.figures["fewer_than_three"].items() if k}
        if few:
            report.figures.setdefault("fewer_than_three", {}).update(few)
        report.beyond_halo.update(self._engine.report.beyond_halo)
        report.reach = max(report.reach, self._engine.report.reach)
