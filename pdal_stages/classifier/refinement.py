"""A forest that refines a trained model, its base: classes that only the base knows stay.

Of the other classes the forest counts the more, the more labels it was trained on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import ModelError
from .interface import weigh

#: Labeled points of the rarest class with which a forest counts as much as its base.
EVEN = 30
#: Least sum of probabilities that is divided by.
_SMALLEST = 1e-300


@dataclass(frozen=True, eq=False)
class Blend:
    """Rule that joins the probabilities of the pass before and of a forest."""

    before: tuple[int, ...]  #: classes of the pass before
    labeled: tuple[int, ...]  #: classes of the forest, in the order of its columns
    #: weight of the forest, 0 to 1, where both know a class; the base has the rest
    trusted: float = 1.0
    #: with the binary strategy the one class that is changed; the other of `labeled` is all else
    target: int | None = None
    #: factors of the forest's probabilities by the classes' frequency
    factors: tuple[float, ...] | None = None

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any], codes: Sequence[int]) -> Blend:
        """Return the blend that a manifest describes for a pass whose classes are `codes`.

        ModelError where its classes contradict each other.
        """
        factors = entry.get("factors")
        blend = cls(
            tuple(entry["before"]),
            tuple(entry["labeled"]),
            float(entry["trusted"]),
            entry.get("target"),
            None if factors is None else tuple(map(float, factors)),
        )
        labeled, target = blend.labeled, blend.target
        good = blend.codes == list(codes) and len(blend.factors or labeled) == len(labeled)
        good &= all(sorted(set(each)) == list(each) for each in (blend.before, labeled))
        if not good or (target is not None and (target not in labeled or len(labeled) != 2)):
            raise ModelError(
                "a refined forest's classes do not fit each other", found=str(entry)[:100]
            )
        return blend

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of a manifest."""
        classes = {"before": list(self.before), "labeled": list(self.labeled)}
        factors = {"factors": list(self.factors)} if self.factors else {}
        return {**classes, "trusted": self.trusted, **factors, "target": self.target}

    @property
    def codes(self) -> list[int]:
        """Classes of the result."""
        return sorted({*self.before, *(self.labeled if self.target is None else (self.target,))})

    def __call__(
        self, base: npt.NDArray[np.float64], forest: npt.NDArray[np.float64]
    ) -> npt.NDArray[np.float64]:
        """Return probabilities (n, classes) in the order of :attr:`codes`.

        Parameters
        ----------
        base : (n, before) float64
            Probabilities of the pass before. Classes that only it knows keep theirs, and the
            labeled ones share the rest.
        forest : (n, labeled) float64
            Probabilities of the forest.
        """
        forest = weigh(forest, None if self.factors is None else np.array(self.factors))
        out = np.zeros((len(base), len(self.codes)))
        out[:, np.searchsorted(self.codes, self.before)] = base
        if self.target is not None:
            by_forest = forest[:, self.labeled.index(self.target)]
            return self._change_target(out, self.codes.index(self.target), by_forest)
        columns = np.searchsorted(self.codes, self.labeled)
        by_base = out[:, columns]
        share = by_base.sum(axis=1, keepdims=True)
        by_base = np.where(share > 0, by_base / np.maximum(share, _SMALLEST), forest)
        kept = np.delete(out, columns, axis=1).sum(axis=1, keepdims=True)
        mixed = self.trusted * forest + (1.0 - self.trusted) * by_base
        out[:, columns] = np.maximum(1.0 - kept, 0.0) * mixed
        return out

    def _change_target(
        self, out: npt.NDArray[np.float64], column: int, target: npt.NDArray[np.float64]
    ) -> npt.NDArray[np.float64]:
        """Give a column of `out` the forest's probabilities (n,), and the others the rest."""
        if self.target in self.before:
            target = self.trusted * target + (1.0 - self.trusted) * out[:, column]
        out[:, column] = 0.0
        rest = out.sum(axis=1)
        target = np.where(rest > _SMALLEST, target, 1.0)  # the base knows of nothing else there
        out *= ((1.0 - target) / np.maximum(rest, _SMALLEST))[:, None]
        out[:, column] = target
        return out


def trust(labels: int) -> float:
    """Return the weight of a forest beside its base, by the labeled points of its rarest class."""
    return labels / (labels + EVEN)


def describe_refinement(
    base: Any, info: Mapping[str, Any], names: Mapping[int, str], codes: Sequence[int]
) -> dict[str, Any]:
    """Return the manifest's entries for a model that is a base's passes and others on top.

    Parameters
    ----------
    base : Model
    info : mapping
        The entries that training of the passes on top gives alone.
    names : mapping of int to str
        Name of each class.
    codes : sequence of int
        Classes of the last pass.
    """
    counts = {"available": 0, "samples": 0, "duplicates": 0}
    inherited = {entry["code"]: {"labels": entry["labels"]} for entry in base.info["classes"]}
    trained = {entry["code"]: entry for entry in info["classes"]}
    classes = [
        {**counts, **inherited.get(code, {}), **trained.get(code, {})}
        | {"code": code, "name": names[code]}
        for code in codes
    ]
    scores = [
        {**entry, "codes": own_codes}
        for own_codes, entry in zip(base.codes_of, base.info["passes"], strict=True)
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
        "classes": classes,
        "priors": None,
        "densities": densities,
        "preparation": base.preparation,
        "algorithms": base.info.get("algorithms", {}),
        "passes": [*scores, *info["passes"]],
    }
