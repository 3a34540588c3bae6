"""Expected errors (sums of 1 - Reliability) in cells of an absolute grid, and patches to check.

Cells add up, so files can be read one after the other, in parts, in any order. What share of the
wrong points the first patches hold, benchmarks/surveys/review.py measures on surveys that a model
was not trained on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..base.grid import cell_numbers


@dataclass(frozen=True)
class ReviewRules:
    """Sizes of cells and patches, and the time it takes to check these.

    Values without a reason are not tuned.
    """

    min_side: float = 1.0  #: of a cell, meters
    max_side: float = 16.0  #: of a cell, meters; a whole part of a block
    points_per_cell: float = 4.0  #: on average; cells with fewer are widened, up to `max_side`
    max_cells: int = 1 << 24  #: of the whole area; more are widened likewise, to bound the memory
    hot_share: float = 0.1  #: of the cells of all files: those with most expected errors
    block: float = 64.0  #: side of the blocks at whose borders patches end, meters
    seconds_to_reach: float = 5.0  #: for a person to go to a patch; an estimate, not measured
    seconds_per_100_m2: float = 2.5  #: for a person to check it; an estimate, not measured


RULES = ReviewRules()
#: Groups of classes whose points are judged: points of other classes have no expected error.
GROUPS = ("ground", "vegetation", "building")
_GROUP_OF_CODE = np.full(256, len(GROUPS), np.int64)
_GROUP_OF_CODE[[2, 3, 4, 5, 6]] = 0, 1, 1, 1, 2
#: Expected errors are whole numbers of this part of a point, so that the order changes no sum.
_PARTS = 1 << 16


def cell_side(points: int, area: float) -> float:
    """Return the side of cells, a power of two in meters, for points on an area in m2."""
    side = RULES.min_side
    while side < RULES.max_side and (
        points < RULES.points_per_cell / side**2 * area or area > RULES.max_cells * side**2
    ):
        side *= 2.0
    return side


@dataclass(frozen=True)
class ReviewCells:
    """Cells that hold judged points, each once for each file."""

    side: float  #: meters
    place: NDArray[np.int64]  #: (n, 3) number of the file, row and column, in ascending order
    points: NDArray[np.int64]  #: (n, 3) points of each group
    parts: NDArray[np.int64]  #: (n, 3) expected errors of each group, in parts of a point

    def __len__(self) -> int:
        """Return the number of cells."""
        return len(self.place)

    @property
    def errors(self) -> NDArray[np.float64]:
        """(n, 3) points of each group that are expected to be wrong."""
        return self.parts / _PARTS

    @property
    def corners(self) -> NDArray[np.float64]:
        """(n, 4) west, south, east, north, meters."""
        _, row, column = self.place.T
        return np.stack([column, row, column + 1, row + 1], axis=1) * self.side

    @classmethod
    def from_points(
        cls,
        xyz: NDArray[np.float64],
        codes: NDArray[np.uint8],
        reliability: ArrayLike,
        side: float,
        file: int = 0,
    ) -> ReviewCells:
        """Return the cells of points of a file.

        Parameters
        ----------
        xyz : (n, 3) float64
            Meters.
        codes : (n,) uint8
            Class codes.
        reliability : (n,) float
            0 to 1; one that is not known (NaN) counts as 0.
        side : float
            Of a cell, meters.
        file : int
            Number of the file.
        """
        group = _GROUP_OF_CODE[codes]
        judged = group < len(GROUPS)
        column, row = (cell_numbers(xyz[judged, axis], side) for axis in (0, 1))
        wrong = 1.0 - np.clip(np.nan_to_num(np.asarray(reliability, np.float64)[judged]), 0.0, 1.0)
        points = np.eye(len(GROUPS), dtype=np.int64)[group[judged]]
        place = np.stack([np.full(len(row), file, np.int64), row, column], axis=1)
        parts = points * np.rint(wrong * _PARTS).astype(np.int64)[:, None]
        return cls.join([cls(side, place, points, parts)])

    @classmethod
    def join(cls, several: Sequence[ReviewCells]) -> ReviewCells:
        """Return the cells of several parts as one, with one record for each cell."""
        places = np.concatenate([cells.place for cells in several])
        place, index = np.unique(places, axis=0, return_inverse=True)
        sums = np.zeros((2, len(place), len(GROUPS)), np.int64)
        for total, name in zip(sums, ("points", "parts"), strict=True):
            values = np.concatenate([getattr(cells, name) for cells in several])
            np.add.at(total, index.reshape(-1), values)
        return cls(several[0].side, place, *sums)


@dataclass(frozen=True)
class Patches:
    """Patches of cells by descending expected errors per minute of checking."""

    of_cell: NDArray[np.int64]  #: (cells,) the patch of each cell
    errors: NDArray[np.float64]  #: (n,) points expected to be wrong
    minutes: NDArray[np.float64]  #: (n,) to check it
    area: NDArray[np.float64]  #: (n,) of its cells, m2
    points: NDArray[np.int64]  #: (n,)
    file: NDArray[np.int64]  #: (n,) number of its file
    at: NDArray[np.float64]  #: (n, 2) middle of the cell with most expected errors, meters
    reason: list[str]  #: group with most expected errors, and the mean reliability of its points

    def __len__(self) -> int:
        """Return the number of patches."""
        return len(self.errors)


def find_patches(cells: ReviewCells) -> Patches:
    """Group cells into patches.

    The hot cells of a block, those among the `hot_share` of all files' cells with most expected
    errors, are a patch, and its other cells another one.
    """
    total = cells.errors.sum(axis=1)
    limit = np.quantile(total, 1.0 - RULES.hot_share) if len(total) else 0.0
    hot = (total > 0) & (total >= limit)
    file, row, column = cells.place.T
    cells_per_block = max(1, round(RULES.block / cells.side))
    block = np.stack([file, row // cells_per_block, column // cells_per_block, hot], axis=1)
    blocks, of_cell = np.unique(block, axis=0, return_inverse=True)
    of_cell, n = of_cell.reshape(-1), len(blocks)

    def sum_by_patch(values: NDArray) -> NDArray[np.float64]:
        return np.stack([np.bincount(of_cell, column, n) for column in values.T], axis=1)

    points, wrong = sum_by_patch(cells.points), sum_by_patch(cells.errors)
    errors, area = wrong.sum(axis=1), np.bincount(of_cell, minlength=n) * np.float64(cells.side**2)
    minutes = (RULES.seconds_to_reach + RULES.seconds_per_100_m2 * area / 100.0) / 60.0
    ascending = np.lexsort((total, of_cell))
    last = np.searchsorted(of_cell[ascending], np.arange(n), side="right") - 1
    at = np.stack([column, row], axis=1)[ascending[last]] * cells.side + 0.5 * cells.side
    order = np.lexsort((*at.T, -np.round(errors / np.maximum(minutes, 1e-12), 6)))
    group = wrong.argmax(axis=1)
    each = np.arange(n), group
    reliability = 1.0 - wrong[each] / np.maximum(points[each], 1.0)
    return Patches(
        of_cell=np.argsort(order)[of_cell],
        errors=errors[order],
        minutes=minutes[order],
        area=area[order],
        points=points.sum(axis=1).astype(np.int64)[order],
        file=blocks[order, 0],
        at=at[order],
        reason=[f"{GROUPS[group[k]]}, reliability {reliability[k]:.2f}" for k in order],
    )
