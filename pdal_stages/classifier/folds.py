"""Parts of the training ground that are held out in turn, and what a pass says of those it has not seen.

Parts are whole surveys where there are several, else strips. A forest has memorized the labels of its own samples.
Probabilities it gave them would teach the next pass to trust labels that nobody knows elsewhere: so the context that
the next pass is trained on comes from forests that have not seen it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import OptionError
from .algorithms import PredictRequest
from .context import Context
from .featureforest import Features
from .forest import Forest
from .passes import PassRun

#: Fewer surveys than this are cut into strips instead: too little would be left to train on.
SURVEYS = 3
#: Width of a strip in meters, halved until there are enough of them.
WIDTH, NARROWEST = 10.0, 0.01


@dataclass(frozen=True)
class Folds:
    """Which part of the training ground a point belongs to."""

    count: int
    surveys: dict[str, int] | None = None  #: fold of each survey, where whole surveys are folds
    #: meters of a strip along the diagonal otherwise; every `count`-th strip is of the same fold
    width: float = WIDTH

    @classmethod
    def of(
        cls,
        clouds: Iterable[tuple[npt.NDArray[np.float64], npt.NDArray[Any]]],
        surveys: Sequence[str],
        count: int,
    ) -> Folds:
        """Folds of these clouds.

        Parameters
        ----------
        clouds : re-iterable of ((n, 3) float64 coordinates in meters, (n,) class positions)
            A position of -1 is not trained on.
        surveys : sequence of str
            The survey of each cloud.
        count : int
            How many are wanted; there are fewer where there are fewer surveys.

        Raises
        ------
        OptionError
            The labeled ground is too small to be cut.
        """
        names = sorted(set(surveys))
        if len(names) >= SURVEYS:
            labeled = dict.fromkeys(names, 0)
            for (_, position), name in zip(clouds, surveys, strict=True):
                labeled[name] += int(np.count_nonzero(position >= 0))
            load = [0] * min(count, len(names))
            fold_of = {}
            for name in sorted(names, key=lambda one: (-labeled[one], one)):
                fold_of[name] = load.index(min(load))
                load[fold_of[name]] += max(labeled[name], 1)
            return cls(len(load), fold_of)
        width = WIDTH
        while width >= NARROWEST:
            there: set[int] = set()
            for xyz, position in clouds:
                there.update(np.unique(_strip(xyz[position >= 0], width)).tolist())
            if len({strip % count for strip in there}) == count:
                return cls(count, None, width)
            width /= 2.0
        raise OptionError(
            f"the labeled ground is too small to be cut into {count} parts",
            cure="Give more training data, or set passes to 1",
        )

    def points(self, xyz: npt.NDArray[np.float64], survey: str) -> npt.NDArray[np.int16]:
        """The fold of each point of a cloud."""
        if self.surveys is not None:
            return np.full(len(xyz), self.surveys[survey], np.int16)
        return (_strip(xyz, self.width) % self.count).astype(np.int16)


def _strip(xyz: npt.NDArray[np.float64], width: float) -> npt.NDArray[np.int64]:
    """Strips across the diagonal, anchored to absolute coordinates: copies of a cloud share them."""
    return np.floor((xyz[:, 0] + xyz[:, 1]) * (np.sqrt(0.5) / width)).astype(np.int64)


# ---- what a pass says of points it has not seen ------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class FoldForests:
    """A forest per fold, each grown without it, as one pass over one cloud."""

    features: Features
    context: Context | None
    forests: Sequence[Forest]
    fold: npt.NDArray[np.int16]  #: (n,) of every point of the cloud: the forest that judges it
    #: of a pass on top of others: what it makes of all that it reads and of what its forests say
    blend: Callable[[npt.NDArray[np.float32], npt.NDArray[np.float64]], npt.NDArray[np.float64]] | None = None

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
        return out if self.blend is None else self.blend(values, out)


@dataclass(frozen=True, eq=False)
class ContextOnly:
    """A pass of which nothing but its context is wanted."""

    context: Context
    features: None = None

    def probabilities(
        self, values: npt.NDArray[np.float32], rows: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.float64]:
        """Nobody asks."""
        raise NotImplementedError


def sample_context(
    request: PredictRequest,
    passes: Sequence[Any],
    context: Context,
    classes: Sequence[int],
    factors: Sequence[npt.NDArray[np.float64] | None] = (),
) -> npt.NDArray[np.float32]:
    """(m, columns): the context of the m points asked for, ascending, as passes say that have not seen them.

    `classes` and `factors` of each pass: see :class:`Passes`.
    """
    asked: Any = request.rows
    out = np.empty((len(asked), len(context.tokens) * classes[-1]), np.float32)
    padded = (*factors, *[None] * (len(passes) - len(factors) + 1))
    run = PassRun([*passes, ContextOnly(context)], [*classes, classes[-1]], request, padded)
    for rows, columns in run.blocks(lambda values, rows, columns: columns):
        out[np.searchsorted(asked, rows)] = columns
    return out
