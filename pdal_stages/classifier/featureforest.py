"""A forest that classifies clouds: features are computed block by block and handed to the trees at once."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from ..base.errors import ModelError
from ..features import FeatureEngine, FeaturePlan, ShapeBins
from ..features.names import GROUPS, RELATIVE
from .algorithms import Answer, Block, Column, Question
from .arrays import ArrayRule
from .dimensions import gather
from .forest import Forest


@dataclass(frozen=True, eq=False)
class FeatureForest:
    """A forest and the features it reads.

    Attributes
    ----------
    plan : FeaturePlan
    forest : Forest
    bins : ShapeBins or None
        Thresholds of the shape distributions' histograms.
    copt_threshold : float or None
        Curvature threshold of ``copt``.
    seed : int
        Of the shape distributions' random pulls.

    Raises
    ------
    ModelError
        Where something is missing that the features need, or the forest takes another number of them.
    """

    plan: FeaturePlan
    forest: Forest
    bins: ShapeBins | None = None
    copt_threshold: float | None = None
    seed: int = 0

    name: ClassVar[str] = "random_forest"
    rules: ClassVar[Mapping[str, ArrayRule]] = Forest.rules
    gives_variance: ClassVar[bool] = False

    def __post_init__(self) -> None:
        there = {} if self.bins is None else self.bins.to_dict()
        for part in self.plan.layout:
            token = part.neighborhood.token
            if part.shapes and token not in there:
                raise ModelError("the model lacks the thresholds of shape distributions", found=token)
            if part.neighborhood.kind == "copt" and self.copt_threshold is None:
                raise ModelError("the model lacks the curvature threshold of copt")

    # ---- file ----------------------------------------------------------------------------------------------

    @classmethod
    def from_file(cls, manifest: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]]) -> FeatureForest:
        """Made from what a model file says, everything checked."""
        plan = FeaturePlan.from_dict(manifest["features"])
        check_names(plan, manifest)
        forest = Forest.from_arrays(arrays, len(plan.names), len(manifest["classes"]))
        bins = manifest["shape_bins"]
        return cls(
            plan,
            forest,
            None if bins is None else ShapeBins.from_dict(bins),
            manifest["copt_threshold"],
            manifest["feature_seed"],
        )

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """The arrays a model file stores."""
        return self.forest.arrays()

    def parameters(self) -> dict[str, Any]:
        """What a model file says about the forest beside its arrays."""
        return self.forest.parameters()

    def fitted(self) -> dict[str, Any]:
        """What training fitted for the features."""
        return {
            "shape_bins": None if self.bins is None else self.bins.to_dict(),
            "copt_threshold": self.copt_threshold,
            "feature_seed": self.seed,
        }

    def columns(self) -> Sequence[Column]:
        """The features; a histogram's bins are one feature."""
        group_of = {name: group for group in ("covariance", "geometric", "shapes") for name in GROUPS[group]}
        group_of.update(dict.fromkeys(RELATIVE, "geometric"))
        found = []
        for part in self.plan.layout:
            for name in part.at:
                group = group_of[name]
                feature = name.split("_")[0] if group == "shapes" else name
                found.append((feature, group, part.neighborhood.token))
        found += [(name, "dimension", "(dimension)") for name in self.plan.dimensions]
        return [Column(name, *rest) for name, rest in zip(self.plan.names, found, strict=True)]

    # ---- applying it ---------------------------------------------------------------------------------------

    def predict_rows(self, values: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Probabilities (n, classes) of rows of features, in the order of ``plan.names``."""
        array = np.ascontiguousarray(values, dtype=np.float32)
        if array.ndim != 2 or array.shape[1] != len(self.plan.names):
            raise ModelError(
                f"the model takes {len(self.plan.names)} features per point",
                found=f"an array of shape {array.shape}",
            )
        if not np.isfinite(array).all():
            raise ModelError(
                "a feature is not a finite number", cure="Compute features with this package's own stage"
            )
        return self.forest.predict_proba(array)

    def predict(self, question: Question, finish: Callable[[npt.NDArray[np.float64]], Any]) -> Answer:
        """Classify; see ``Algorithm.predict``."""
        answer = Answer(())
        fed, notes = gather(self.plan.dimensions, question.dimensions, len(question.xyz), question.rows)
        answer.report.update({name: number for name, number in notes.items() if number})
        if question.count:
            answer.blocks = self._blocks(question, fed, finish, answer.report)
        return answer

    def _blocks(self, question: Question, fed, finish, report: dict[str, Any]):
        engine = FeatureEngine(
            question.xyz,
            self.plan,
            bins=self.bins,
            copt_threshold=self.copt_threshold,
            seed=self.seed,
            threads=question.threads,
        )
        for rows, result in engine.blocks(
            queries=question.rows,
            dimensions=fed,
            threads=question.threads,
            memory_mb=question.memory_mb,
            progress=question.progress,
            apply=lambda values, _: finish(self.forest.predict_proba(values)),
        ):
            yield Block(rows, result)
        for key in ("fewer_than_three", "beyond_halo"):
            if any(engine.report.get(key, {}).values()):
                report[key] = {token: number for token, number in engine.report[key].items() if number}


def check_names(plan: FeaturePlan, manifest: Mapping[str, Any]) -> None:
    """Refuse a manifest whose columns are not those its plan gives."""
    names = manifest["feature_names"]
    if list(plan.names) == names and list(plan.dimensions) == manifest["dimensions"]:
        return
    pairs = zip([*names, *manifest["dimensions"]], [*plan.names, *plan.dimensions], strict=False)
    first = next((f"'{a}' where '{b}' belongs" for a, b in pairs if a != b), None)
    raise ModelError(
        "the model's features, or their order, are not those its neighborhoods give in this release",
        found=first or f"{len(names)} features, {len(plan.names)} belong",
        cure="Train the model again with this release",
    )
