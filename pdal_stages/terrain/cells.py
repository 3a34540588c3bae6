"""Cells of grids anchored to absolute coordinates: what lies lowest in them, which belong together, sums around them.

Points are cut into pieces whose rasters are small wherever points lie: groups far apart, and squares with surroundings.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..base.errors import StageError
from ..base.grid import begins_run, places_among
from ..base.jit import device, njit
from ..base.las_check import DAMAGED

#: What a raster has where nothing was measured.
HOLE = np.float32(np.inf)
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


@device
def root_of(parent, member):
    """The member that stands for a set, in sets that are joined one by one; the way to it gets shorter for who asks next."""
    while parent[member] != member:
        parent[member] = parent[parent[member]]
        member = parent[member]
    return member


@njit
def number_sets(one, other, number):
    """Number alike the members (n,) of each set that the pairs join, in the order of first members; how many sets there are.

    By hand: scipy.sparse.csgraph takes 0.4 s to be imported.
    """
    parent = np.arange(len(number))
    for k in range(len(one)):
        a, b = root_of(parent, one[k]), root_of(parent, other[k])
        parent[max(a, b)] = min(a, b)
    count = 0
    for i in range(len(number)):
        root = root_of(parent, i)
        number[i] = count if root == i else number[root]
        count += root == i
    return count


@njit
def _linked(padded, offsets, steps, reach, number):
    """Number the measured cells of each linked set alike; returns how many sets there are."""
    h, w = number.shape
    parent = np.arange(h * w)
    for j in range(h):
        for i in range(w):
            here, mine = padded[j, i + reach], root_of(parent, j * w + i)
            if here == HOLE:
                continue
            for k in range(len(steps)):
                b, a = j + offsets[k, 0], i + offsets[k, 1]
                if (
                    abs(padded[b, a + reach] - here) <= steps[k] and parent[b * w + a] != mine
                ):  # nor a hole
                    other = root_of(parent, b * w + a)
                    mine, other = min(mine, other), max(mine, other)
                    parent[other] = mine
    count = 0
    for j in range(h):
        for i in range(w):
            if padded[j, i + reach] != HOLE:
                root = root_of(parent, j * w + i)  # the first of its set
                if root == j * w + i:
                    number[j, i] = count
                    count += 1
                else:
                    number[j, i] = number[root // w, root % w]
    return count


def linked_cells(
    raster: NDArray[np.float32],
    reach: float,
    step: Callable[[NDArray[np.float64]], NDArray[np.float64]],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Number of each cell's set (h, w), -1 in holes; sizes of the sets (n,), and their :func:`longest_sides`.

    Cells at most `reach` away from each other are linked across a `step` of meters, by the distance in cells.
    """
    side = int(reach)
    j, i = np.mgrid[: side + 1, -side : side + 1]
    away = np.hypot(j, i)
    after = ((j > 0) | (i > 0)) & (away <= reach)
    number = np.full(raster.shape, -1)
    # With holes beside and below, so that no step has to look where the raster ends.
    padded = np.pad(raster, ((0, side), (side, side)), constant_values=HOLE)
    offsets = np.column_stack([j[after], i[after]])
    count = _linked(padded, offsets, step(away[after]).astype(np.float32), side, number)
    rows, columns = np.nonzero(number >= 0)
    sets = number[rows, columns]
    return number, np.bincount(sets, minlength=count), longest_sides(sets, (rows, columns), count)


def longest_sides(
    label: NDArray[np.int64], places: Sequence[NDArray[np.int64]], count: int
) -> NDArray[np.int64]:
    """Of each of `count` sets of places, the difference of its last and first along each axis: the largest one."""
    sides = np.zeros((len(places), count), np.int64)
    for side, at in zip(sides, places, strict=True):
        first, last = np.full((2, count), at[0] if len(at) else 0)
        first[label] = last[label] = at
        np.minimum.at(first, label, at)
        np.maximum.at(last, label, at)
        side[:] = last - first
    return sides.max(axis=0)


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


def patches(
    column: NDArray[np.int64], row: NDArray[np.int64], reach: int, link: int
) -> Iterator[tuple[NDArray[np.int64] | slice, NDArray[np.bool_] | slice]]:
    """Yield (points, own): the points of a piece and those round it that matter, and which of them are its own.

    Every point is some piece's own. Points more than `reach` cells away, along either axis, do not matter; nor do
    points that no chain of others connects with steps of at most `link` cells. One piece, all points, where the whole
    is small enough.
    """
    window = CellWindow.round(column, row)
    if window.width * window.height <= min(LARGEST, _FEW + _EMPTY * len(column)):
        yield slice(None), slice(None)
        return
    groups = _groups(column, row, link)
    refuse_scattered([len(group) for group in groups])
    for group in groups:
        c, r = column[group], row[group]
        window = CellWindow.round(c, r)
        if window.width * window.height <= LARGEST:
            yield group, slice(None)
            continue
        for own in runs(keys_of(c // SIDE, r // SIDE)):
            inside = CellWindow.round(c[own], r[own]).grown(reach).holds(c, r)
            near, mine = np.flatnonzero(inside), np.zeros(len(c), bool)
            mine[own] = True
            for part in _groups(c[near], r[near], link):
                if mine[near[part]].any():
                    yield group[near[part]], mine[near[part]]


def refuse_scattered(counts: Collection[int]) -> None:
    """Refuse points that are alone in most of their places: each would take milliseconds, and none tells anything.

    `counts` are the points of each place.
    """
    alone = sum(n == 1 for n in counts)
    if alone > 4000 and 2 * alone > len(counts):
        raise StageError(
            "thousands of points lie alone, far from any other",
            found=f"{alone:,} of {sum(counts):,} points",
            cure=f"Look whether the file's scale and unit are right: pdal info --summary FILE. {DAMAGED}",
        )


def _groups(
    column: NDArray[np.int64], row: NDArray[np.int64], link: int
) -> list[NDArray[np.int64]]:
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
