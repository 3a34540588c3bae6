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

#: Labeled points of the rarest class with which a forest counts as much as its base (not
#: tuned).
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

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any], codes: Sequence[int]) -> Blend:
        """Return the blend that a manifest describes for a pass whose classes are `codes`.

        ModelError where its classes contradict each other.
        """
        blend = cls(tuple(entry["before"]), tuple(entry["labeled"]), float(entry["trusted"]))
        ascending = all(sorted(set(each)) == list(each) for each in (blend.before, blend.labeled))
        if not ascending or blend.codes != list(codes):
            raise ModelError("classes of a refined forest do not fit", found=str(entry)[:100])
        return blend

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of a manifest."""
        classes = {"before": list(self.before), "labeled": list(self.labeled)}
        return {**classes, "trusted": self.trusted}

    @property
    def codes(self) -> list[int]:
        """Classes of the result."""
        return sorted({*self.before, *self.labeled})

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
        out = np.zeros((len(base), len(self.codes)))
        out[:, np.searchsorted(self.codes, self.before)] = base
        columns = np.searchsorted(self.codes, self.labeled)
        by_base = out[:, columns]
        share = by_base.sum(axis=1, keepdims=True)
        by_base = np.where(share > 0, by_base / np.maximum(share, _SMALLEST), forest)
        kept = np.delete(out, columns, axis=1).sum(axis=1, keepdims=True)
        mixed = self.trusted * forest + (1.0 - self.trusted) * by_base
        out[:, columns] = np.maximum(1.0 - kept, 0.0) * mixed
        return out


def trust(labels: int) -> float:
    """Return the weight of a forest beside its base, by the labeled points of its rarest class."""
    return labels / (labels + EVEN)


def describe_refinement(
    base: Any, info: Mapping[str, Any], names: Mapping[int, str], codes: Sequence[int]
) -> dict[str, Any]:
    """Return the manifest's entries for a model that is a base's passes and a forest on top.

    Parameters
    ----------
    base : Model
    info : mapping
        The entries that training of the forest on top gives alone.
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
    both = info["densities"], base.info["densities"]
    low, high = min(each["low"] for each in both), max(each["high"] for each in both)
    return {
        **info,
        "strategy": "multiclass",
        "target": None,
        "background": None,
        "classes": classes,
        "priors": None,
        "densities": {"low": low, "high": high},
        "preparation": base.preparation,
        "algorithms": base.info["algorithms"],
        "passes": [*scores, *info["passes"]],
    }
