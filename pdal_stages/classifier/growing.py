"""Growing the trees: scikit-learn's decision trees under a bootstrap of our own.

The bootstrap is drawn here rather than in scikit-learn's forest so that a sample that counts w times is drawn
as if it were there w times (its releases differ in that), so that such copies are all in the bag or all out
of it (the out-of-bag score would be far too good otherwise), and so that progress can be shown.
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

#: Rows scored in one go: a copy of them is made.
_ROWS = 8192


@dataclass(frozen=True)
class TreeOptions:
    """How each tree is grown; see ``TrainingOptions``."""

    max_depth: int | None = None
    min_samples_leaf: int = 1
    max_samples: float = 1.0
    max_features: str | int | float = "auto"

    def tried(self, features: int) -> str | int | float:
        """What scikit-learn is told to try at a split: a tenth of the features, but at least their root."""
        if self.max_features != "auto":
            return self.max_features
        return max(1, math.isqrt(features), features // 10)


def grow(
    values: npt.NDArray[np.float32],
    label: npt.NDArray[Any],
    weight: npt.NDArray[np.int64],
    n_trees: int,
    options: TreeOptions,
    seed: int,
    *,
    score: npt.NDArray[np.int64] | str | None = None,
    threads: int | None = None,
    progress: Progress | None = None,
) -> Iterator[tuple[Any, npt.NDArray[np.int64], npt.NDArray[np.float64]]]:
    """Grow trees, one after the other, and apply each to the rows it should be judged by.

    Parameters
    ----------
    values : (n, features) float32
        Not copied.
    label : (n,) int
        Class positions; every class occurs, if only with weight 0.
    weight : (n,) int
        Times a row counts; rows of weight 0 take no part.
    score : array of rows, or "out of bag", or None
        Rows to apply each tree to. Out of bag: those of positive weight not in its bootstrap sample.

    Yields
    ------
    tree : sklearn.tree.DecisionTreeClassifier
    rows : (m,) int64
    shares : (m, classes) float64
        The tree's class frequencies for those rows.
    """
    from sklearn.tree import DecisionTreeClassifier

    ends = np.cumsum(weight)
    draws = max(1, round(options.max_samples * int(ends[-1])))
    labels = np.asarray(label, dtype=np.int64)

    def one(number: int):
        random = np.random.default_rng([seed, number])
        drawn = np.searchsorted(ends, random.integers(0, ends[-1], draws), side="right")
        bag = np.bincount(drawn, minlength=len(weight)).astype(np.float64)
        tree = DecisionTreeClassifier(
            max_depth=options.max_depth,
            min_samples_leaf=options.min_samples_leaf,
            max_features=options.tried(values.shape[1]),
            random_state=int(random.integers(0, 2**31 - 1)),
        )
        tree.fit(values, labels, sample_weight=bag, check_input=False)
        rows = np.zeros(0, np.int64)
        if isinstance(score, str):
            rows = np.flatnonzero((bag == 0) & (weight > 0))
        elif score is not None:
            rows = score
        shares = np.empty((len(rows), len(tree.classes_)))
        for start in range(0, len(rows), _ROWS):
            part = slice(start, start + _ROWS)
            shares[part] = tree.predict_proba(np.ascontiguousarray(values[rows[part]]), check_input=False)
        return tree, rows, shares

    for tree in map_blocks(one, range(n_trees), threads):
        if progress is not None:
            progress.update(1)
        yield tree
