"""Straight lines that cells of wires which touch lie along: two lines of wires that cross are two spans, and so are both
sides of a bend.

Lines are taken out one after the other, each the longest run of cells in a strip of any direction (a Hough transform, on
whole cells), and those that run side by side are put together again: conductors of one span.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..base.jit import njit

#: Half the width of a strip, meters.
STRIP = 0.8
#: Gaps in a run along a strip, meters: where another line crosses, or a wire was not seen.
GAP = 3.0
#: The least that a line adds to those before it, meters.
LEAST = 8.0
#: Lines that run side by side are at most so far from parallel, degrees.
PARALLEL = 9
#: What is wider on average, for the length of the lines in it, is left in one piece: no wires, meters.
WIDTH = 2.5
#: What reaches farther is left in one piece, meters: a line for which towers are no class of their own.
FARTHEST = 1000.0
#: Steps of direction in half a turn.
_WAYS = 180


def parted(row: NDArray[np.int64], column: NDArray[np.int64], size: float, gap: float) -> NDArray[np.int64]:
    """Number of each cell's line, from 0 in the order of their first cells; all 0 where there is one.

    Parameters
    ----------
    row, column : (n,) int64
        Of cells, row by row.
    size : float
        Side of a cell, meters.
    gap : float
        Lines side by side are apart by more, or one, meters.
    """
    one = np.zeros(len(row), np.int64)
    extent = np.hypot(float(np.ptp(row)), float(np.ptp(column))) * size
    if not LEAST <= extent <= FARTHEST:
        return one
    turns = np.arange(_WAYS) * (np.pi / _WAYS)
    strip, away = max(1.0, STRIP / size), max(1.0, GAP / size)
    owner, ways = _lines(
        row - row.min(), column - column.min(), np.cos(turns), np.sin(turns), strip, away, LEAST / size
    )
    if len(ways) < 2:
        return one
    owner = _together(row, column, owner, ways, gap / size + 1.5)
    length = 0.0
    for line in np.unique(owner):
        mine, turn = owner == line, turns[ways[line]]
        length += float(np.ptp(column[mine] * np.cos(turn) + row[mine] * np.sin(turn))) + 1.0
    if len(row) * size > max(WIDTH, 2 * size) * length:
        return one
    first = np.full(len(ways), len(row))
    np.minimum.at(first, owner, np.arange(len(row)))
    order = np.argsort(first, kind="stable")
    rank = np.empty(len(ways), np.int64)
    rank[order] = np.arange(len(ways))
    return rank[owner]


@njit
def _lines(
    row: NDArray, column: NDArray, c: NDArray, s: NDArray, strip: float, gap: float, least: float
) -> tuple[NDArray, NDArray]:
    """Of each cell its line; of each line the way it goes, a step of direction."""
    many = len(row)
    x, y = column.astype(np.float64), row.astype(np.float64)
    owner = np.full(many, -1, np.int64)
    ways = np.empty(many, np.int64)
    middles, begins, ends = np.empty(many), np.empty(many), np.empty(many)
    size = int(np.hypot(x.max(), y.max())) + 3
    seen = np.zeros((2 * size, 2 * size), np.int8)  # by strip, then along: 1 a line's, 2 of none yet
    count = 0
    fresh = np.zeros(2 * size, np.int64)
    along, aside = np.empty(many, np.int64), np.empty(many, np.int64)
    while count < many:
        best, best_way, best_strip, best_from, best_to = 0.0, -1, 0, 0, 0
        for way in range(len(c)):
            for n in range(many):
                along[n] = int(np.floor(x[n] * c[way] + y[n] * s[way])) + size
                aside[n] = int(np.floor((y[n] * c[way] - x[n] * s[way]) / strip)) + size
                new = owner[n] < 0
                for k in (aside[n], aside[n] - 1):  # strips overlap by half
                    seen[k, along[n]] = max(seen[k, along[n]], np.int8(2 if new else 1))
                    fresh[k] += new
            for m in range(many):
                for k in (aside[m], aside[m] - 1):
                    if 2 * fresh[k] <= best:
                        continue
                    start, last, run = -1, -1, 0.0
                    for at in range(2 * size):
                        if seen[k, at] == 0:
                            continue
                        if last < 0 or at - last > gap:
                            start, run = at, 0.0
                        elif seen[k, at] == 2:
                            run += min(at - last, 2.0)
                        last = at
                        if run > best:
                            best, best_way, best_strip, best_from, best_to = run, way, k, start, at
                    fresh[k] = 0  # looked at
            for n in range(many):
                for k in (aside[n], aside[n] - 1):
                    seen[k, along[n]] = 0
                    fresh[k] = 0
        if best < least:
            break
        middles[count] = (best_strip - size + 1) * strip
        ways[count] = best_way
        begins[count], ends[count] = best_from - size, best_to - size + 1
        for n in range(many):
            if (
                owner[n] < 0
                and _off(x[n], y[n], c, s, best_way, middles[count], begins[count], ends[count]) <= strip
            ):
                owner[n] = count
        count += 1
    for n in range(many):  # what lies along none goes to the nearest
        nearest = np.inf
        if owner[n] >= 0:
            continue
        for line in range(count):
            off = _off(x[n], y[n], c, s, ways[line], middles[line], begins[line], ends[line])
            if off < nearest:
                nearest, owner[n] = off, line
    return owner, ways[:count].copy()


@njit
def _off(x, y, c, s, way, middle, begin, end):
    """How far a place lies from a line."""
    along, aside = x * c[way] + y * s[way], y * c[way] - x * s[way]
    beyond = max(0.0, begin - along, along - end)
    return np.hypot(beyond, aside - middle)


@njit
def _together(row: NDArray, column: NDArray, owner: NDArray, ways: NDArray, near: float) -> NDArray:
    """Lines with those put together that run side by side: of each cell the first of them."""
    first = np.arange(len(ways))
    reach = int(near)
    low_row, low_column = row.min() - reach, column.min() - reach
    image = np.full((row.max() - low_row + reach + 1, column.max() - low_column + reach + 1), -1, np.int64)
    for n in range(len(row)):
        image[row[n] - low_row, column[n] - low_column] = owner[n]
    for n in range(len(row)):
        r, c = row[n] - low_row, column[n] - low_column
        for i in range(-reach, reach + 1):
            for j in range(-reach, reach + 1):
                other = image[r + i, c + j]
                if other < 0 or first[other] == first[owner[n]] or i * i + j * j > near * near:
                    continue
                turn = abs(ways[owner[n]] - ways[other])
                if min(turn, _WAYS - turn) > PARALLEL:
                    continue
                low, high = min(first[owner[n]], first[other]), max(first[owner[n]], first[other])
                for line in range(len(ways)):
                    if first[line] == high:
                        first[line] = low
    out = np.empty(len(row), np.int64)
    for n in range(len(row)):
        out[n] = first[owner[n]]
    return out
