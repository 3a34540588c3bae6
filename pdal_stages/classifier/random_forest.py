"""A random forest as plain arrays: grown by scikit-learn, checked, and applied.

Trees are stored level by level (root, its children, theirs, ...). The children of the k-th split
node of a tree (k from 0) are then its nodes 2k+1 and 2k+2, so no child pointers are needed. See
docs/model-file.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt

from ..base.errors import ModelError
from ..base.jit import device, njit
from ..base.json_types import JsonObject
from ..base.progress import Progress
from ..base.threads import map_blocks
from .interface import ArrayRule

if TYPE_CHECKING:
    from .training_options import TrainingOptions

#: Levels below the root a tree may have: a bound for files from strangers.
MAX_DEPTH = 10_000
#: Rows that walk one tree before the next one's turn: their values stay in a core's cache.
#: For speed alone, like SHARE: results do not depend on it.
GROUP = 1024
#: Nodes that more than one in so many rows of a group reach are compared with all rows at once.
SHARE = 16
#: A node as it is walked. A leaf is its own left child under a threshold that is not a number,
#: which nothing exceeds.
_NODE = np.dtype(
    [("threshold", np.float32), ("feature", np.uint32), ("left", np.uint32), ("leaf", np.uint32)]
)


@dataclass(frozen=True, eq=False)
class Forest:
    """A random forest; its probabilities are the mean of its trees' leaf frequencies.

    Trees follow each other, each level by level. ModelError if the arrays are not a forest.
    """

    tree_sizes: npt.NDArray[np.int32]  #: (trees,) nodes of each tree
    feature: npt.NDArray  #: (nodes,) int16 or int32: which a split node compares, -1 in a leaf
    #: (nodes,) a row goes to the left child where its value <= threshold; 0 in a leaf
    threshold: npt.NDArray[np.float32]
    #: (leaves, classes) training samples of each class in each leaf, leaves in the order of their
    #: nodes
    leaf_counts: npt.NDArray[np.uint32]
    n_features: int
    depths: npt.NDArray[np.int32] = field(init=False)

    rules: ClassVar[Mapping[str, ArrayRule]] = {
        "tree_sizes": ArrayRule(("<i4",), 1),
        "feature": ArrayRule(("<i2", "<i4"), 1),
        "threshold": ArrayRule(("<f4",), 1),
        "leaf_counts": ArrayRule(("<u4",), 2),
    }

    def __post_init__(self) -> None:
        """Check the arrays, and lay out the nodes as they are walked."""
        sizes, count = self.tree_sizes, len(self.feature)
        shapes = ", ".join(f"{name} {getattr(self, name).shape}" for name in self.rules)
        if not len(sizes) or not count or len(self.threshold) != count:
            raise ModelError("the forest's arrays do not fit each other", found=shapes)
        if int(sizes.min()) < 1 or int(sizes.sum(dtype=np.int64)) != count:
            raise ModelError("the trees' sizes do not add up to the nodes", found=shapes)
        left, depths = _laid_out(sizes, self.feature, self.threshold, self.n_features)
        leaf = self.feature < 0
        leaves = int(np.count_nonzero(leaf))
        if leaves != len(self.leaf_counts):
            raise ModelError("the number of leaves and the leaf table differ", found=shapes)
        totals = self.leaf_counts.sum(axis=1, dtype=np.uint64)
        if not totals.all():
            raise ModelError("a leaf holds no samples", found=f"leaf {int(np.argmin(totals))}")
        nodes = np.zeros(len(leaf), _NODE)
        nodes["threshold"] = np.where(leaf, np.nan, self.threshold)
        nodes["feature"] = np.where(leaf, 0, self.feature)
        nodes["left"] = left
        nodes["leaf"][leaf] = np.arange(leaves)
        object.__setattr__(self, "depths", depths)
        object.__setattr__(self, "_nodes", nodes)
        object.__setattr__(self, "_shares", self.leaf_counts / totals[:, None].astype(np.float64))

    @property
    def n_classes(self) -> int:
        """Number of classes."""
        return self.leaf_counts.shape[1]

    @property
    def n_trees(self) -> int:
        """Number of trees."""
        return len(self.tree_sizes)

    @classmethod
    def from_sklearn(cls, trees: Sequence[Any], n_features: int) -> Forest:
        """Convert fitted scikit-learn trees.

        `trees` are DecisionTreeClassifiers, trained on float32 features with whole-number sample
        weights (bootstrap counts) and one output.
        """
        parts = [_level_order(tree.tree_) for tree in trees]
        kind = np.int16 if n_features <= np.iinfo(np.int16).max else np.int32
        return cls(
            np.array([len(part[0]) for part in parts], np.int32),
            np.concatenate([part[0] for part in parts]).astype(kind),
            np.concatenate([part[1] for part in parts]),
            np.concatenate([part[2] for part in parts]),
            n_features,
        )

    @classmethod
    def fit(
        cls,
        values: npt.NDArray[np.float32],
        label: npt.NDArray,
        weight: npt.NDArray[np.int64],
        trees: int | Sequence[int],
        options: TrainingOptions,
        progress: Progress | None = None,
    ) -> tuple[Forest, npt.NDArray[np.float64]]:
        """Return a forest and its importances; see :func:`grow_forest`."""
        return grow_forest(values, label, weight, trees, options, progress)

    @classmethod
    def from_arrays(
        cls, arrays: Mapping[str, npt.NDArray], n_features: int, n_classes: int
    ) -> Forest:
        """Return the forest of a model file's arrays; everything about them is checked."""
        if arrays["leaf_counts"].shape[1] != n_classes:
            raise ModelError(
                "the leaf table and the list of classes differ",
                found=f"{arrays['leaf_counts'].shape[1]} and {n_classes} classes",
            )
        # copies: kernels are compiled once more for arrays that cannot be written
        return cls(**{name: np.array(arrays[name]) for name in cls.rules}, n_features=n_features)

    def arrays(self) -> dict[str, npt.NDArray]:
        """Return the arrays that a model file stores."""
        return {name: getattr(self, name) for name in self.rules}

    def parameters(self) -> JsonObject:
        """Return what a manifest says about the forest beside its arrays."""
        return {
            "trees": self.n_trees,
            "nodes": len(self.feature),
            "leaves": len(self.leaf_counts),
            "deepest": int(self.depths.max()),
        }

    def predict_proba(self, values: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
        """Return class probabilities (n, classes) of rows (n, features), as scikit-learn does."""
        values = np.ascontiguousarray(values, dtype=np.float32)
        if values.ndim != 2 or values.shape[1] != self.n_features:
            what = f"the forest takes {self.n_features} features per point"
            raise ModelError(what, found=f"shape {values.shape}")
        out = np.zeros((len(values), self.n_classes))
        walk(values, self.tree_sizes, self._nodes, self._shares, out)  # type: ignore[attr-defined]
        return out / self.n_trees

    def contributions(
        self, values: npt.NDArray[np.float32]
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Return what each feature adds to the probabilities along the paths through the trees.

        A split adds the change of the classes' shares to its feature. Inner nodes have the counts
        of their leaves together.

        Parameters
        ----------
        values : (n, features) float32

        Returns
        -------
        start : (classes,) float64
            Mean shares of the roots.
        added : (n, features, classes) float64
            `start` plus the sum over the features are the probabilities.
        """
        counts = np.zeros((len(self.feature), self.n_classes))
        counts[self.feature < 0] = self.leaf_counts
        nodes = self._nodes  # type: ignore[attr-defined]
        sum_leaves(self.tree_sizes, nodes, counts)
        shares = counts / counts.sum(axis=1, keepdims=True)
        added = np.zeros((len(values), self.n_features, self.n_classes))
        add_along_paths(np.asarray(values, np.float32), self.tree_sizes, nodes, shares, added)
        roots = np.cumsum(self.tree_sizes) - self.tree_sizes
        return shares[roots].mean(axis=0), added / self.n_trees


@njit
def sum_leaves(sizes, nodes, counts):
    """Set the counts (nodes, classes) of inner nodes to the sums of their leaves."""
    end = len(nodes)
    for t in range(len(sizes) - 1, -1, -1):
        start = end - sizes[t]
        for node in range(end - 1, start - 1, -1):
            left = start + nodes[node].left
            if left != node:
                counts[node] = counts[left] + counts[left + 1]
        end = start


@njit
def add_along_paths(values, sizes, nodes, shares, added):
    """Add the changes of the shares (nodes, classes) of each split to `added`, for rows."""
    start = 0
    for t in range(len(sizes)):
        for row in range(len(values)):
            at = start
            while start + nodes[at].left != at:
                node = nodes[at]
                right = np.uint32(values[row, node.feature] > node.threshold)
                to = start + node.left + right
                added[row, node.feature] += shares[to] - shares[at]
                at = to
        start += sizes[t]


@njit
def walk(values, sizes, nodes, shares, out):
    """Add the class frequencies of all trees to `out` (n, classes), for rows (n, features).

    Most rows of a tree go through few nodes. There all rows of a group are compared in vector
    registers, wherever they are; from there on the rows walk by themselves, in rounds of a node
    each, so that no row waits for another.
    """
    n, width = values.shape
    columns = np.empty((width, min(n, GROUP)), np.float32)
    at, active = np.empty(GROUP, np.uint32), np.empty(GROUP, np.uint16)
    stack = np.empty((SHARE, 2), np.uint32)
    for first in range(0, n, GROUP):
        count = min(n - first, GROUP)
        copy_columns(values, first, count, columns)
        start = np.uint64(0)
        for t in range(len(sizes)):
            at[:count] = 0
            walk_together(columns, nodes, start, at, stack, count)
            walk_alone(columns, nodes, start, at, active, count)
            for r in range(count):
                leaf, row = nodes[start + at[r]].leaf, np.uint64(first + r)
                for c in range(np.uint64(out.shape[1])):
                    out[row, c] += shares[leaf, c]
            start += np.uint64(sizes[t])


@device
def copy_columns(values, first, count, columns):
    """Copy `count` rows of `values` from `first` on to `columns` (features, rows), by tiles."""
    for low in range(0, count, 8):
        for c in range(len(columns)):
            for r in range(low, min(low + 8, count)):
                columns[c, r] = values[first + r, c]


@device
def walk_together(columns, nodes, start, at, stack, count):
    """Move rows through the nodes of a tree that more than one in SHARE of them reach.

    `at` (rows,) are the nodes where rows are, 0 before. Nodes on the stack hold different rows, so
    these are fewer than SHARE.
    """
    least = np.uint32(count // SHARE + 1)
    stack[0, 0], stack[0, 1] = 0, count
    top = 1
    while top > 0:
        top -= 1
        place, rows = stack[top, 0], stack[top, 1]
        node = nodes[start + place]
        right = step(columns[node.feature], node.threshold, place, node.left, at, count)
        for side in range(2):
            child = np.uint32(node.left + side)
            reached = right if side else np.uint32(rows - right)
            if reached >= least and nodes[start + child].left != child:
                stack[top, 0], stack[top, 1] = child, reached
                top += 1


@device
def step(column, threshold, place, left, at, count):
    """Move the rows that are at a node to its children; return how many went to the right one."""
    right = np.uint32(0)
    for r in range(count):
        here = at[r] == place
        exceeds = np.uint32(column[r] > threshold)
        right += exceeds if here else np.uint32(0)
        at[r] = left + exceeds if here else at[r]
    return right


@device
def walk_alone(columns, nodes, start, at, active, count):
    """Move rows from the nodes where they are to leaves; `active` is scratch."""
    for r in range(count):
        active[r] = r
    remaining = np.uint64(count)
    while remaining > 0:
        moved = np.uint64(0)
        for i in range(remaining):
            r = active[i]
            node = nodes[start + at[r]]
            to = np.uint32(node.left + np.uint32(columns[node.feature, r] > node.threshold))
            # Written always, kept if it moved: no branch to mispredict.
            active[moved] = r
            moved += np.uint64(to != at[r])
            at[r] = to
        remaining = moved


def _laid_out(
    sizes, feature, threshold, n_features: int
) -> tuple[npt.NDArray[np.uint32], npt.NDArray[np.int32]]:
    """Return the left child of each node within its tree, and the depth of each tree.

    A leaf is its own child. ModelError where the nodes are not trees.

    Trees are stored level by level, so the children of a tree's k-th split node are its nodes 2k+1
    and 2k+2: no child pointers are stored, and no file can hold a cycle or a shared child.
    """
    end = np.cumsum(sizes, dtype=np.int64)
    start = end - sizes
    tree = np.repeat(np.arange(len(sizes)), sizes)
    node = np.arange(len(feature)) - start[tree]

    def refuse(bad: npt.NDArray[np.bool_], what: str) -> None:
        if bad.any():
            first = int(np.argmax(bad))
            raise ModelError(what, found=f"tree {tree[first]}, node {node[first]}")

    split = feature >= 0
    unknown = (feature < -1) | (feature >= n_features)
    refuse(unknown, "a node asks for a feature that does not exist")
    refuse(split & ~np.isfinite(threshold), "a threshold is not a finite number")
    splits = np.concatenate(([0], np.cumsum(split)))  # before each node, in all trees
    before = splits[:-1] - splits[start][tree]
    refuse(node > 2 * before, "a tree has nodes without a parent")
    short = sizes != 2 * (splits[end] - splits[start]) + 1
    refuse(short[tree] & (node == sizes[tree] - 1), "a tree ends before all its branches do")
    depths = np.zeros(len(sizes), np.int32)
    level = np.minimum(start + 1, end)  # where the next one begins
    while (deeper := level < end).any():
        depths += deeper
        if depths.max() > MAX_DEPTH:
            deep = int(np.argmax(depths))
            raise ModelError(f"a tree is deeper than {MAX_DEPTH} levels", found=f"tree {deep}")
        level = start + 2 * (splits[level] - splits[start]) + 1
    return np.where(split, 2 * before + 1, node).astype(np.uint32), depths


def _level_order(tree) -> tuple[npt.NDArray, npt.NDArray[np.float32], npt.NDArray[np.uint32]]:
    """Return feature, threshold and leaf counts of a scikit-learn tree, level by level."""
    shares = tree.value[:, 0, :]
    # scikit-learn keeps shares (before 1.3: counts) and the weight of a node; bootstrap weights are
    # whole.
    shares = shares / shares.sum(axis=1, keepdims=True)
    counts = np.rint(shares * tree.weighted_n_node_samples[:, None])
    left, right = tree.children_left, tree.children_right
    levels = [np.zeros(1, np.int64)]
    while len(splits := levels[-1][left[levels[-1]] >= 0]):
        levels.append(np.column_stack([left[splits], right[splits]]).reshape(-1))
    order = np.concatenate(levels)
    leaf = left[order] < 0
    return (
        np.where(leaf, -1, tree.feature[order]),
        np.where(leaf, 0.0, float32_at_most(tree.threshold[order])).astype(np.float32),
        counts[order[leaf]].astype(np.uint32),
    )


def float32_at_most(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float32]:
    """Return the largest float32 <= each float64: a float32 compares alike with either."""
    near = values.astype(np.float32)
    return np.where(near > values, np.nextafter(near, np.float32(-np.inf)), near)


def grow_forest(
    values: npt.NDArray[np.float32],
    label: npt.NDArray,
    weight: npt.NDArray[np.int64],
    trees: int | Sequence[int],
    growth: TrainingOptions,
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
    growth : TrainingOptions
        Its seed, threads, vote, and what bounds a tree.

    Returns
    -------
    Forest, (features,) float64
        The forest, and the features' importances, which sum to 1, or to 0.
    """
    grow = partial(_grow_tree, values, label, weight, growth)
    counts = [trees] if isinstance(trees, int) else sorted(trees)
    grown: list[Any] = []
    accuracy: dict[int, float] = {}  # out of the bag, by number of trees
    shares = np.zeros((len(label), int(label.max()) + 1))
    for tree, rows in map_blocks(grow, range(counts[-1]), growth.threads):
        grown.append(tree)
        if len(counts) > 1:
            shares[rows] += tree.predict_proba(values[rows])
            if len(grown) in counts:
                accuracy[len(grown)] = _share_right(shares, label, weight)
        if progress is not None:
            progress.update(1)
    if accuracy:
        grown = grown[: max(accuracy, key=lambda number: (accuracy[number], -number))]
    importances = np.sum([tree.feature_importances_ for tree in grown], axis=0)
    forest = Forest.from_sklearn(grown, values.shape[1])
    if growth.vote == "majority":
        forest = replace(forest, leaf_counts=_give_to_winners(forest.leaf_counts))
    return forest, importances / (importances.sum() or 1.0)


def _grow_tree(
    values: npt.NDArray[np.float32],
    label: npt.NDArray,
    weight: npt.NDArray[np.int64],
    growth: TrainingOptions,
    number: int,
) -> tuple[Any, npt.NDArray[np.bool_]]:
    """Return a tree by its number, and which samples (n,) are out of its bag."""
    from sklearn.tree import DecisionTreeClassifier

    root, ends = max(1, math.isqrt(values.shape[1])), np.cumsum(weight)
    draws = max(1, round((growth.max_samples or 1.0) * int(ends[-1])))
    random = np.random.default_rng([growth.seed, number])
    drawn = np.searchsorted(ends, random.integers(0, ends[-1], draws), side="right")
    bag = np.bincount(drawn, minlength=len(weight)).astype(np.float64)
    tree = DecisionTreeClassifier(
        random_state=int(random.integers(0, 2**31 - 1)),
        max_features=root if growth.max_features == "sqrt" else max(root, values.shape[1] // 10),
        max_depth=root if growth.max_depth == "sqrt" else None,
        min_samples_leaf=growth.min_samples_leaf,
    )
    tree.fit(values, label, sample_weight=bag, check_input=False)
    return tree, (bag == 0) & (weight > 0)


def _share_right(
    shares: npt.NDArray[np.float64], label: npt.NDArray, weight: npt.NDArray[np.int64]
) -> float:
    """Return the share of samples whose class (n,) has the largest sum of probabilities.

    Samples without any probability, (n, classes), are not counted.
    """
    judged = weight * shares.any(axis=1)
    return float((shares.argmax(axis=1) == label) @ judged) / max(1, int(judged.sum()))


def _give_to_winners(leaf_counts: npt.NDArray[np.uint32]) -> npt.NDArray[np.uint32]:
    """Give all samples of each leaf (leaves, classes) to its most frequent class.

    A tree then casts one vote, and the mean over the trees is the share of votes.
    """
    out = np.zeros_like(leaf_counts)
    rows = np.arange(len(out))
    out[rows, leaf_counts.argmax(axis=1)] = leaf_counts.sum(axis=1)
    return out
