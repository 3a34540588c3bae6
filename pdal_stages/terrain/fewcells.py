"""Openings of a raster of which few cells were measured: from cell to cell, not across the empty land between them.

The same bits as :func:`.progressive.objects_of` finds on the whole raster, as minima and maxima do not depend on order.
"""

from __future__ import annotations

import numpy as np

from ..base.jit import device, njit
from .openings import HOLE, square_steps

_NOTHING = np.float32(-np.inf)


def are_few(measured: int, height: int, width: int, largest: int) -> bool:
    """Whether looking at all pairs of measured cells in rows near each other is less than going over the raster."""
    return measured * measured * (2 * largest + 1) < 2 * height * height * width


@device
def _radius_between(dy, dx, squares):
    """The smallest radius of an octagon round a cell that holds another, so many rows and columns away (``squares[r]``)."""
    dy, dx = abs(dy), abs(dx)
    r = max((dy + dx + 1) // 2, dy, dx)  # a square of that half side does not hold it before
    while r < len(squares):
        s = squares[r]
        if max(dx - s, 0) + max(dy - s, 0) <= r - s:
            return r
        r += 1
    return r


@njit
def _pairs(row, column, squares, count, one, other, far):
    """Pairs of cells within the largest octagon, cells given row by row; how many. Filled in where there is room."""
    largest = len(squares) - 1
    for a in range(len(row)):
        b = a + 1
        while b < len(row) and row[b] - row[a] <= largest:
            if abs(column[b] - column[a]) <= largest:
                r = _radius_between(row[b] - row[a], column[b] - column[a], squares)
                if r <= largest:
                    if count < len(one):
                        one[count], other[count], far[count] = a, b, r
                    count += 1
            b += 1
    return count


@njit
def _erode(one, other, level, eroded):
    for k in range(len(one)):
        a, b = one[k], other[k]
        if level[b] < eroded[a]:
            eroded[a] = level[b]
        if level[a] < eroded[b]:
            eroded[b] = level[a]


@njit
def _open(one, other, eroded, opened):
    for a in range(len(eroded)):
        opened[a] = eroded[a]
    for k in range(len(one)):
        a, b = one[k], other[k]
        if eroded[b] > opened[a]:
            opened[a] = eroded[b]
        if eroded[a] > opened[b]:
            opened[b] = eroded[a]


@njit
def _spread(row, column, eroded, radius, squares, out):
    """The opening of a raster's cells, those that were not measured as well."""
    h, w = out.shape
    for k in range(len(row)):
        for dy in range(-radius, radius + 1):
            j = row[k] + dy
            if 0 <= j < h:
                half = min(radius, radius + squares - abs(dy))  # an octagon's half width there
                for i in range(max(column[k] - half, 0), min(column[k] + half + 1, w)):
                    if eroded[k] > out[j, i]:
                        out[j, i] = eroded[k]


@njit
def _mark(before, after, drop, objects, floor):
    for k in range(len(before)):
        if not objects[k] and before[k] - after[k] > drop:
            objects[k] = True
            floor[k] = after[k]


def objects_among(
    raster: np.ndarray, drops: dict[int, np.float32], keep: set[int], narrowest: int
) -> tuple[np.ndarray, np.ndarray, dict[int, np.ndarray], np.ndarray]:
    """Objects, what is left there, and the openings of `keep`, as :func:`.progressive.objects_of` gives them.

    `raster` (h, w) is the minimum grid, `drops` holds for each radius, ascending, what an opening lowers an object by, and
    `narrowest` is the first radius of windows that are wide.
    """
    row, column = np.nonzero(raster != HOLE)
    level = raster[row, column]
    largest = max([*drops, *keep])
    squares = np.array([square_steps(radius) for radius in range(largest + 1)], np.int64)
    room = np.empty(0, np.int64)
    count = _pairs(row, column, squares, 0, room, room, room)
    one, other, far = np.empty((3, count), np.int64)
    _pairs(row, column, squares, 0, one, other, far)
    order = np.argsort(far, kind="stable")
    one, other, ends = one[order], other[order], np.searchsorted(far[order], np.arange(largest + 2))
    eroded, before, after = level.copy(), level.copy(), np.empty_like(level)
    found, left = np.zeros(len(level), bool), level.copy()
    openings, narrow = {}, found
    for radius in range(1, largest + 1):
        part = slice(ends[radius], ends[radius + 1])
        _erode(one[part], other[part], level, eroded)
        if radius in keep:
            openings[radius] = np.full(raster.shape, _NOTHING)
            _spread(row, column, eroded, radius, squares[radius], openings[radius])
        if radius == narrowest:
            narrow = found.copy()
        if radius in drops:
            _open(one[: part.stop], other[: part.stop], eroded, after)
            _mark(before, after, drops[radius], found, left)
            before, after = after, before
    objects, wide, floor = np.zeros(raster.shape, bool), np.zeros(raster.shape, bool), raster.copy()
    objects[row, column], wide[row, column], floor[row, column] = found, found & ~narrow, left
    return objects, floor, openings, wide
