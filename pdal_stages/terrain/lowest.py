"""The lowest point of every cell of a grid anchored to absolute coordinates, and which of them are pits.

A pit is a low outlier: an echo from below the ground (multiple reflections, noise) that would pull the
terrain down. Ground seen through a canopy lies as deep below its surroundings, but not alone, and what it
lies below is rough. Clusters of such echoes keep each other company: see :mod:`.islands`.
"""

from __future__ import annotations

import numpy as np

from ..base.jit import device, njit
from .islands import mark_islands
from .openings import HOLE, by_distance

#: Cells within which a lone low cell looks for company, and within which smooth surroundings are judged.
COMPANY, SURROUNDINGS = 20, 4

#: A pit has fewer than `NEED` other cells within `LEVEL` + `GRADE` x distance of its height (meters).
NEED, LEVEL, GRADE = 4, 1.0, 0.15
#: Cells with points that must be in view before a cell may be called lonely.
IN_VIEW = 12
#: Or it lies `DROP` meters below all but a `SHARE` of the cells around, if these are smooth: from the lowest
#: eighth to the middle no more than `SPREAD` meters, and `MANY`.
DROP, SPREAD, SHARE, MANY = 3.0, 0.75, 0.15, 10


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


@njit
def heights_of(z, grid):
    """Height of each cell's lowest point."""
    raster = np.full(grid.shape, HOLE, np.float32)
    for j in range(grid.shape[0]):
        for i in range(grid.shape[1]):
            if grid[j, i] >= 0:
                raster[j, i] = z[grid[j, i]]
    return raster


@njit
def places_of(x, y, z, cell, grid):
    """Place in the cell (from its center, in cells) and height of each cell's lowest point."""
    h, w = grid.shape
    place = np.zeros((h, w, 3))
    for j in range(h):
        for i in range(w):
            p = grid[j, i]
            if p >= 0:
                u, v = x[p] / cell, y[p] / cell
                place[j, i, 0] = u - np.floor(u) - 0.5
                place[j, i, 1] = v - np.floor(v) - 0.5
                place[j, i, 2] = z[p]
    return place


@njit
def _lonely(raster, offsets, distances, cell, out):
    h, w = raster.shape
    for j in range(h):
        for i in range(w):
            here = raster[j, i]
            if here == HOLE:
                continue
            company, seen = 0, 0
            for k in range(len(offsets)):
                a, b = j + offsets[k, 0], i + offsets[k, 1]
                if a < 0 or b < 0 or a >= h or b >= w or raster[a, b] == HOLE:
                    continue
                seen += 1
                if abs(raster[a, b] - here) <= LEVEL + GRADE * cell * distances[k]:
                    company += 1
                    if company == NEED:
                        break
            out[j, i] = company < NEED and seen >= IN_VIEW


@device
def _sort(values, n):
    """Sort the first n values, few of them: numpy's sort takes seconds to compile."""
    for i in range(1, n):
        value = values[i]
        j = i
        while j > 0 and values[j - 1] > value:
            values[j] = values[j - 1]
            j -= 1
        values[j] = value


@njit
def _below_smooth(raster, out):
    h, w = raster.shape
    higher = np.empty((2 * SURROUNDINGS + 1) ** 2)
    for j in range(h):
        for i in range(w):
            here = raster[j, i]
            if here == HOLE or out[j, i]:
                continue
            low, n = 0, 0
            for a in range(max(j - SURROUNDINGS, 0), min(j + SURROUNDINGS + 1, h)):
                for b in range(max(i - SURROUNDINGS, 0), min(i + SURROUNDINGS + 1, w)):
                    value = raster[a, b]
                    if value == HOLE or out[a, b] == 1:
                        continue
                    if value < here + DROP:
                        low += 1
                    else:
                        higher[n] = value
                        n += 1
            if n < MANY or low > SHARE * (low + n):
                continue
            _sort(higher, n)
            if higher[n // 2] - higher[n // 8] <= SPREAD:
                out[j, i] = 2


def pits(raster: np.ndarray, cell: float) -> np.ndarray:
    """Cells (h, w) of a minimum grid whose lowest point is a low outlier, from float32 heights, holes ``inf``; in meters."""
    out = np.zeros(raster.shape, np.uint8)
    offsets, distances = by_distance(COMPANY)
    _lonely(raster, offsets, distances, cell, out)
    _below_smooth(raster, out)
    mark_islands(raster, cell, 3, out)
    return out > 0
