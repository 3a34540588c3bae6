"""Labels on top of a trained model: passes that read what the base says and change what the labels teach.

The base's passes stay as they are. The forests on top know the classes of the labels; what the base says of classes that
the labels lack is left alone, and of the others it is believed the more the fewer labels there are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt

from ..base.errors import ModelError
from ..base.progress import Progress
from .algorithms import PredictRequest
from .context import OWN, Context
from .featureforest import FeatureForest, Features, check_names
from .forest import Forest
from .holdout import sample_context
from .model import Model
from .passes import weighed

if TYPE_CHECKING:
    from .clouds import TrainingCloud
    from .sampling import Samples
    from .trainoptions import TrainingOptions

#: As many labeled points of its rarest class count as much as the base.
EVEN = 30
#: From so many on, several passes on top are better than one.
MANY = 5000
#: Probabilities that cannot be divided by.
NOTHING = 1e-300


@dataclass(frozen=True, eq=False)
class Blend:
    """How what is said before and what a forest on top says become one; see :func:`blended`.

    Attributes
    ----------
    before : tuple of int
        Classes of the pass before.
    labeled : tuple of int
        Those the forest was trained on, in the order of its columns.
    trusted : float
        See :func:`trust`.
    target : int or None
        With the binary strategy, the class that alone is changed.
    first : int
        Column, among all that the forest reads, where the point's own probabilities of before begin.
    factors : tuple of float or None
        What the forest's classes are multiplied by for being frequent.
    """

    before: tuple[int, ...] = ()
    labeled: tuple[int, ...] = ()
    trusted: float = 1.0
    target: int | None = None
    first: int = 0
    factors: tuple[float, ...] | None = None

    @property
    def codes(self) -> list[int]:
        """The classes that come out."""
        return sorted({*self.before, *(self.labeled if self.target is None else (self.target,))})

    def __call__(
        self, values: npt.NDArray[np.float32], grown: npt.NDArray[np.float64]
    ) -> npt.NDArray[np.float64]:
        """Probabilities (b, classes) of points, by all that the forest reads and what it says."""
        said = values[:, self.first : self.first + len(self.before)].astype(np.float64)
        said /= np.maximum(said.sum(axis=1, keepdims=True), 1e-9)
        grown = weighed(grown, None if self.factors is None else np.array(self.factors))
        return blended(said, grown, self.before, self.labeled, self.trusted, self.target)


def own_column(features: int, context: Context, before: int) -> int:
    """Where a point's own probabilities stand after `features` columns; `before`: classes that are spoken of."""
    return features + context.tokens.index(OWN) * before


def trust(labels: int) -> float:
    """How far the forest is believed beside the base, 0 to 1, by the labeled points of its rarest class."""
    return labels / (labels + EVEN)


@dataclass(frozen=True, eq=False)
class RefinedForest(FeatureForest):
    """The forest on top; `blend` is how it changes what is said before."""

    blend: Blend = Blend()

    name: ClassVar[str] = "refined_forest"

    @classmethod
    def from_file(
        cls, entry: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]], codes: Sequence[int]
    ) -> RefinedForest:
        """Made from what a model file says of a pass, everything checked."""
        said = entry["parameters"]
        before, labeled = tuple(said["before"]), tuple(said["labeled"])
        target, factors = said.get("target"), said.get("factors")
        features, context = Features.from_dict(entry), Context(tuple(entry["context"]))
        if OWN not in context.tokens:
            raise ModelError(f"a refined forest must read '{OWN}'", found=entry["context"][:10])
        check_names(features.plan, context.names(before), entry)
        forest = Forest.from_arrays(arrays, len(entry["feature_names"]), len(labeled))
        first = own_column(len(features.plan.names), context, len(before))
        weights = None if factors is None else tuple(map(float, factors))
        blend = Blend(before, labeled, float(said["trusted"]), target, first, weights)
        good = blend.codes == list(codes) and len(weights or labeled) == len(labeled)
        good &= all(sorted(set(one)) == list(one) for one in (before, labeled))
        if not good or (target is not None and (target not in labeled or len(labeled) != 2)):
            raise ModelError("a refined forest's classes do not fit each other", found=str(said)[:100])
        return cls(features, forest, context, blend)

    def to_file(self, codes: Sequence[int]) -> dict[str, Any]:
        """What a model file says of it beside its arrays."""
        entry, blend = super().to_file(codes), self.blend
        own = {"before": list(blend.before), "labeled": list(blend.labeled), "trusted": blend.trusted}
        if blend.factors is not None:
            own["factors"] = list(blend.factors)
        return {**entry, "parameters": {**entry["parameters"], **own, "target": blend.target}}

    def classes_before(self, codes: Sequence[int]) -> list[int]:
        """Those of the pass before."""
        return list(self.blend.before)

    def probabilities(
        self, values: npt.NDArray[np.float32], rows: npt.NDArray[np.int64] | None = None
    ) -> npt.NDArray[np.float64]:
        """Probabilities (b, classes): what is said before, changed as far as the labels are to be believed."""
        return self.blend(values, self.forest.predict_proba(values))


