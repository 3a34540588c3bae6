"""Surfaces one above the other: the lowest points of each cell's levels.

A cell's points, sorted by height, are parted where a gap is wide: the ground and the deck over it, a roof and what it
stands on. The lowest points of levels are levels again, each by itself, so they stand for all points of places far away.
"""

from __future__ import annotations

import numpy as np

from ..base.jit import device, njit

#: Levels of a cell are so many meters apart, at least.
GAP = 1.0
#: Points of a cell that are sorted in place.
_FEW = 48


@device
def _sort(values, numbers):
    """Sort a few heights and their numbers."""
    for a in range(1, len(values)):
        value, number = values[a], numbers[a]
        b = a - 1
        while b >= 0 and values[b] > value:
            values[b + 1], numbers[b + 1] = values[b], numbers[b]
            b -= 1
        values[b + 1], numbers[b + 1] = value, number


@njit
def levels(z, use, column, row, left, bottom, h, w):
    """Levels of the cells of a raster (h, w): heights, ascending in each cell, and the points that are their lowest.

    Returns both, and where each cell's levels begin (h * w + 1).
    """
    begin = np.zeros(h * w + 1, np.int64)
    for p in range(len(z)):
        if use[p]:
            begin[(row[p] - bottom) * w + column[p] - left + 1] += 1
    for k in range(h * w):
        begin[k + 1] += begin[k]
    fill = begin[:-1].copy()
    heights, numbers = np.empty(begin[-1]), np.empty(begin[-1], np.int64)
    for p in range(len(z)):
        if use[p]:
            k = (row[p] - bottom) * w + column[p] - left
            heights[fill[k]], numbers[fill[k]] = z[p], p
            fill[k] += 1
    start = np.zeros(h * w + 1, np.int64)
    n = 0
    for k in range(h * w):
        own, mine = heights[begin[k] : begin[k + 1]], numbers[begin[k] : begin[k + 1]]
        if len(own) > _FEW:
            order = np.argsort(own)
            own[:], mine[:] = own[order], mine[order]
        else:
            _sort(own, mine)
        start[k] = n
        highest = 0.0
        for p in range(len(own)):
            here, number = own[p], mine[p]  # what is kept overtakes nothing that is still to be read
            if p == 0 or here - highest > GAP:
                heights[n], numbers[n] = here, number
                n += 1
            highest = here
    start[h * w] = n
    return heights[:n].copy(), numbers[:n].copy(), start
