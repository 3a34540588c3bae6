"""Growing a random forest: each tree on a bootstrap sample of its own, by scikit-learn."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.progress import Progress
from ..base.threads import map_blocks
from .random_forest import Forest


@dataclass(frozen=True)
class Growth:
    """Options of growing trees; see ``TrainingOptions``."""

    seed: int
    min_samples_leaf: int = 1
    max_samples: float = 1.0  #: share of the samples drawn for a tree
    max_features: str | int | float = "auto"  #: features tried at each split
    max_depth: str | int | None = None
    vote: str = "mean"
    threads: int | None = None

    def features_per_split(self, features: int) -> Any:
        """Return scikit-learn's `max_features` for a number of features."""
        if self.max_features == "auto":
            return max(1, math.isqrt(features), features // 10)
        if isinstance(self.max_features, int | np.integer):
            return min(int(self.max_features), features)
        return self.max_features

    def depth(self, features: int) -> int | None:
        """Return scikit-learn's `max_depth` for a number of features."""
        if self.max_depth == "sqrt":
            return max(1, math.isqrt(features))
        return self.max_depth  # type: ignore[return-value]


@dataclass(frozen=True, eq=False)
class _Samples:
    """Samples that all trees are grown on.

    :meth:`grow_tree` is called in worker threads.
    """

    values: npt.NDArray[np.float32]
    label: npt.NDArray[Any]
    weight: npt.NDArray[np.int64]
    growth: Growth

    def grow_tree(self, number: int) -> tuple[Any, npt.NDArray[np.bool_]]:
        """Return the tree of a number, and which samples (n,) are out of its bag."""
        from sklearn.tree import DecisionTreeClassifier

        growth, features = self.growth, self.values.shape[1]
        random = np.random.default_rng([growth.seed, number])
        ends = np.cumsum(self.weight)
        draws = max(1, round(growth.max_samples * int(ends[-1])))
        drawn = np.searchsorted(ends, random.integers(0, ends[-1], draws), side="right")
        bag = np.bincount(drawn, minlength=len(self.weight)).astype(np.float64)
        tree = DecisionTreeClassifier(
            max_features=growth.features_per_split(features),
            max_depth=growth.depth(features),
            min_samples_leaf=growth.min_samples_leaf,
            random_state=int(random.integers(0, 2**31 - 1)),
        )
        tree.fit(self.values, self.label, sample_weight=bag, check_input=False)
        return tree, (bag == 0) & (self.weight > 0)


@dataclass
class _OutOfBag:
    """Sums of the probabilities that trees give to samples out of their bags."""

    samples: _Samples
    accuracy: dict[int, float] = field(default_factory=dict)  #: by number of trees

    def __post_init__(self) -> None:
        """Begin with no tree."""
        label = self.samples.label
        self._shares = np.zeros((len(label), int(label.max()) + 1))

    def add(self, tree: Any, rows: npt.NDArray[np.bool_]) -> None:
        """Add the probabilities of a tree at the rows (n,) out of its bag."""
        self._shares[rows] += tree.predict_proba(self.samples.values[rows])

    def score(self, trees: int) -> None:
        """Store the accuracy of the trees so far."""
        judged = self.samples.weight * self._shares.any(axis=1)
        right = self._shares.argmax(axis=1) == self.samples.label
        self.accuracy[trees] = float(right @ judged) / max(1, int(judged.sum()))

    def best(self) -> int:
        """Return the number of trees of the highest accuracy, of equal ones the smallest."""
        return max(self.accuracy, key=lambda trees: (self.accuracy[trees], -trees))


def grow_forest(
    values: npt.NDArray[np.float32],
    label: npt.NDArray[Any],
    weight: npt.NDArray[np.int64],
    trees: int | Sequence[int],
    growth: Growth,
    progress: Progress | None = None,
) -> tuple[Forest, npt.NDArray[np.float64]]:
    """Grow a random forest, each tree on its own bootstrap sample.

    Parameters
    ----------
    values : (n, features) float32
        Finite; in Fortran order trees grow faster.
    label : (n,) int
        Class positions; every class occurs, if only with weight 0.
    weight : (n,) int
        Times a row counts; rows of weight 0 take no part.
    trees : int or sequence of int
        Number of trees; of several numbers the one with the highest out-of-bag accuracy [B16 4.2].
    growth : Growth
    progress : Progress, optional

    Returns
    -------
    Forest, (features,) float64
        The forest, and the features' importances, which sum to 1, or to 0.
    """
    counts = [trees] if isinstance(trees, int) else sorted(trees)
    samples = _Samples(values, label, weight, growth)
    out_of_bag = _OutOfBag(samples) if len(counts) > 1 else None
    grown: list[Any] = []
    for tree, rows in map_blocks(samples.grow_tree, range(counts[-1]), growth.threads):
        grown.append(tree)
        if out_of_bag is not None:
            out_of_bag.add(tree, rows)
            if len(grown) in counts:
                out_of_bag.score(len(grown))
        if progress is not None:
            progress.update(1)
    if out_of_bag is not None:
        grown = grown[: out_of_bag.best()]
    importances = np.sum([tree.feature_importances_ for tree in grown], axis=0)
    forest = Forest.from_sklearn([tree.tree_ for tree in grown], values.shape[1])
    if growth.vote == "majority":
        forest = replace(forest, leaf_counts=_give_to_winners(forest.leaf_counts))
    return forest, importances / (importances.sum() or 1.0)


def _give_to_winners(leaf_counts: npt.NDArray[np.uint32]) -> npt.NDArray[np.uint32]:
    """Give all samples of each leaf (leaves, classes) to its most frequent class.

    A tree then casts one vote, and the mean over the trees is the share of votes.
    """
    out = np.zeros_like(leaf_counts)
    rows = np.arange(len(out))
    out[rows, leaf_counts.argmax(axis=1)] = leaf_counts.sum(axis=1)
    return out