def blended(
    said: npt.NDArray[np.float64],
    grown: npt.NDArray[np.float64],
    before: Sequence[int],
    labeled: Sequence[int],
    trusted: float,
    target: int | None = None,
) -> npt.NDArray[np.float64]:
    """Put the base's probabilities and the forest's together.

    Parameters
    ----------
    said : (n, len(before)) float64
        The base's, rows summing to 1.
    grown : (n, len(labeled)) float64
        The forest's.
    before, labeled : sequence of int
        Their classes.
    trusted : float
        0: the forest counts for nothing where the base knows the class; 1: the base for nothing among the labeled.
    target : int, optional
        The one class of `labeled` that counts; the other is everything else.

    Returns
    -------
    (n, classes) float64, rows summing to 1; the classes of both, ascending.

    Classes that only the base knows keep its probability. The rest is shared among the labeled ones.
    """
    counted = list(labeled) if target is None else [target]
    codes = sorted({*before, *counted})
    out = np.zeros((len(said), len(codes)))
    out[:, np.searchsorted(codes, before)] = said
    at = np.searchsorted(codes, counted)
    if target is not None:
        mine = grown[:, list(labeled).index(target)]
        if target in before:
            mine = trusted * mine + (1.0 - trusted) * out[:, at[0]]
        out[:, at] = 0.0
        rest = out.sum(axis=1)
        mine = np.where(rest > NOTHING, mine, 1.0)  # where the base knows of nothing else it stays the target
        out *= ((1.0 - mine) / np.maximum(rest, NOTHING))[:, None]
        out[:, at[0]] = mine
        return out
    theirs = out[:, at]
    share = theirs.sum(axis=1, keepdims=True)
    known = np.where(share > 0, theirs / np.maximum(share, NOTHING), grown)
    kept = np.delete(out, at, axis=1).sum(axis=1, keepdims=True)
    out[:, at] = np.maximum(1.0 - kept, 0.0) * (trusted * grown + (1.0 - trusted) * known)
    return out


# ---- training on top of a model ----------------------------------------------------------------------


