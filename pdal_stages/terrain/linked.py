"""Cells of a grid that belong together, in numbered sets, and sums over the squares around cells."""

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
    """Number of each cell's set (h, w), -1 in holes; sizes of the sets (n,), and their :func:`longest_sides`.

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
    return number, np.bincount(sets, minlength=count), longest_sides(sets, rows, columns, count)


def longest_sides(
    label: NDArray[np.int64], row: NDArray[np.int64], column: NDArray[np.int64], count: int
) -> NDArray[np.int64]:
    """Of each of `count` sets of cells, the difference of its last and first row, or column: the larger one."""
    sides = np.zeros((2, count), np.int64)
    for side, at in zip(sides, (row, column), strict=True):
        first = np.full(count, at.max(initial=0))
        np.minimum.at(first, label, at)
        np.maximum.at(side, label, at)
        side -= first
    return sides.max(axis=0)


def sums_around(values: NDArray, reach: int) -> NDArray[np.int64]:
    """Sums of whole numbers (h, w, ...) over the square that goes `reach` cells to every side of each cell."""
    sums = np.asarray(values, np.int64)
    for axis in (0, 1):
        size = sums.shape[axis]
        total = np.cumsum(sums, axis)
        last = np.minimum(np.arange(size) + reach, size - 1)
        before = np.arange(size) - reach - 1
        sums = np.take(total, last, axis)
        inside = [slice(None)] * sums.ndim
        inside[axis] = before >= 0
        sums[tuple(inside)] -= np.take(total, before[before >= 0], axis)
    return sums
