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

from .algorithms import Question
from .context import Context
from .featureforest import Features
from .forest import Forest
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


def sample_context(
    question: Question, passes: Sequence[FoldForests], context: Context, classes: int
) -> npt.NDArray[np.float32]:
    """The context of the points that are asked for, as passes say, one after the other, that have not seen them.

    Returns
    -------
    (points asked for, columns of the context) float32
    """
    asked: Any = question.rows
    out = np.empty((len(asked), len(context.tokens) * classes), np.float32)
    run = PassRun([*passes, ContextOnly(context)], classes, question)
    for part, columns in run.blocks(lambda _, rows, columns: columns):
        out[np.searchsorted(asked, part)] = columns
    return out
