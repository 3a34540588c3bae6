"""Growing the trees of a forest, each on a bootstrap sample.

A sample that counts w times is drawn as if it were there w times, and such copies are all in the bag or all out
of it: the out-of-bag score would be far too good otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.progress import Progress
from ..base.threads import map_blocks
from .trees import GrownTree, Ranked, grow_tree


@dataclass(frozen=True)
class TreeOptions:
    """How each tree is grown; see ``TrainingOptions``."""

    max_depth: int | None = None
    min_samples_leaf: int = 1
    max_samples: float = 1.0
    max_features: str | int | float = "auto"

    def tried(self, features: int) -> int:
        """How many features are tried at a split; by default a tenth of them, but at least their root."""
        asked = self.max_features
        if asked == "auto":
            return max(1, math.isqrt(features), features // 10)
        if asked == "sqrt":
            return max(1, math.isqrt(features))
        if asked == "log2":
            return max(1, features.bit_length() - 1)
        return (
            max(1, int(asked * features))
            if isinstance(asked, float | np.floating)
            else min(int(asked), features)
        )


def grow(
    ranked: Ranked,
    label: npt.NDArray[Any],
    weight: npt.NDArray[np.int64],
    n_trees: int,
    options: TreeOptions,
    seed: int,
    *,
    score: npt.NDArray[np.int64] | str | None = None,
    every: int = 1,
    threads: int | None = None,
    progress: Progress | None = None,
) -> Iterator[tuple[GrownTree, npt.NDArray[np.int64], npt.NDArray[np.float64]]]:
    """Grow trees, one after the other, and apply each to the rows it should be judged by.

    Parameters
    ----------
    ranked : Ranked
        Of n samples.
    label : (n,) int
        Class positions; every class occurs, if only with weight 0.
    weight : (n,) int
        Times a row counts; rows of weight 0 take no part.
    score : array of rows, or "out of bag", or None
        Rows to apply each tree to. Out of bag: those of positive weight not in its bootstrap sample.
    every : int
        Out of bag: of every so many rows, one is judged by all trees that have not drawn it, the others by none.

    Yields
    ------
    tree : GrownTree
    rows : (m,) int64
    shares : (m, classes) float64
        The tree's class frequencies for those rows.
    """
    ends = np.cumsum(weight)
    draws = max(1, round(options.max_samples * int(ends[-1])))
    labels = np.asarray(label, dtype=np.int64)

    def one(number: int):
        random = np.random.default_rng([seed, number])
        drawn = np.searchsorted(ends, random.integers(0, ends[-1], draws), side="right")
        bag = np.bincount(drawn, minlength=len(weight))
        tree = grow_tree(
            ranked,
            labels,
            bag,
            options.tried(ranked.columns),
            int(random.integers(0, 2**31 - 1)),
            max_depth=options.max_depth,
            min_samples_leaf=options.min_samples_leaf,
        )
        rows = np.zeros(0, np.int64)
        if isinstance(score, str):
            rows = np.flatnonzero((bag[::every] == 0) & (weight[::every] > 0)) * every
        elif score is not None:
            rows = score
        return tree, rows, tree.shares(ranked, rows)

    for tree in map_blocks(one, range(n_trees), threads):
        if progress is not None:
            progress.update(1)
        yield tree
