"""A forest on top of a trained model: classes that only the base knows keep its probability.

Of the other classes the forest is believed the more, the more labels it was trained on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import ModelError
from .interface import weigh

#: As many labeled points of its rarest class count as much as the base.
EVEN = 30
#: Probabilities that cannot be divided by.
NOTHING = 1e-300


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
        grown = weigh(grown, None if self.factors is None else np.array(self.factors))
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
