"""Cells of a minimum grid that one can walk between, in numbered sets."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..base.jit import njit
from ..base.unionfind import root as root_of
from .openings import HOLE


@njit
def _linked(raster, offsets, steps, reach, number):
    """Number the measured cells of each linked set alike; returns how many sets there are."""
    h, w = raster.shape
    # With holes beside and below, so that no step has to look where the raster ends.
    stride = w + 2 * reach
    heights = np.full((h + reach) * stride + reach, HOLE)
    for j in range(h):
        for i in range(w):
            heights[j * stride + reach + i] = raster[j, i]
    parent = np.arange(len(heights))
    ahead = offsets[:, 0] * stride + offsets[:, 1]
    for j in range(h):
        for at in range(j * stride + reach, j * stride + reach + w):
            here = heights[at]
            if here == HOLE:
                continue
            mine = root_of(parent, at)
            for k in range(len(steps)):
                other = at + ahead[k]
                if abs(heights[other] - here) <= steps[k] and parent[other] != mine:  # nor a hole
                    other = root_of(parent, other)
                    if other > mine:
                        parent[other] = mine
                    elif other < mine:
                        parent[mine] = other
                        mine = other
    count = 0
    names = np.empty(len(heights), np.int32)  # of those who stand for sets, each the first of its own
    for j in range(h):
        for i in range(w):
            at = j * stride + reach + i
            if heights[at] != HOLE:
                root = root_of(parent, at)
                if root == at:
                    names[at] = count
                    count += 1
                number[j, i] = names[root]
    return count


def linked_cells(
    raster: NDArray[np.float32], reach: int, step: Callable[[NDArray[np.float64]], NDArray[np.float64]]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Number of each cell's set (h, w), -1 in holes; sizes of the sets (n,), and first and last row and column (n, 4).

    Cells at most `reach` away from each other are linked across a `step` of meters, by the distance in cells.
    """
    j, i = np.mgrid[: reach + 1, -reach : reach + 1]
    away = np.hypot(j, i)
    after = ((j > 0) | (i > 0)) & (away <= reach)
    number = np.full(raster.shape, -1)
    offsets = np.column_stack([j[after], i[after]])
    count = _linked(raster, offsets, step(away[after]).astype(np.float32), reach, number)
    rows, columns = np.nonzero(number >= 0)
    sets = number[rows, columns]
    box = np.tile([raster.shape[0], 0, raster.shape[1], 0], (count, 1))
    for at, (which, values) in enumerate(
        ((np.minimum, rows), (np.maximum, rows), (np.minimum, columns), (np.maximum, columns))
    ):
        which.at(box[:, at], sets, values)
    return number, np.bincount(sets, minlength=count), box
