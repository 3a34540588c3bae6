"""Training on top of a model: what it says of the samples' surroundings, and the model that both make."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.progress import Progress
from .algorithms import PredictRequest
from .clouds import TrainingCloud
from .context import OWN, Context
from .folds import ContextOnly, context_of
from .model import Model
from .passes import PassRun
from .refinement import RefinedForest, trust
from .sampling import Samples
from .surroundings import Looks, Seen, work_on
from .trainoptions import TrainingOptions

__all__ = ["Below", "held_by_base", "on_top", "trust"]


class Below:
    """A base at work on the training clouds. It has not seen their labels, so no ground need be held out."""

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
        self.short = 0  #: samples whose neighbors lie farther away than the memory allowed to look

    @cached_property
    def columns(self) -> npt.NDArray[np.float32]:
        """What it says around the samples, (samples, columns)."""
        context, o, samples = Context(tuple(self.options.context)), self.options, self.samples
        classes = [*map(len, self.base.codes_of), len(self.base.classes)]
        out = np.empty((len(samples), len(context.tokens) * len(self.base.classes)), np.float32)
        factors = [*(_array(one.get("factors")) for one in self.base.info["passes"]), None]
        factors[len(self.base.passes) - 1] = self.base.factors
        looks = Looks(self.base.plan, (context,))
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
                    shown = None if again else bar
                    request = PredictRequest(
                        seen.xyz, seen.dimensions, seen.rows, o.threads, o.memory_mb, shown
                    )
                    run = PassRun([*self.base.passes, ContextOnly(context)], classes, request, factors)
                    mine = np.empty((len(seen.rows), out.shape[1]), np.float32)
                    out[at[places]] = context_of(run, seen.rows, mine)
                    return bool(run.report.beyond_halo)

                self.short += work_on(cloud, rows, looks, compute, o.threads)
        return out

    @property
    def own(self) -> npt.NDArray[np.float64]:
        """(samples, classes) the base's probabilities of the samples themselves."""
        n = len(self.base.classes)
        first = Context(tuple(self.options.context)).tokens.index(OWN) * n
        said = self.columns[:, first : first + n].astype(np.float64)
        return said / np.maximum(said.sum(axis=1, keepdims=True), 1e-9)


def on_top(base: Model, made: Model, trusted: float) -> Model:
    """The model of the base's passes and the one pass of `made`, with the classes of both."""
    (forest,) = made.passes
    target = made.info["target"]
    shared = {field.name: getattr(forest, field.name) for field in fields(forest)}
    before, labeled = tuple(base.codes.tolist()), tuple(made.codes.tolist())
    refined = RefinedForest(**shared, before=before, labeled=labeled, trusted=trusted, target=target)
    names, entries = dict(base.classes), {one["code"]: one for one in made.info["classes"]}
    names.update((code, name) for code, name in made.classes if code in refined.codes and code not in names)
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
            for code in refined.codes
        ],
        "priors": None,
        "densities": _spanned(base.info.get("densities"), made.info["densities"]),
        "preparation": base.info.get("preparation") or [],
        "passes": [*scores, *made.info["passes"]],
    }
    return Model((*base.passes, refined), [(code, names[code]) for code in refined.codes], info, made.seconds)


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
