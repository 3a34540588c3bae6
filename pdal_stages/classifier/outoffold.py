"""What a pass says of training points it has not seen: the context that the next pass is trained on.

A forest knows the labels of its own samples by heart. Probabilities it gave them would teach the next pass to trust
labels that nobody knows elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import OptionError
from .algorithms import Question
from .context import Context
from .featureforest import Features
from .forest import Forest
from .growing import TreeOptions, grow
from .passes import PassRun


@dataclass(frozen=True, eq=False)
class FoldForests:
    """A forest per fold, each grown without it, as one pass over one cloud.

    Attributes
    ----------
    features : Features
    context : Context or None
    forests : sequence of Forest
    fold : (n,) int16
        Of every point of the cloud: the forest that judges it.
    """

    features: Features
    context: Context | None
    forests: Sequence[Forest]
    fold: npt.NDArray[np.int16]

    def probabilities(
        self, values: npt.NDArray[np.float32], rows: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.float64]:
        """Of each point from the forest that has not seen its fold."""
        out = np.empty((len(values), self.forests[0].n_classes))
        fold = self.fold[rows]
        for number in np.unique(fold).tolist():
            mine = fold == number
            whole = mine.all()
            out[mine] = self.forests[number].predict_proba(values if whole else values[mine])
        return out


@dataclass(frozen=True, eq=False)
class ContextOnly:
    """A pass of which nothing but its context is wanted."""

    context: Context
    features: None = None


def grow_folds(
    values: npt.NDArray[np.float32],
    label: npt.NDArray[Any],
    weight: npt.NDArray[np.int64],
    fold: npt.NDArray[np.int16],
    folds: int,
    trees: int,
    setting: TreeOptions,
    *,
    seed: int,
    threads: int | None = None,
    progress: Any = None,
) -> list[Forest]:
    """A forest for each fold, grown on the samples outside it.

    Ground beside a fold is not left out as in cross-validation: the forests miss the fold's samples already, and the
    next pass should see probabilities as good as those it will see when the model is used.
    """
    forests = []
    for number in range(folds):
        train = (fold != number) & (weight > 0)
        if len(np.unique(label[train])) < 2:
            raise OptionError(
                "without one of its folds the training ground has fewer than two classes left",
                cure="Give more training data, or set passes to 1",
            )
        grown = grow(values, label, weight * train, trees, setting, seed, threads=threads, progress=progress)
        forests.append(Forest.from_sklearn([tree.tree_ for tree, _, _ in grown], values.shape[1]))
    return forests


def sample_context(
    xyz: npt.NDArray[np.float64],
    dimensions: Any,
    rows: npt.NDArray[np.int64],
    passes: Sequence[FoldForests],
    context: Context,
    classes: int,
    *,
    threads: int | None,
    memory_mb: float,
    progress: Any = None,
) -> npt.NDArray[np.float32]:
    """The context of some points of a cloud, as passes say that have not seen them.

    Parameters
    ----------
    rows : (m,) int64, ascending
    passes : sequence of FoldForests
        One after the other.

    Returns
    -------
    (m, columns of the context) float32
    """
    out = np.empty((len(rows), len(context.tokens) * classes), np.float32)
    question = Question(xyz, dimensions, rows, threads, memory_mb, progress)
    run = PassRun([*passes, ContextOnly(context)], classes, question)
    for part, columns in run.blocks(lambda rows, _, columns: columns):
        out[np.searchsorted(rows, part)] = columns
    return out