class Below:
    """A base at work on the training clouds. It has not seen their labels, so no ground need be held out.

    Attributes
    ----------
    context : Context
        What the first pass on top reads of it: of several, the point's own probabilities alone.
    passes, classes, factors
        As :class:`PassRun` takes them.
    """

    def __init__(
        self,
        base: Model,
        clouds: Sequence[TrainingCloud],
        samples: Samples,
        options: TrainingOptions,
        progress: bool,
    ) -> None:
        self.base, self._clouds, self.samples = base, clouds, samples
        self.options, self._progress = options, progress
        self.context = Context((OWN,) if options.passes > 1 else tuple(options.context))
        self.passes, self.classes = base.passes, tuple(map(len, base.codes_of))
        self.factors = (*base.factors_between, base.factors)
        self.trusted = trust(int(np.bincount(samples.label).min()))

    @cached_property
    def columns(self) -> npt.NDArray[np.float32]:
        """What it says around the samples, (samples, columns)."""
        o, samples = self.options, self.samples
        out = np.empty((len(samples), len(self.context.tokens) * len(self.base.classes)), np.float32)
        with Progress(len(samples), "what the base says", enabled=self._progress) as bar:
            for number, cloud in enumerate(self._clouds):
                at, rows = samples.of_cloud(number)
                if not len(at):
                    continue
                request = PredictRequest(cloud.xyz, cloud.dimensions, rows, o.threads, o.memory_mb, bar)
                out[at] = sample_context(request, self.passes, self.context, self.classes, self.factors)
        return out

    def blends(self, labeled: Sequence[int], features: int, reads: Sequence[Context | None]) -> list[Blend]:
        """What passes on top, which compute so many features, make of the one before, whose context they read."""
        o, out, before = self.options, [], self.base.codes.tolist()
        target = o.target if o.strategy == "binary" else None
        for context in reads:
            assert context is not None
            first = own_column(features, context, len(before))
            out.append(Blend(tuple(before), tuple(labeled), self.trusted, target, first))
            before = out[-1].codes
        return out

    @property
    def own(self) -> npt.NDArray[np.float64]:
        """(samples, classes) the base's probabilities of the samples themselves."""
        n = len(self.base.classes)
        first = own_column(0, self.context, n)
        said = self.columns[:, first : first + n].astype(np.float64)
        return said / np.maximum(said.sum(axis=1, keepdims=True), 1e-9)


def on_top(below: Below, made: Model) -> Model:
    """The model of the base's passes and those of `made`, with the classes of both."""
    base, priors = below.base, made.info["priors"]
    reads = [forest.context for forest in made.passes]
    blends = below.blends(made.codes.tolist(), len(made.passes[0].plan.names), reads)
    if len(blends) > 1 and priors is not None:  # a few labels say nothing of how frequent a class is
        blends[-1] = replace(blends[-1], factors=tuple(priors["factors"]))
    added = [
        RefinedForest(one.features, one.forest, one.context, blend)
        for one, blend in zip(made.passes, blends, strict=True)
    ]
    before = blends[-1].codes
    names, entries = dict(base.classes), {one["code"]: one for one in made.info["classes"]}
    names.update((code, name) for code, name in made.classes if code in before and code not in names)
    unseen = {"available": 0, "samples": 0, "duplicates": 0}
    inherited = {one["code"]: {"labels": one["labels"]} for one in base.info["classes"]}
    scores = []
    for codes, one in zip(base.codes_of, base.info["passes"], strict=True):
        scores.append({**one, "codes": codes})
    if base.factors is not None:
        scores[-1]["factors"] = base.factors.tolist()
    info = {
        **made.info,
        "strategy": "multiclass",
        "target": None,
        "background": None,
        "classes": [
            {**unseen, **inherited.get(code, {}), **entries.get(code, {}), "code": code, "name": names[code]}
            for code in before
        ],
        "priors": None,
        "densities": _spanned(base.info.get("densities"), made.info["densities"]),
        "preparation": base.info.get("preparation") or [],
        "passes": [*scores, *made.info["passes"]],
    }
    return Model((*base.passes, *added), [(code, names[code]) for code in before], info, made.seconds)


def held_by_base(below: Below, codes: Sequence[int]) -> dict[str, Any]:
    """Labeled classes new to the base: [different samples, of these what it calls a class that the labels lack].

    Such points stay what the base calls them.
    """
    samples, before = below.samples, below.base.codes.tolist()
    said = np.array(before)[below.own.argmax(axis=1)]
    out = {}
    for place, code in enumerate(codes):
        mine = samples.label == place
        held = int(np.count_nonzero(~np.isin(said[mine], codes)))
        if code not in before and held and below.options.target is None:
            out[str(code)] = [int(np.count_nonzero(mine)), held]
    return {"held_by_base": out} if out else {}


def _spanned(one: Any, other: Any) -> Any:
    """Densities that either was trained for."""
    if one is None or other is None:
        return other
    return {**other, "low": min(one["low"], other["low"]), "high": max(one["high"], other["high"])}
