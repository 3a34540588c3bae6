"""Cells of grids anchored to absolute coordinates: what lies lowest in them, which belong together,
sums around them.

Points are cut into pieces whose rasters are small wherever points lie: groups far apart, and
squares with surroundings.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..base.errors import StageError
from ..base.grid import begins_run, cell_keys, cell_numbers

#: What a raster has where nothing was measured.
HOLE = np.float32(np.inf)
#: Heights beyond this, in meters, are no terrain, and too much for the sums.
HIGHEST = 1e6
#: Levels of a cell are so many meters apart, at least.
GAP = 1.0


def sums_around(values: NDArray, reach: int) -> NDArray[np.int64]:
    """Sums of whole numbers (h, w, ...) over the square that goes `reach` cells to every side of
    each cell."""
    sums = np.asarray(values)
    for axis in (0, 1):
        total = np.moveaxis(np.cumsum(sums, axis, np.int64), axis, 0)
        sums = np.empty(sums.shape, np.int64)
        lines, ahead = np.moveaxis(sums, axis, 0), max(len(total) - reach, 0)
        lines[:ahead], lines[ahead:] = total[reach:], total[-1:]
        lines[reach + 1 :] -= total[: max(ahead - 1, 0)]
    return sums


def columns(x: ArrayLike, y: ArrayLike | None, z: ArrayLike | None) -> list[NDArray[np.float64]]:
    """Three arrays of one length, from three or from one of shape (n, 3); StageError where shapes
    differ."""
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
    """Which points (n,) have finite coordinates, and are of the mask where one is given; StageError
    where that differs."""
    use = np.logical_and.reduce([np.isfinite(axis) for axis in axes])
    if mask is None:
        return use
    kept = np.asarray(mask, bool)
    if kept.shape != use.shape:
        raise StageError(
            "'mask' must have one value per point", found=f"{kept.shape}, {len(use):,} points"
        )
    return use & kept


def lowest_points(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    z: NDArray[np.float64],
    cell: NDArray[np.int64],
    count: int,
) -> NDArray[np.int64]:
    """Numbers of the points that are the lowest of each of `count` cells, by the numbers of these;
    -1 where there is none.

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
) -> NDArray[np.int64]:
    """Return the indices of the points that are the lowest usable ones of their cells.

    Coordinates are finite, in meters.
    """
    mine = np.flatnonzero(use & (np.abs(z) < HIGHEST))
    x, y, z = x[mine], y[mine], z[mine]
    key = cell_keys(cell_numbers(x, cell), cell_numbers(y, cell))
    cells, number = np.unique(key, return_inverse=True)
    return mine[lowest_points(x, y, z, number, len(cells))]


def levels(
    z: NDArray[np.float64], cell: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Points (n,) in the order of their cells' numbers (small ones) and of their heights, and which
    begin a level of a cell.

    A cell's points are parted where a gap is wide: the ground and the deck over it, a roof and what
    it stands on. The lowest points of levels are levels again, each by itself, so they stand for
    all points of places far away.
    """
    rank = np.empty(len(z), np.int64)
    rank[np.argsort(z)] = np.arange(len(z))
    order = np.argsort(cell * len(z) + rank)
    return order, begins_run(cell[order]) | (np.diff(z[order], prepend=-np.inf) > GAP)
