"""Where the ground is in each cell: points near a surface, and the means of those of a cell."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..base.jit import njit
from .planes import blend

#: Sums of coordinates are whole numbers of this part of a meter, so that order does not matter.
_PARTS = 2.0**20


@njit
def heights_above(x, y, z, cell, left, bottom, planes, height, gradient):
    """Height above the surface, and its slope, at points."""
    for p in range(len(x)):
        u, v = x[p] / cell - 0.5, y[p] / cell - 0.5
        i, j = np.floor(u), np.floor(v)
        level, across, along = blend(planes, int(i) - left, int(j) - bottom, u - i, v - j, 1.0)
        height[p] = z[p] - level
        gradient[p] = np.sqrt(across * across + along * along) / cell


def around(
    column: NDArray, row: NDArray, left: int, bottom: int, shape: tuple[int, int]
) -> NDArray[np.bool_]:
    """Cells (h, w) at which a surface is asked for: those of points, and all round them, whose planes points blend."""
    held = np.zeros(shape, bool)
    held[row - bottom, column - left] = True
    needed = held.copy()
    needed[1:] |= held[:-1]
    needed[:-1] |= held[1:]
    held = needed.copy()
    needed[:, 1:] |= held[:, :-1]
    needed[:, :-1] |= held[:, 1:]
    return needed


@njit
def add_ground(x, y, z, is_ground, column, row, cell, left, bottom, sums):
    """Add points that are ground to the sums (h, w, 4) of their cells: number, place, height; in whole numbers, so order is
    free."""
    for p in range(len(x)):
        if is_ground[p]:
            total = sums[row[p] - bottom, column[p] - left]
            total[0] += 1
            total[1] += int(np.rint((x[p] / cell - column[p] - 0.5) * _PARTS))
            total[2] += int(np.rint((y[p] / cell - row[p] - 0.5) * _PARTS))
            total[3] += int(np.rint(z[p] * _PARTS))


@njit
def means_of(sums, ground, place):
    """Whether cells (h, w) hold ground, and its mean (h, w, 3): from the cell's center, in cells, and its height."""
    for j in range(sums.shape[0]):
        for i in range(sums.shape[1]):
            n = sums[j, i, 0]
            ground[j, i] = n > 0
            if n > 0:
                for k in range(3):
                    place[j, i, k] = sums[j, i, k + 1] / _PARTS / n
