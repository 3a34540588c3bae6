"""Training on top of a model: what it says of the samples' surroundings, and the model that both make."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.progress import Progress
from .algorithms import PredictRequest
from .clouds import TrainingCloud
from .context import OWN, Context
from .folds import sample_context
from .model import Model
from .refinement import Blend, RefinedForest, own_column, trust
from .sampling import Samples
from .surroundings import Looks, Seen, work_on
from .trainoptions import TrainingOptions


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
        self.factors = (*(_array(one.get("factors")) for one in base.info["passes"][:-1]), base.factors)
        self.trusted = trust(int(np.bincount(samples.label).min()))
        self.short = 0  #: samples whose neighbors lie farther away than the memory allowed to look

    @cached_property
    def columns(self) -> npt.NDArray[np.float32]:
        """What it says around the samples, (samples, columns)."""
        o, samples = self.options, self.samples
        out = np.empty((len(samples), len(self.context.tokens) * len(self.base.classes)), np.float32)
        looks = Looks(self.base.plan, (self.context,))
        with Progress(len(samples), "what the base says", enabled=self._progress) as bar:
            for number, cloud in enumerate(self._clouds):
                at, rows = samples.of_cloud(number)
                if not len(at):
                    continue

                def compute(
                    places: npt.NDArray[np.int64],
                    seen: Seen,
                    again: bool,
                    at: npt.NDArray[np.int64] = at,
                ) -> bool:
                    request = PredictRequest(
                        seen.xyz, seen.dimensions, seen.rows, o.threads, o.memory_mb, None if again else bar
                    )
                    out[at[places]], beyond = sample_context(
                        request, self.passes, self.context, self.classes, self.factors
                    )
                    return beyond

                self.short += work_on(cloud, rows, looks, compute, o.threads)
        return out

    def blend(self, before: Sequence[int], labeled: Sequence[int], features: int, context: Context) -> Blend:
        """What a pass on top makes of the one before, whose classes are `before`; `features` it computes itself."""
        o = self.options
        first = own_column(features, context, len(before))
        target = o.target if o.strategy == "binary" else None
        return Blend(tuple(before), tuple(labeled), self.trusted, target, first)

    @property
    def own(self) -> npt.NDArray[np.float64]:
        """(samples, classes) the base's probabilities of the samples themselves."""
        n = len(self.base.classes)
        first = own_column(0, self.context, n)
        said = self.columns[:, first : first + n].astype(np.float64)
        return said / np.maximum(said.sum(axis=1, keepdims=True), 1e-9)


def on_top(below: Below, made: Model) -> Model:
    """The model of the base's passes and those of `made`, with the classes of both."""
    base, priors, added = below.base, made.info["priors"], []
    before = base.codes.tolist()
    for forest in made.passes:
        shared = {field.name: getattr(forest, field.name) for field in fields(forest)}
        blend = below.blend(before, made.codes.tolist(), len(forest.plan.names), forest.context)
        added.append(RefinedForest(**shared, blend=blend))
        before = blend.codes
    if len(added) > 1 and priors is not None:  # a few labels say nothing of how frequent a class is
        added[-1] = replace(added[-1], blend=replace(blend, factors=tuple(priors["factors"])))
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


def held_by_base(below: Below, codes: Sequence[int]) -> dict[str, list[int]]:
    """Labeled classes new to the base: [different samples, of these what it calls a class that the labels lack].

    Such points stay what the base calls them.
    """
    base, samples = below.base, below.samples
    before = base.codes.tolist()
    said = np.array(before)[below.own.argmax(axis=1)]
    out = {}
    for place, code in enumerate(codes):
        mine = samples.label == place
        held = int(np.count_nonzero(~np.isin(said[mine], codes)))
        if code not in before and held:
            out[str(code)] = [int(np.count_nonzero(mine)), held]
    return out


def _array(given: Any) -> npt.NDArray[np.float64] | None:
    """Numbers of a manifest, or None."""
    return None if given is None else np.array(given)


def _spanned(one: Any, other: Any) -> Any:
    """Densities that either was trained for."""
    if one is None or other is None:
        return other
    return {**other, "low": min(one["low"], other["low"]), "high": max(one["high"], other["high"])}
