"""Coordinates and the cells they fall in, of grids anchored to absolute coordinates; what lies lowest in cells; pieces.

Points are cut into pieces whose rasters are small wherever points lie: groups far apart, and squares with surroundings.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..base.arrays import begins_run
from ..base.errors import StageError
from .linked import number_sets

#: Largest cell index either side of zero; beyond it coordinates cannot be terrain.
_INDEX_LIMIT = 2**31 - 2
#: Heights beyond this, in meters, are no terrain, and too much for the sums.
HIGHEST = 1e6
#: Levels of a cell are so many meters apart, at least.
GAP = 1.0
#: The largest raster that is made in one piece, in cells; else squares of this side plus the reach.
LARGEST, SIDE = 2100 * 2100, 1024
#: A raster of more cells than so many for each point, and these, is looked at for land without points.
_EMPTY, _FEW = 32, 1 << 16
#: Blocks along the way that links two points.
_PARTS = 4

_Piece = tuple[NDArray[np.int64] | slice, NDArray[np.bool_] | slice]


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


def places_among(
    keys: NDArray[np.int64], wanted: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Where wanted keys are among others, ascending and some; and whether they are."""
    place = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    return place, keys[place] == wanted


def lowest_points(
    x: NDArray[np.float64], y: NDArray[np.float64], z: NDArray[np.float64], key: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Numbers of the points that are the lowest of the cells whose keys they have, ascending by these.

    Of points of one height the first by x, then y, is taken, so that order does not matter.
    """
    cells, number = np.unique(key, return_inverse=True)
    lowest = np.full(len(cells), np.inf)
    np.minimum.at(lowest, number, z)
    low = np.flatnonzero(z == lowest[number])
    low = low[np.lexsort((y[low], x[low], number[low]))]
    return low[begins_run(number[low])]


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
    low, high = lowest_points(x, y, z, key), lowest_points(x, y, -z, key)
    return mine[low], z[high]


def levels(z: NDArray[np.float64], cell: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Points (n,) in the order of their cells' numbers (small ones) and of their heights, and which begin a level of a cell.

    A cell's points are parted where a gap is wide: the ground and the deck over it, a roof and what it stands on. The lowest
    points of levels are levels again, each by itself, so they stand for all points of places far away.
    """
    rank = np.empty(len(z), np.int64)
    rank[np.argsort(z)] = np.arange(len(z))
    order = np.argsort(cell * len(z) + rank)
    return order, begins_run(cell[order]) | (np.diff(z[order], prepend=-np.inf) > GAP)


def patches(column: NDArray[np.int64], row: NDArray[np.int64], reach: int, link: int) -> Iterator[_Piece]:
    """Yield (points, own): the points of a piece and those round it that matter, and which of them are its own.

    Every point is some piece's own. Points more than `reach` cells away, along either axis, do not matter; nor do
    points that no chain of others connects with steps of at most `link` cells. One piece, all points, where the whole
    is small enough.
    """
    cells = _cells(column, row)
    if cells <= min(LARGEST, _FEW + _EMPTY * len(column)):
        yield slice(None), slice(None)
        return
    for group in _groups(column, row, link):
        c, r = column[group], row[group]
        if _cells(c, r) <= LARGEST:
            yield group, slice(None)
            continue
        for own in runs(keys_of(c // SIDE, r // SIDE)):
            west, east, south, north = c[own].min(), c[own].max(), r[own].min(), r[own].max()
            inside = (c >= west - reach) & (c <= east + reach) & (r >= south - reach) & (r <= north + reach)
            near, mine = np.flatnonzero(inside), np.zeros(len(c), bool)
            mine[own] = True
            for part in _groups(c[near], r[near], link):
                if mine[near[part]].any():
                    yield group[near[part]], mine[near[part]]


def _cells(column: NDArray[np.int64], row: NDArray[np.int64]) -> int:
    """Cells of the smallest raster round points."""
    return (int(column.max()) - int(column.min()) + 1) * (int(row.max()) - int(row.min()) + 1)


def _groups(column: NDArray[np.int64], row: NDArray[np.int64], link: int) -> list[NDArray[np.int64]]:
    """Points that belong together: all within `link` cells of each other, and few that are a little farther apart."""
    side = -(-link // _PARTS)
    rings = -(-link // side)
    blocks, of = np.unique(keys_of(column // side, row // side), return_inverse=True)
    pairs = []
    for b in range(rings + 1):
        for a in range(-rings if b else 1, rings + 1):
            at, there = places_among(blocks, blocks + (b << 32) + a)
            pairs.append([np.flatnonzero(there), at[there]])
    label = np.empty(len(blocks), np.int64)
    number_sets(*np.concatenate(pairs, axis=1), label)
    return runs(label[of])
