"""A forest that classifies clouds, alone or on top of a trained model.

Features are computed block by block and handed to the trees at once. On top of a model classes that only it knows are
left alone; of the others it is believed the more the fewer labels there were.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from ..base.errors import ModelError
from ..features import FeatureEngine, FeaturePlan, ShapeBins
from ..features.registry import BY_NAME
from .context_features import OWN, Context
from .input_dimensions import add_return_features, take_dimensions
from .interface import ArrayRule, Column, PredictRequest
from .random_forest import Forest
from .registry import REFINED_FOREST

#: As many labeled points of its rarest class count as much as the base.
EVEN = 30
#: Probabilities that cannot be divided by.
NOTHING = 1e-300


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
        """Return the features of a pass of a manifest, whose full `names` are in the order of its columns."""
        bins = entry["shape_bins"]
        return cls(
            FeaturePlan.from_dict({**entry, "features": list(names)}),
            None if bins is None else ShapeBins.from_dict(bins),
            entry["copt_threshold"],
            entry["feature_seed"],
        )


@dataclass(frozen=True, eq=False)
class Blend:
    """What is said before and what a forest on top says, as one."""

    before: tuple[int, ...]  #: classes of the pass before
    labeled: tuple[int, ...]  #: those the forest was trained on, in the order of its columns
    #: 0: the forest counts for nothing where the base knows the class; 1: the base for nothing among the labeled
    trusted: float = 1.0
    #: with the binary strategy, the class that alone is changed; the other of `labeled` is everything else
    target: int | None = None
    #: what the forest's classes are multiplied by for being frequent
    factors: tuple[float, ...] | None = None

    @classmethod
    def from_dict(cls, said: Mapping[str, Any], codes: Sequence[int]) -> Blend:
        """From what a manifest says of a pass whose classes are `codes`; ModelError where it contradicts itself."""
        factors = said.get("factors")
        made = cls(
            tuple(said["before"]),
            tuple(said["labeled"]),
            float(said["trusted"]),
            said.get("target"),
            None if factors is None else tuple(map(float, factors)),
        )
        labeled, target = made.labeled, made.target
        good = made.codes == list(codes) and len(made.factors or labeled) == len(labeled)
        good &= all(sorted(set(one)) == list(one) for one in (made.before, labeled))
        if not good or (target is not None and (target not in labeled or len(labeled) != 2)):
            raise ModelError(
                "a refined forest's classes do not fit each other", found=str(said)[:100]
            )
        return made

    def to_dict(self) -> dict[str, Any]:
        """As a manifest has it."""
        said = {"before": list(self.before), "labeled": list(self.labeled), "trusted": self.trusted}
        return (
            said
            | ({"factors": list(self.factors)} if self.factors else {})
            | {"target": self.target}
        )

    @property
    def codes(self) -> list[int]:
        """The classes that come out."""
        return sorted({*self.before, *(self.labeled if self.target is None else (self.target,))})

    def __call__(
        self, said: npt.NDArray[np.float64], grown: npt.NDArray[np.float64]
    ) -> npt.NDArray[np.float64]:
        """Probabilities (n, classes) of ``codes`` from those of `before` and those the forest gives to `labeled`.

        Classes that only the base knows keep its probability. The rest is shared among the labeled ones.
        """
        grown = weighed(grown, None if self.factors is None else np.array(self.factors))
        target, trusted, codes = self.target, self.trusted, self.codes
        counted = list(self.labeled) if target is None else [target]
        out = np.zeros((len(said), len(codes)))
        out[:, np.searchsorted(codes, self.before)] = said
        at = np.searchsorted(codes, counted)
        if target is not None:
            mine = grown[:, list(self.labeled).index(target)]
            if target in self.before:
                mine = trusted * mine + (1.0 - trusted) * out[:, at[0]]
            out[:, at] = 0.0
            rest = out.sum(axis=1)  # where the base knows of nothing else it stays the target
            mine = np.where(rest > NOTHING, mine, 1.0)
            out *= ((1.0 - mine) / np.maximum(rest, NOTHING))[:, None]
            out[:, at[0]] = mine
            return out
        theirs = out[:, at]
        share = theirs.sum(axis=1, keepdims=True)
        known = np.where(share > 0, theirs / np.maximum(share, NOTHING), grown)
        kept = np.delete(out, at, axis=1).sum(axis=1, keepdims=True)
        out[:, at] = np.maximum(1.0 - kept, 0.0) * (trusted * grown + (1.0 - trusted) * known)
        return out


def trust(labels: int) -> float:
    """How far the forest is believed beside the base, 0 to 1, by the labeled points of its rarest class."""
    return labels / (labels + EVEN)


def weighed(
    p: npt.NDArray[np.float64], factors: npt.NDArray[np.float64] | None
) -> npt.NDArray[np.float64]:
    """Probabilities (b, classes), each class's multiplied by its factor; None leaves them as they are."""
    if factors is None:
        return p
    p = p * factors
    p /= p.sum(axis=1, keepdims=True)
    return p


