"""Cells of grids anchored to absolute coordinates: what lies lowest in them, which belong together, sums around them.

Points are cut into pieces whose rasters are small wherever points lie: groups far apart, and squares with surroundings.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..base.errors import StageError
from ..base.grid import begins_run

#: What a raster has where nothing was measured.
HOLE = np.float32(np.inf)
#: Largest cell index either side of zero; beyond it coordinates cannot be terrain.
_INDEX_LIMIT = 2**31 - 2
#: Heights beyond this, in meters, are no terrain, and too much for the sums.
HIGHEST = 1e6
#: Levels of a cell are so many meters apart, at least.
GAP = 1.0


class CellWindow(NamedTuple):
    """Cells from a column and row on."""

    left: int
    bottom: int
    width: int
    height: int

    @classmethod
    def round(cls, column: NDArray[np.int64], row: NDArray[np.int64]) -> CellWindow:
        """The smallest one round some cells."""
        left, bottom = int(column.min()), int(row.min())
        return cls(left, bottom, int(column.max()) + 1 - left, int(row.max()) + 1 - bottom)

    def grown(self, by: int) -> CellWindow:
        """So many cells more on every side."""
        return CellWindow(
            self.left - by, self.bottom - by, self.width + 2 * by, self.height + 2 * by
        )

    def holds(self, column: NDArray[np.int64], row: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which cells lie in it."""
        inside = (column >= self.left) & (column < self.left + self.width)
        return inside & (row >= self.bottom) & (row < self.bottom + self.height)

    def numbers(self, column: NDArray[np.int64], row: NDArray[np.int64]) -> NDArray[np.int64]:
        """Numbers of cells in it, row by row."""
        return (row - self.bottom) * self.width + column - self.left

    def within(self, other: CellWindow) -> CellWindow:
        """What of it lies in another."""
        left, bottom = max(self.left, other.left), max(self.bottom, other.bottom)
        right = min(self.left + self.width, other.left + other.width)
        top = min(self.bottom + self.height, other.bottom + other.height)
        return CellWindow(left, bottom, max(right - left, 0), max(top - bottom, 0))

    def on(self, other: CellWindow) -> tuple[slice, slice]:
        """Rows and columns of its cells on the raster of another, which holds it."""
        j, i = self.bottom - other.bottom, self.left - other.left
        return slice(j, j + self.height), slice(i, i + self.width)


def sums_around(values: NDArray, reach: int) -> NDArray[np.int64]:
    """Sums of whole numbers (h, w, ...) over the square that goes `reach` cells to every side of each cell."""
    sums = np.asarray(values)
    for axis in (0, 1):
        total = np.moveaxis(np.cumsum(sums, axis, np.int64), axis, 0)
        sums = np.empty(sums.shape, np.int64)
        lines, ahead = np.moveaxis(sums, axis, 0), max(len(total) - reach, 0)
        lines[:ahead], lines[ahead:] = total[reach:], total[-1:]
        lines[reach + 1 :] -= total[: max(ahead - 1, 0)]
    return sums


def columns(x: ArrayLike, y: ArrayLike | None, z: ArrayLike | None) -> list[NDArray[np.float64]]:
    """Three arrays of one length, from three or from one of shape (n, 3); StageError where shapes differ."""
    if y is None and z is None:
        xyz = np.asarray(x, np.float64)
        if xyz.ndim != 2 or xyz.shape[1] != 3:
            raise StageError(
                "points must be an array of shape (n, 3), or x, y and z", found=xyz.shape
            )
        return [np.ascontiguousarray(column) for column in xyz.T]
    made = [np.ascontiguousarray(np.asarray(a, np.float64)) for a in (x, y, z)]
    if not (made[0].shape == made[1].shape == made[2].shape and made[0].ndim == 1):
        raise StageError(
            "x, y and z must be one-dimensional and of one length",
            found=tuple(a.shape for a in made),
        )
    return made


def usable(*axes: NDArray[np.float64], mask: ArrayLike | None = None) -> NDArray[np.bool_]:
    """Which points (n,) have finite coordinates, and are of the mask where one is given; StageError where that differs."""
    use = np.logical_and.reduce([np.isfinite(axis) for axis in axes])
    if mask is None:
        return use
    kept = np.asarray(mask, bool)
    if kept.shape != use.shape:
        raise StageError(
            "'mask' must have one value per point", found=f"{kept.shape}, {len(use):,} points"
        )
    return use & kept


def cell_numbers(coordinate: NDArray[np.float64], cell: float) -> NDArray[np.int64]:
    """Which cell coordinates fall in, counted from the origin; refuses those no survey has (they would wrap round)."""
    index = np.asarray(coordinate / cell)
    np.floor(index, out=index)
    if index.size and max(-index.min(), index.max()) > _INDEX_LIMIT - 1:
        raise StageError(
            "coordinates are too large for the grid",
            found=f"a cell index of {float(np.abs(index).max()):.3g}",
            cure="Remove stray points, e.g. with filters.crop or filters.range, or use a larger 'cell'",
        )
    return index.astype(np.int64)


def keys_of(column: NDArray[np.int64], row: NDArray[np.int64]) -> NDArray[np.int64]:
    """One number for each cell, ascending by row and column."""
    return (row << 32) + (column + 2**31)


def runs(key: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Numbers of those (n,) that have the same key, for each there is."""
    order = np.argsort(key, kind="stable")
    return np.split(order, np.flatnonzero(begins_run(key[order]))[1:]) if len(key) else []


def lowest_points(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    z: NDArray[np.float64],
    cell: NDArray[np.int64],
    count: int,
) -> NDArray[np.int64]:
    """Numbers of the points that are the lowest of each of `count` cells, by the numbers of these; -1 where there is none.

    Of points of one height the first by x, then y, is taken, so that order does not matter.
    """
    lowest, first = np.full(count, np.inf), np.full(count, -1)
    np.minimum.at(lowest, cell, z)
    low = np.flatnonzero(z == lowest[cell])
    first[cell[low]] = low
    tied = low[np.bincount(cell[low])[cell[low]] > 1]
    tied = tied[np.lexsort((y[tied], x[tied]))[::-1]]
    first[cell[tied]] = tied  # the last of a cell stands
    return first


def lowest_of_cells(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    z: NDArray[np.float64],
    use: NDArray[np.bool_],
    cell: float,
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Numbers of the points that are the lowest usable ones of their cells, and the heights of the highest ones there.

    In meters, finite coordinates.
    """
    mine = np.flatnonzero(use & (np.abs(z) < HIGHEST))
    x, y, z = x[mine], y[mine], z[mine]
    key = keys_of(cell_numbers(x, cell), cell_numbers(y, cell))
    cells, number = np.unique(key, return_inverse=True)
    highest = np.full(len(cells), -np.inf)
    np.maximum.at(highest, number, z)
    return mine[lowest_points(x, y, z, number, len(cells))], highest


def levels(
    z: NDArray[np.float64], cell: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Points (n,) in the order of their cells' numbers (small ones) and of their heights, and which begin a level of a cell.

    A cell's points are parted where a gap is wide: the ground and the deck over it, a roof and what it stands on. The lowest
    points of levels are levels again, each by itself, so they stand for all points of places far away.
    """
    rank = np.empty(len(z), np.int64)
    rank[np.argsort(z)] = np.arange(len(z))
    order = np.argsort(cell * len(z) + rank)
    return order, begins_run(cell[order]) | (np.diff(z[order], prepend=-np.inf) > GAP)
