"""A random forest that classifies points by features and context, alone or on top of a base."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from ..base.errors import ModelError
from ..features import FeaturePlan
from ..features.registry import BY_NAME
from .context_features import OWN, Context
from .fitted_features import Features
from .interface import ArrayRule, Column
from .random_forest import Forest
from .refinement import Blend
from .registry import FOREST, REFINED_FOREST


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