def on_top(
    base: Any, info: Mapping[str, Any], names: Mapping[int, str], codes: Sequence[int]
) -> dict[str, Any]:
    """What a model of a base's passes and others on top says of itself.

    `info` is what training on top would say alone; `names` are those of the classes `codes`, which come out of the last.
    """
    entries = {one["code"]: one for one in info["classes"]}
    unseen = {"available": 0, "samples": 0, "duplicates": 0}
    inherited = {one["code"]: {"labels": one["labels"]} for one in base.info["classes"]}
    scores = [
        {**one, "codes": codes}
        for codes, one in zip(base.codes_of, base.info["passes"], strict=True)
    ]
    if base.factors is not None:
        scores[-1]["factors"] = base.factors.tolist()
    densities, before = info["densities"], base.info.get("densities")
    if densities and before:
        low, high = min(densities["low"], before["low"]), max(densities["high"], before["high"])
        densities = {**densities, "low": low, "high": high}
    return {
        **info,
        "strategy": "multiclass",
        "target": None,
        "background": None,
        "classes": [
            {
                **unseen,
                **inherited.get(code, {}),
                **entries.get(code, {}),
                "code": code,
                "name": names[code],
            }
            for code in codes
        ],
        "priors": None,
        "densities": densities,
        "preparation": base.info.get("preparation") or [],
        "algorithms": base.info.get("algorithms", {}),
        "passes": [*scores, *info["passes"]],
    }


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
        return "random_forest" if self.blend is None else REFINED_FOREST

    @property
    def plan(self) -> FeaturePlan:
        """Its features."""
        return self.features.plan

    # ---- file ----------------------------------------------------------------------------------------------

    @classmethod
    def from_file(
        cls, entry: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]], codes: Sequence[int]
    ) -> FeatureForest:
        """Return the forest that a model file describes as one of its passes, everything checked."""
        context = Context(tuple(entry["context"])) if entry["context"] else None
        blend = None
        if entry["algorithm"] == REFINED_FOREST:
            blend = Blend.from_dict(entry["parameters"], codes)
            if context is None or OWN not in context.tokens:
                raise ModelError(f"a refined forest must read '{OWN}'", found=entry["context"][:10])
        before, labeled = (codes, codes) if blend is None else (blend.before, blend.labeled)
        names = entry["feature_names"]
        others = [*entry["dimensions"], *(() if context is None else context.names(before))]
        if names[max(len(names) - len(others), 0) :] != others:
            raise ModelError(
                "the model's last columns must be the points' dimensions and what it reads of the pass before",
                found=", ".join(names[-3:]),
            )
        features = Features.from_dict(entry, names[: len(names) - len(others)])
        forest = Forest.from_arrays(arrays, len(names), len(labeled))
        return cls(features, forest, context, blend)

    def to_file(self, codes: Sequence[int]) -> dict[str, Any]:
        """What a model file says of it beside its arrays."""
        return {
            "parameters": self.forest.parameters()
            | ({} if self.blend is None else self.blend.to_dict()),
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
        """Return the features; a histogram's bins count as one feature."""
        found = {}
        for part in self.plan.layout:
            for name, column in part.at.items():
                group = BY_NAME[name].group
                feature = name.split("_")[0] if group == "shapes" else name
                found[column] = (feature, group, part.neighborhood.token)
        columns = [Column(name, *found[number]) for number, name in enumerate(self.plan.features)]
        columns += [Column(name, name, "dimension", "(dimension)") for name in self.plan.dimensions]
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
        return self.blend(
            self.context.own(values[:, len(self.plan.names) :], len(self.blend.before)), grown
        )


class CloudFeatures:
    """Features of a request's points, block by block; what is counted goes into its report."""

    def __init__(self, features: Features, request: PredictRequest) -> None:
        self.features, self._request = features, request
        self._engine: FeatureEngine | None = None
        names = features.plan.dimensions
        self._dimensions = add_return_features(
            names, request.xyz, request.dimensions, request.threads
        )
        take_dimensions(
            names, self._dimensions, len(request.xyz), request.rows
        )  # says what is wrong with them

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
            dimensions=lambda some: take_dimensions(
                features.plan.dimensions, self._dimensions, n, some
            ),
            threads=asked.threads,
            memory_mb=max(asked.memory_mb * memory_share, 16.0),
            progress=progress,
            apply=apply,
        )
        few = {
            token: k for token, k in self._engine.report.figures["fewer_than_three"].items() if k
        }
        if few:
            report.figures.setdefault("fewer_than_three", {}).update(few)
        report.beyond_halo.update(self._engine.report.beyond_halo)
        report.reach = max(report.reach, self._engine.report.reach)
