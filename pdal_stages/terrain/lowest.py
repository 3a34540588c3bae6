"""The lowest point of every cell of a grid anchored to absolute coordinates, and which of them are pits.

A pit is a low outlier: an echo from below the ground (multiple reflections, noise) that would pull the
terrain down. Ground seen through a canopy lies as deep below its surroundings, but not alone, and what it
lies below is rough; where it is rare, it lies on one plane with half of what is as low (:mod:`.sheets`).
Clusters of such echoes keep each other company: see :mod:`.islands`.
"""

from __future__ import annotations

import numpy as np

from ..base.jit import device, njit
from .islands import mark_islands
from .openings import HOLE, by_distance
from .sheets import seen_through_canopy

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


def framed(raster: np.ndarray) -> np.ndarray:
    """The raster (h, w) with holes around it, as far as company is looked for: no step has to look where it ends."""
    h, w = raster.shape
    out = np.full((h + 2 * COMPANY, w + 2 * COMPANY), HOLE)
    out[COMPANY : COMPANY + h, COMPANY : COMPANY + w] = raster
    return out


@njit
def _lonely(wide, offsets, levels, out):
    """Mark cells without enough others at `offsets` (in numbers of the framed raster, row by row), each within its level."""
    h, w = out.shape
    stride = wide.shape[1]
    flat = wide.ravel()
    for j in range(h):
        for i in range(w):
            at = (j + COMPANY) * stride + i + COMPANY
            here = flat[at]
            if here == HOLE:
                continue
            company = 0
            for k in range(len(offsets)):
                if abs(flat[at + offsets[k]] - here) <= levels[k]:  # nor a hole
                    company += 1
                    if company == NEED:
                        break
            if company < NEED:
                seen = 0
                for k in range(len(offsets)):
                    seen += flat[at + offsets[k]] != HOLE
                out[j, i] = seen >= IN_VIEW


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


@device
def _lower(row, first, level):
    """How many of the cells of a window's row lie lower."""
    low = 0
    for i in range(first, first + 2 * SURROUNDINGS + 1):
        low += row[i] < level
    return low


@njit
def _below_smooth(wide, out):
    h, w = out.shape
    near = 2 * SURROUNDINGS + 1
    higher = np.empty(near * near)
    columns = np.zeros(wide.shape[1], np.int64)  # cells with points in those rows of each
    for b in range(COMPANY - SURROUNDINGS, COMPANY + SURROUNDINGS):
        for a in range(len(columns)):
            columns[a] += wide[b, a] != HOLE
    for j in range(h):
        y = j + COMPANY
        for a in range(len(columns)):
            columns[a] += (wide[y + SURROUNDINGS, a] != HOLE) - (wide[y - SURROUNDINGS - 1, a] != HOLE)
        first = COMPANY - SURROUNDINGS
        seen = np.int64(0)  # summed here: numba's own sum brings linear algebra into every job
        for a in range(first - 1, first + near - 1):
            seen += columns[a]
        for i in range(w):
            first = i + COMPANY - SURROUNDINGS
            seen += columns[first + near - 1] - columns[first - 1]
            here = wide[y, i + COMPANY]
            if here == HOLE:
                continue
            # Most cells have enough others near that are no higher.
            level, most = here + DROP, SHARE * seen
            low = _lower(wide[y], first, level)
            step = 1
            while low <= most and step <= SURROUNDINGS:
                low += _lower(wide[y - step], first, level) + _lower(wide[y + step], first, level)
                step += 1
            n = seen - low
            if low > most or n < MANY:
                continue
            n = 0
            for b in range(y - SURROUNDINGS, y + SURROUNDINGS + 1):
                for a in range(first, first + near):
                    if level <= wide[b, a] < HOLE:
                        higher[n] = wide[b, a]
                        n += 1
            _sort(higher, n)
            if higher[n // 2] - higher[n // 8] <= SPREAD:
                out[j, i] = 2


def pits(raster: np.ndarray, cell: float) -> np.ndarray:
    """Cells (h, w) of a minimum grid whose lowest point is a low outlier, from float32 heights, holes ``inf``; in meters."""
    out = np.zeros(raster.shape, np.uint8)
    offsets, distances = by_distance(COMPANY)
    wide = framed(raster)
    _lonely(wide, offsets @ [wide.shape[1], 1], LEVEL + GRADE * cell * distances, out)
    wide[COMPANY:-COMPANY, COMPANY:-COMPANY][out != 0] = HOLE
    _below_smooth(wide, out)
    mark_islands(raster, cell, 3, out)
    low = out > 0
    low &= ~seen_through_canopy(np.where(low, raster, HOLE), np.where(low, HOLE, raster), None, cell)
    return low
