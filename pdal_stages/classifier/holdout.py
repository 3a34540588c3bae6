"""Ground that is held out: whole surveys or blocks in turn.

Neighboring points share most of their features, so a forest nearly knows the neighbors of its samples: a score on them
flatters, and a next pass trained on what it says there would trust what nobody knows elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from ..accuracy.measures import Accuracy
from ..base.errors import OptionError

#: Side of a block in meters; where too few have samples it is halved down to the other.
BLOCK, SMALLEST = 25.0, 0.02
#: Fewer surveys than this are cut into blocks: else too little would be left to train the next pass on.
SURVEYS = 3


@dataclass(frozen=True, eq=False)
class Folds:
    """Which part of the training ground a point belongs to.

    Attributes
    ----------
    count : int
    surveys : dict of str to int
        Fold of each survey, where whole surveys are folds; otherwise empty.
    side : float
        Of blocks, meters. They are anchored to absolute coordinates, so that clouds that overlap share them.
    blocks, fold : (m,) int64, (m,) int16
        Number of each block that has samples, ascending, and its fold. Others follow from their number.
    """

    count: int
    surveys: dict[str, int]
    side: float = BLOCK
    blocks: npt.NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    fold: npt.NDArray[np.int16] = field(default_factory=lambda: np.zeros(0, np.int16))

    @classmethod
    def of_blocks(
        cls,
        xy: npt.NDArray[np.float64],
        label: npt.NDArray[Any],
        weight: npt.NDArray[Any],
        folds: int,
        side: float,
    ) -> Folds:
        """Blocks dealt out so that every fold has its share of each class of the samples, (n, 2) meters; `label` is their
        class positions, `weight` how often they count."""
        blocks, block = np.unique(_numbers(xy, side), return_inverse=True)
        if len(blocks) < folds:
            raise OptionError(
                f"the samples cover {len(blocks)} block(s) of {side:g} m, fewer than the {folds} folds",
                found=f"folds {folds}",
                cure="Make folds smaller, or give more training data",
            )
        content = np.zeros((len(blocks), int(label.max()) + 1))
        np.add.at(content, (block, label), weight)
        # Dealt out in turn, to and fro, those with most of the rarest class first.
        rarest_last = np.argsort(-(content > 0).sum(axis=0), kind="stable")
        order = np.lexsort(-content[:, rarest_last].T)
        fold = np.empty(len(blocks), np.int16)
        turn = np.arange(len(blocks)) % (2 * folds)
        fold[order] = np.minimum(turn, 2 * folds - 1 - turn)
        return cls(folds, {}, side, blocks, fold)

    @classmethod
    def of_ground(
        cls,
        xy: npt.NDArray[np.float64],
        label: npt.NDArray[Any],
        weight: npt.NDArray[Any],
        surveys: Sequence[str],
        folds: int,
    ) -> Folds:
        """Whole surveys where there are enough, up to twice as many folds, else blocks as small as need be."""
        names = sorted(set(surveys))
        if len(names) >= SURVEYS:
            folds = min(2 * folds, len(names))
            return cls(folds, {name: number % folds for number, name in enumerate(names)})
        side = BLOCK
        while side >= SMALLEST:
            try:
                return cls.of_blocks(xy, label, weight, folds, side)
            except OptionError:
                side /= 2.0
        raise OptionError(
            f"the labeled ground is too small to be cut into {folds} parts",
            cure="Give more training data, or set passes to 1",
        )

    def points(self, xyz: npt.NDArray[np.float64], survey: str = "") -> npt.NDArray[np.int16]:
        """The fold of each point of a cloud."""
        if self.surveys:
            return np.full(len(xyz), self.surveys[survey], np.int16)
        number = _numbers(xyz, self.side)
        at = np.minimum(np.searchsorted(self.blocks, number), len(self.blocks) - 1)
        return np.where(self.blocks[at] == number, self.fold[at], number % self.count).astype(np.int16)


def _numbers(xyz: npt.NDArray[np.float64], side: float) -> npt.NDArray[np.int64]:
    """The number of each point's block."""
    cell = np.floor(xyz[:, :2] / side).astype(np.int64)
    return (cell[:, 0] << 32) + cell[:, 1]


def split(
    xy: npt.NDArray[np.float64], fold: npt.NDArray[Any], number: int, gap: float
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.int64]]:
    """(training mask, rows held out) of one fold; none of the former is within `gap` meters of the latter."""
    from scipy.spatial import cKDTree

    held = fold == number
    train = ~held
    if gap > 0 and held.any():
        others = np.flatnonzero(train)
        distance, _ = cKDTree(xy[held]).query(xy[others], distance_upper_bound=np.nextafter(gap, np.inf))
        train[others[distance <= gap]] = False
    return train, np.flatnonzero(held)


def figures(matrix: npt.NDArray[np.int64], codes: Sequence[int]) -> dict[str, Any]:
    """The measures kept in a model file; rows of the matrix are the truth."""
    accuracy = Accuracy.from_confusion(matrix, codes)
    return {
        "overall_accuracy": accuracy.overall_accuracy,
        "kappa": accuracy.kappa,
        "mean_f1": accuracy.mean_f1,
        "f1": {str(one.code): one.f1 if one.support else None for one in accuracy.per_class},
    }
