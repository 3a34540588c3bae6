"""Spatial cross-validation: whole blocks of ground are held out, with a gap around them.

Neighboring points share most of their neighborhood and so nearly all of their features. Points drawn at
random for validation are therefore half known already, and the score says little about another place.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ..accuracy.measures import Accuracy
from ..base.errors import OptionError
from ..base.progress import Progress
from .trees import Ranked, TreeOptions, grow

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
            found=f"folds {folds}",
            cure="Make folds smaller, or give more training data",
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


def score(
    ranked: Ranked,
    label: npt.NDArray[Any],
    weight: npt.NDArray[np.int64],
    xy: npt.NDArray[np.float64],
    codes: Sequence[int],
    setting: TreeOptions,
    trees: int,
    fold: npt.NDArray[np.int16],
    *,
    gap: float,
    seed: int,
    threads: int | None = None,
    progress: bool = True,
    heard: Callable[[npt.NDArray[np.int64], npt.NDArray[np.float64]], None] | None = None,
) -> dict[str, Any]:
    """Score a forest by cross-validation: one of so many `trees` for each `fold` of the samples, grown without it.

    `heard` is called with the rows that were held out and their probabilities.

    Returns
    -------
    dict
        trees, min_samples_leaf, overall_accuracy, kappa, mean_f1, f1 by code, and mean_f1_by_fold. Samples count as often
        as they were drawn, so classes weigh the same.
    """
    folds = int(fold.max()) + 1
    matrices = np.zeros((folds, len(codes), len(codes)), np.int64)
    with Progress(folds * trees, "cross-validation", "trees", enabled=progress) as bar:
        for number in range(folds):
            train, rows = split(xy, fold, number, gap)
            missing = [codes[k] for k in range(len(codes)) if not (weight * train)[label == k].any()]
            if missing:
                raise OptionError(
                    f"without fold {number + 1} and its gap of {gap:g} m a class has no samples left",
                    found=f"class {missing[0]}",
                    cure="Give more training data",
                )
            total = np.zeros((len(rows), len(codes)))
            grown = grow(
                ranked, label, weight * train, trees, setting, seed, score=rows, threads=threads, progress=bar
            )
            for _, _, shares in grown:
                total += shares
            np.add.at(matrices[number], (label[rows], total.argmax(axis=1)), weight[rows])
            if heard is not None:
                heard(rows, total / np.maximum(total.sum(axis=1, keepdims=True), 1e-300))
    return {
        "trees": trees,
        "max_depth": None,
        "min_samples_leaf": setting.min_samples_leaf,
        **figures(matrices.sum(axis=0), codes),
        "mean_f1_by_fold": [Accuracy.from_confusion(m, codes).mean_f1 if m.any() else None for m in matrices],
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
