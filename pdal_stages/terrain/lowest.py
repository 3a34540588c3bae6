"""The lowest point of every cell of a grid anchored to absolute coordinates: all that filtered ground needs far away."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..base.jit import njit
from .minima import cell_numbers
from .openings import HOLE
from .patches import patches

#: Heights beyond this, in meters, are no terrain, and too much for the sums.
HIGHEST = 1e6
#: Groups of points farther apart, in cells, are worked on apart.
_APART = 128


@njit
def lowest_points(z, x, y, use, column, row, left, bottom, grid):
    """Put the index of the lowest usable point of each cell into `grid` (-1: none).

    Of points of one height the first by x, then y, is taken, so that order does not matter.
    """
    grid[:] = -1
    for p in range(len(z)):
        if not use[p]:
            continue
        j, i = row[p] - bottom, column[p] - left
        q = grid[j, i]
        if q < 0 or z[p] < z[q] or (z[p] == z[q] and (x[p] < x[q] or (x[p] == x[q] and y[p] < y[q]))):
            grid[j, i] = p


@njit
def heights_of(z, grid):
    """Height of each cell's lowest point."""
    raster = np.full(grid.shape, HOLE, np.float32)
    for j in range(grid.shape[0]):
        for i in range(grid.shape[1]):
            if grid[j, i] >= 0:
                raster[j, i] = z[grid[j, i]]
    return raster


@njit
def places_of(x, y, z, cell, grid):
    """Place in the cell (from its center, in cells) and height of each cell's lowest point."""
    h, w = grid.shape
    place = np.zeros((h, w, 3))
    for j in range(h):
        for i in range(w):
            p = grid[j, i]
            if p >= 0:
                u, v = x[p] / cell, y[p] / cell
                place[j, i, 0] = u - np.floor(u) - 0.5
                place[j, i, 1] = v - np.floor(v) - 0.5
                place[j, i, 2] = z[p]
    return place


def lowest_of_cells(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    z: NDArray[np.float64],
    use: NDArray[np.bool_],
    cell: float,
) -> NDArray[np.int64]:
    """Numbers of the points that are the lowest usable ones of their cells, ascending; meters, finite coordinates."""
    use = use & (np.abs(z) < HIGHEST)
    mine = np.flatnonzero(use)
    if not mine.size:
        return mine
    x, y, z = x[mine], y[mine], z[mine]
    column, row = cell_numbers(x, cell), cell_numbers(y, cell)
    found = []
    for points, own in patches(column, row, 0, _APART):
        at = np.arange(len(x))[points][own]
        left, bottom = int(column[at].min()), int(row[at].min())
        grid = np.empty((int(row[at].max()) - bottom + 1, int(column[at].max()) - left + 1), np.int64)
        every = np.ones(len(at), bool)
        lowest_points(z[at], x[at], y[at], every, column[at], row[at], left, bottom, grid)
        found.append(at[grid[grid >= 0]])
    return np.sort(mine[np.concatenate(found)])
