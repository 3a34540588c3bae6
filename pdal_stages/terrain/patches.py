"""Points cut into pieces whose rasters are small wherever points lie: groups far apart, and squares with surroundings."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import begins_run
from .linked import number_sets

#: The largest raster that is made in one piece, in cells; else squares of this side plus the reach.
LARGEST, SIDE = 2048 * 2048, 1024
#: A raster of more cells than so many for each point, and these, is looked at for land without points.
_EMPTY, _FEW = 32, 1 << 16
#: Blocks along the way that links two points.
_PARTS = 4

_Piece = tuple[NDArray[np.int64] | slice, NDArray[np.bool_] | slice]


def patches(
    column: NDArray[np.int64], row: NDArray[np.int64], reach: int, link: int, largest: int | None = None
) -> Iterator[_Piece]:
    """Yield (points, own): the points of a piece and those round it that matter, and which of them are its own.

    Every point is some piece's own. Points more than `reach` cells away, along either axis, do not matter; nor do
    points that no chain of others connects with steps of at most `link` cells. One piece, all points, where the whole
    is small enough: a raster of `largest` cells, by default `LARGEST`.
    """
    largest = LARGEST if largest is None else largest
    cells = _cells(column, row)
    if cells <= largest and not _is_empty(cells, len(column)):
        yield slice(None), slice(None)
        return
    for group in _groups(column, row, link):
        c, r = column[group], row[group]
        if _cells(c, r) <= largest:
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
