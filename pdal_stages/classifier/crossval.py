"""Spatial cross-validation: whole blocks of ground are held out, with a gap around them.

Neighboring points share most of their neighborhood and so nearly all of their features. Points drawn at
random for validation are therefore half known already, and the score says little about another place.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ..accuracy.measures import Accuracy
from ..base.errors import OptionError
from ..base.progress import Progress
from .growing import TreeOptions, grow
from .trees import Ranked

#: A smaller forest is preferred if its mean F1 is within this of the best.
TOLERANCE = 0.002
#: Rows handed to scikit-learn to deal out blocks.
_DEALT = 50_000


def block_folds(
    xy: npt.NDArray[np.float64],
    label: npt.NDArray[Any],
    weight: npt.NDArray[Any],
    folds: int,
    block_size: float,
) -> npt.NDArray[np.int16]:
    """The fold of each sample: blocks of ground, dealt out so that every fold has its share of each class.

    Parameters
    ----------
    xy : (n, 2) float64
        In meters. Blocks are anchored to absolute coordinates: clouds that overlap share them.
    label, weight : (n,) int
        Class position of each sample and how often it counts.
    folds : int
    block_size : float
        Meters.

    Returns
    -------
    (n,) int16
    """
    cell = np.floor(xy / block_size).astype(np.int64)
    blocks, block = np.unique(cell, axis=0, return_inverse=True)
    block = block.reshape(-1)
    if len(blocks) < folds:
        raise OptionError(
            f"the samples cover {len(blocks)} block(s) of {block_size:g} m, fewer than the {folds} folds",
            found=f"block_size {block_size:g}, folds {folds}",
            cure="Make block_size or folds smaller, or give more training data",
        )
    from sklearn.model_selection import StratifiedGroupKFold

    content = np.zeros((len(blocks), int(label.max()) + 1))
    np.add.at(content, (block, label), weight)
    # scikit-learn counts rows one by one, in Python: as many as tell the blocks' shares well enough.
    rows = np.ceil(content * min(1.0, _DEALT / content.sum())).astype(np.int64)
    of_block, of_class = (np.repeat(index.reshape(-1), rows.reshape(-1)) for index in np.indices(rows.shape))
    fold_of = np.full(len(blocks), -1, np.int16)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of a class with fewer rows than folds
        deal = StratifiedGroupKFold(folds).split(of_block, of_class, of_block)
        for number, (_, held) in enumerate(deal):
            fold_of[of_block[held]] = number
    return fold_of[block]


def split(
    xy: npt.NDArray[np.float64], fold: npt.NDArray[Any], number: int, gap: float
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.int64]]:
    """(training mask, validation rows) of one fold; none of the former is within `gap` of the latter."""
    from scipy.spatial import cKDTree

    held = fold == number
    train = ~held
    if gap > 0 and held.any():
        others = np.flatnonzero(train)
        distance, _ = cKDTree(xy[held]).query(xy[others], distance_upper_bound=np.nextafter(gap, np.inf))
        train[others[distance <= gap]] = False
    return train, np.flatnonzero(held)


def search(
    ranked: Ranked,
    label: npt.NDArray[Any],
    weight: npt.NDArray[np.int64],
    xy: npt.NDArray[np.float64],
    codes: Sequence[int],
    candidates: Sequence[TreeOptions],
    tree_counts: Sequence[int],
    *,
    folds: int,
    block_size: float,
    gap: float,
    seed: int,
    fold: npt.NDArray[np.int16] | None = None,
    threads: int | None = None,
    progress: bool = True,
    heard: Callable[[int, int, npt.NDArray[np.int64], npt.NDArray[np.float64]], None] | None = None,
) -> list[dict[str, Any]]:
    """Score every candidate by spatial cross-validation.

    `fold` is of each sample, where these are not blocks of ground. One forest of the largest size is grown per fold and
    candidate; smaller ones are its first trees. `heard` is called with the place of a candidate, a number of trees, the rows
    that were held out and their probabilities.

    Returns
    -------
    list of dict
        Per combination: trees, max_depth, min_samples_leaf, overall_accuracy, kappa, mean_f1, f1 by code, and
        mean_f1_by_fold. Samples count as often as they were drawn, so classes weigh the same.
    """
    if fold is None:
        fold = block_folds(xy, label, weight, folds, block_size)
    sums = {
        (c, t): np.zeros((folds, len(codes), len(codes)), np.int64)
        for c in range(len(candidates))
        for t in tree_counts
    }
    total = folds * len(candidates) * tree_counts[-1]
    with Progress(total, "cross-validation", "trees", enabled=progress) as bar:
        for number in range(folds):
            train, rows = split(xy, fold, number, gap)
            missing = [codes[k] for k in range(len(codes)) if not (weight * train)[label == k].any()]
            if missing:
                raise OptionError(
                    f"without fold {number + 1} and its gap of {gap:g} m a class has no samples left",
                    found=f"class {missing[0]}",
                    cure="Make block_size or gap smaller, or give more training data",
                )
            for c, candidate in enumerate(candidates):
                trees = grow(
                    ranked,
                    label,
                    weight * train,
                    tree_counts[-1],
                    candidate,
                    seed,
                    score=rows,
                    threads=threads,
                    progress=bar,
                )
                for t, shares in _votes(trees, tree_counts, len(rows), len(codes)):
                    np.add.at(sums[c, t][number], (label[rows], shares.argmax(axis=1)), weight[rows])
                    if heard is not None:
                        heard(c, t, rows, shares / np.maximum(shares.sum(axis=1, keepdims=True), 1e-300))
    return [_row(candidates[c], t, matrices, codes) for (c, t), matrices in sums.items()]


def _votes(
    trees, counts: Sequence[int], n: int, classes: int
) -> Iterator[tuple[int, npt.NDArray[np.float64]]]:
    total = np.zeros((n, classes))
    for number, (_, _, shares) in enumerate(trees, 1):
        total += shares
        if number in counts:
            yield number, total


def _row(
    candidate: TreeOptions, trees: int, matrices: npt.NDArray[np.int64], codes: Sequence[int]
) -> dict[str, Any]:
    by_fold = [Accuracy.from_confusion(m, codes).mean_f1 if m.any() else None for m in matrices]
    return {
        "trees": trees,
        "max_depth": candidate.max_depth,
        "min_samples_leaf": candidate.min_samples_leaf,
        **figures(matrices.sum(axis=0), codes),
        "mean_f1_by_fold": by_fold,
    }


def figures(matrix: npt.NDArray[np.int64], codes: Sequence[int]) -> dict[str, Any]:
    """The measures kept in a model file; rows of the matrix are the truth."""
    accuracy = Accuracy.from_confusion(matrix, codes)
    return {
        "overall_accuracy": accuracy.overall_accuracy,
        "kappa": accuracy.kappa,
        "mean_f1": accuracy.mean_f1,
        "f1": {str(one.code): one.f1 if one.support else None for one in accuracy.per_class},
    }


def choose(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The cheapest combination whose mean F1 is within :data:`TOLERANCE` of the best."""
    best = max(row["mean_f1"] for row in rows)
    good = [row for row in rows if row["mean_f1"] >= best - TOLERANCE]
    return min(
        good,
        key=lambda row: (row["trees"], row["max_depth"] or 10**9, -row["min_samples_leaf"], -row["mean_f1"]),
    )
