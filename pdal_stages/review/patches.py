"""Cells that are best looked at together, in the order in which a person finds most wrong points per minute."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .cells import GROUPS, ReviewCells

#: Share of the cells, those with most errors expected, that make patches of their own.
HOT = 0.1
#: Patches end at the borders of blocks of this side, meters.
BLOCK = 64.0
#: Seconds until a person sees a patch, and that he looks at 100 square meters.
GETTING_THERE, LOOKING = 5.0, 2.5


@dataclass(frozen=True)
class Patches:
    """Patches, best first; arrays have one value for each.

    Attributes
    ----------
    of_cell : (cells,) int64
        The patch of each cell.
    errors, minutes, area : (n,) float64
        Points expected wrong, minutes to look at it, square meters of its cells.
    points, file : (n,) int64
    box : (n, 4) float64
        West, south, east, north of its cells, meters.
    reason : list of str
        Of which class most of the expected errors are, and how sure the model is of these points.
    """

    of_cell: NDArray[np.int64]
    errors: NDArray[np.float64]
    minutes: NDArray[np.float64]
    area: NDArray[np.float64]
    points: NDArray[np.int64]
    file: NDArray[np.int64]
    box: NDArray[np.float64]
    reason: list[str]

    def __len__(self) -> int:
        return len(self.errors)


def find_patches(cells: ReviewCells) -> Patches:
    """The patches of all cells. What is hot in a block is seen at a glance, so it is one patch, and the rest another."""
    total = cells.errors.sum(axis=1)
    hot = (total > 0) & (total >= np.quantile(total, 1.0 - HOT)) if len(total) else np.zeros(0, bool)
    file, row, column = cells.place.T
    across = max(1, round(BLOCK / cells.side))
    block = np.stack([file, row // across, column // across, hot], axis=1)
    blocks, of_cell = np.unique(block, axis=0, return_inverse=True)
    of_cell, n = of_cell.reshape(-1), len(blocks)

    def summed(values: NDArray) -> NDArray[np.float64]:
        return np.bincount(of_cell, values, n).astype(np.float64)

    errors, area = summed(total), summed(np.full(len(cells), cells.side**2))
    minutes = (GETTING_THERE + LOOKING * area / 100.0) / 60.0
    box = np.tile([np.inf, np.inf, -np.inf, -np.inf], (n, 1))
    for k, how in enumerate((np.minimum, np.minimum, np.maximum, np.maximum)):
        how.at(box[:, k], of_cell, cells.corners[:, k])
    points = np.stack([summed(values) for values in cells.points.T], axis=1)
    wrong = np.stack([summed(values) for values in cells.errors.T], axis=1)
    order = np.lexsort((box[:, 0], box[:, 1], -np.round(errors / np.maximum(minutes, 1e-12), 6)))
    rank = np.empty(n, np.int64)
    rank[order] = np.arange(n)
    worst = wrong.argmax(axis=1)
    sure = 1.0 - wrong[np.arange(n), worst] / np.maximum(points[np.arange(n), worst], 1.0)
    reason = [f"{GROUPS[worst[k]]}, reliability {sure[k]:.2f}" for k in order]
    judged = points.sum(axis=1).astype(np.int64)
    return Patches(
        rank[of_cell],
        errors[order],
        minutes[order],
        area[order],
        judged[order],
        blocks[order, 0],
        box[order],
        reason,
    )
