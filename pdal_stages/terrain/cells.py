"""Coordinates, the cells they fall in, of grids anchored to absolute coordinates, and the lowest points of cells.

The lowest points are all that filtered ground needs far away.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..base.errors import StageError
from ..base.jit import njit
from .openings import HOLE
from .patches import patches

#: Largest cell index either side of zero; beyond it coordinates cannot be terrain.
_INDEX_LIMIT = 2**31 - 2
#: Heights beyond this, in meters, are no terrain, and too much for the sums.
HIGHEST = 1e6
#: Groups of points farther apart, in cells, are worked on apart.
_APART = 128


def columns(x: ArrayLike, y: ArrayLike | None, z: ArrayLike | None) -> list[NDArray[np.float64]]:
    """Three arrays of one length, from three or from one of shape (n, 3); StageError where shapes differ."""
    if y is None and z is None:
        xyz = np.asarray(x, np.float64)
        if xyz.ndim != 2 or xyz.shape[1] != 3:
            raise StageError("points must be an array of shape (n, 3), or x, y and z", found=xyz.shape)
        return [np.ascontiguousarray(column) for column in xyz.T]
    made = [np.ascontiguousarray(np.asarray(a, np.float64)) for a in (x, y, z)]
    if not (made[0].shape == made[1].shape == made[2].shape and made[0].ndim == 1):
        raise StageError(
            "x, y and z must be one-dimensional and of one length", found=tuple(a.shape for a in made)
        )
    return made


def bounded(index: NDArray[np.float64]) -> NDArray[np.int64]:
    """Cell numbers as integers; refuses coordinates no survey has (they would wrap round)."""
    if index.size and max(-index.min(), index.max()) > _INDEX_LIMIT - 1:
        raise StageError(
            "coordinates are too large for the grid",
            found=f"a cell index of {float(np.abs(index).max()):.3g}",
            cure="Remove stray points, e.g. with filters.crop or filters.range, or use a larger 'cell'",
        )
    return index.astype(np.int64)


def cell_numbers(coordinate: NDArray[np.float64], cell: float) -> NDArray[np.int64]:
    """Which cell coordinates fall in, counted from the origin; StageError beyond what any survey has."""
    index = np.asarray(coordinate / cell)
    return bounded(np.floor(index, out=index))


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


def heights_of(z: NDArray[np.float64], grid: NDArray[np.int64]) -> NDArray[np.float32]:
    """Height of each cell's lowest point, whose numbers the grid has."""
    return np.where(grid >= 0, z[grid], HOLE).astype(np.float32)


def places_of(x, y, z, cell: float, grid: NDArray[np.int64]) -> NDArray[np.float64]:
    """Place in the cell (from its center, in cells) and height of each cell's lowest point (h, w, 3)."""
    place = np.zeros((*grid.shape, 3))
    held = grid >= 0
    point = grid[held]
    for k, axis in enumerate((x, y)):
        at = axis[point] / cell
        place[held, k] = at - np.floor(at) - 0.5
    place[held, 2] = z[point]
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
