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
from .openings import HOLE

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
) -> NDArray[np.int64]:
    """Numbers of the points that are the lowest usable ones of their cells, ascending; meters, finite coordinates."""
    mine = np.flatnonzero(use & (np.abs(z) < HIGHEST))
    x, y, z = x[mine], y[mine], z[mine]
    return np.sort(mine[lowest_points(x, y, z, keys_of(cell_numbers(x, cell), cell_numbers(y, cell)))])


def levels(z: NDArray[np.float64], cell: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Points (n,) in the order of their cells' numbers (small ones) and of their heights, and which begin a level of a cell.

    A cell's points are parted where a gap is wide: the ground and the deck over it, a roof and what it stands on. The lowest
    points of levels are levels again, each by itself, so they stand for all points of places far away.
    """
    rank = np.empty(len(z), np.int64)
    rank[np.argsort(z)] = np.arange(len(z))
    order = np.argsort(cell * len(z) + rank)
    return order, begins_run(cell[order]) | (np.diff(z[order], prepend=-np.inf) > GAP)


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


def patches(column: NDArray[np.int64], row: NDArray[np.int64], reach: int, link: int) -> Iterator[_Piece]:
    """Yield (points, own): the points of a piece and those round it that matter, and which of them are its own.

    Every point is some piece's own. Points more than `reach` cells away, along either axis, do not matter; nor do
    points that no chain of others connects with steps of at most `link` cells. One piece, all points, where the whole
    is small enough.
    """
    cells = _cells(column, row)
    if cells <= LARGEST and not _is_empty(cells, len(column)):
        yield slice(None), slice(None)
        return
    for group in _groups(column, row, link):
        c, r = column[group], row[group]
        if _cells(c, r) <= LARGEST:
            yield group, slice(None)
            continue
        for near, mine in _squares(c, r, reach):
            for part, own in connected(c[near], r[near], mine, link):
                yield group[near[part]], own


def connected(
    column: NDArray[np.int64], row: NDArray[np.int64], mine: NDArray[np.bool_], link: int
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.bool_]]]:
    """Yield (points, own) of a piece and its surroundings, whose own points are `mine`.

    All in one, or where that would be a raster of empty land, in groups without a chain of points between them; groups
    without a point of its own are left out.
    """
    if not mine.any():
        return
    if not _is_empty(_cells(column, row), len(column)):
        yield np.arange(len(column)), mine
        return
    for part in _groups(column, row, link):
        if mine[part].any():
            yield part, mine[part]


def _cells(column: NDArray[np.int64], row: NDArray[np.int64]) -> int:
    """Cells of the smallest raster round points."""
    return (int(column.max()) - int(column.min()) + 1) * (int(row.max()) - int(row.min()) + 1)


def _is_empty(cells: int, points: int) -> bool:
    return cells > _FEW + _EMPTY * points


def _by_block(
    column: NDArray[np.int64], row: NDArray[np.int64], side: int, rings: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], int]:
    """Points in the order of their blocks, numbers of the blocks, where each begins, and the step from row to row."""
    across, along = column // side, row // side
    across, along = across - across.min(), along - along.min()
    stride = (
        int(across.max()) + 1 + rings
    )  # so that no row's end is within so many of the next one's beginning
    key = along * stride + across
    order = np.argsort(key, kind="stable")
    key = key[order]
    starts = np.flatnonzero(begins_run(key))
    return order, key[starts], np.append(starts, len(key)), stride


def _groups(column: NDArray[np.int64], row: NDArray[np.int64], link: int) -> list[NDArray[np.int64]]:
    """Points that belong together: all within `link` cells of each other, and few that are a little farther apart."""
    side = -(-link // _PARTS)
    rings = -(-link // side)
    order, numbers, starts, stride = _by_block(column, row, side, rings)
    if len(numbers) == 1:
        return [order]
    ones, others = [], []
    for b in range(rings + 1):
        for a in range(-rings if b else 1, rings + 1):
            step = b * stride + a
            at = np.minimum(np.searchsorted(numbers, numbers + step), len(numbers) - 1)
            linked = np.flatnonzero(numbers[at] == numbers + step)
            ones.append(linked)
            others.append(at[linked])
    label = np.empty(len(numbers), np.int64)
    if number_sets(np.concatenate(ones), np.concatenate(others), label) == 1:
        return [order]
    of_points = np.repeat(label, np.diff(starts))
    together = np.argsort(of_points, kind="stable")
    return np.split(order[together], np.flatnonzero(begins_run(of_points[together]))[1:])


def _squares(
    column: NDArray[np.int64], row: NDArray[np.int64], reach: int
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.bool_]]]:
    """The points of each square and of `reach` cells round them, and which are the square's own."""
    rings = -(-reach // SIDE)
    order, numbers, starts, stride = _by_block(column, row, SIDE, rings)
    for at, number in enumerate(numbers):
        own = order[starts[at] : starts[at + 1]]
        c, r = column[own], row[own]
        west, east, south, north = c.min() - reach, c.max() + reach, r.min() - reach, r.max() + reach
        near = [own]
        for b in range(-rings, rings + 1):
            low, high = np.searchsorted(
                numbers, [number + b * stride - rings, number + b * stride + rings + 1]
            )
            for k in range(low, high):
                if k != at:
                    these = order[starts[k] : starts[k + 1]]
                    c, r = column[these], row[these]
                    near.append(these[(c >= west) & (c <= east) & (r >= south) & (r <= north)])
        mine = np.zeros(sum(map(len, near)), bool)
        mine[: len(own)] = True
        yield np.concatenate(near), mine
