"""Roofs that the slope uphill runs into, as of houses dug into it: to openings and to plateaus they are terraces.

Cells are linked where one can walk from one to the next, but not across creases, where the surface bends upward: between a
roof and the slope. A set of linked cells is a roof if it is as large as a house, if walls go down from it in most directions
and along most of its rim, if few of its cells are next to creases, and if it is level on the whole, flat or gabled.
Terraces are longer, knolls have no walls, rocks are full of creases, and what lies on a steep slope is tilted as that is.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..base.jit import njit
from .cells import HOLE, linked_cells
from .openings import FOOTING, GRADE, STEP, direction, highest_around, sums_of_sets

#: A crease bends upward by so many meters from the middle of a chord that goes so many meters to both sides, and by so much
#: more where the chord is steep: the lowest points of cells lie anywhere in these.
CREASE, ARM, TILT = 0.3, 4.0, 0.3
#: The smallest roof in square meters, the widest in meters along either axis.
SMALLEST, WIDEST = 40.0, 35.0
#: A wall goes down by more than so many meters, and by more than so much per meter of distance, within so many meters; one
#: wall is as high as this at least.
DROP, WALL, BEYOND, HIGH = 1.0, 1.0, 2.0, 1.8
#: Walls are in so many of 16 directions from the middle, and along such a share of what of the rim is not at a hole; such a
#: share of the cells may be next to creases.
DIRECTIONS, SHARE, CREASED = 10, 0.5, 0.4
#: The plane through a roof rises by less than this, in meters per meter.
LEVEL = 0.4


@njit
def _creases(raster, arm, cell):
    """Cells where the surface bends upward in one of four directions, between the farthest cells on both sides."""
    h, w = raster.shape
    out = np.zeros((h, w), np.bool_)
    for j in range(h):
        for i in range(w):
            for d in range(4 if raster[j, i] != HOLE else 0):
                dj, di = min(d, 1), (1, 0, 1, -1)[d]
                length = 1.0 if d < 2 else np.sqrt(2.0)
                before = after = 0
                for s in range(int(arm / length + 0.5), 0, -1):
                    y, x = j - s * dj, i - s * di
                    if before == 0 and y >= 0 and 0 <= x < w and raster[y, x] != HOLE:
                        before = s
                    y, x = j + s * dj, i + s * di
                    if after == 0 and y < h and 0 <= x < w and raster[y, x] != HOLE:
                        after = s
                if before == 0 or after == 0:
                    continue
                one, other = (
                    raster[j - before * dj, i - before * di],
                    raster[j + after * dj, i + after * di],
                )
                both = before + after
                rise = (one * after + other * before) / both - raster[j, i]
                most = CREASE + TILT * abs(one - other) / (both * length * cell)
                if rise > most * 2.0 * before * after / (both * arm):
                    out[j, i] = True
                    break
    return out


@njit
def _rims(number, asked, creases, ground, raster, cell, sums, sectors, rims, low):
    """Of each set asked for: in which directions from its middle walls go down; how many cells are at walls, how many at
    creases and other ground alone, how many at creases; of the walls the mean height of their feet, and the highest one."""
    h, w = number.shape
    reach = max(1, int(BEYOND / cell))
    for j in range(h):
        for i in range(w):
            k = number[j, i]
            if k < 0 or not asked[k]:
                continue
            most, foot, beside, creased = 0.0, 0.0, False, False
            for y in range(max(j - reach, 0), min(j + reach + 1, h)):
                for x in range(max(i - reach, 0), min(i + reach + 1, w)):
                    drop = raster[j, i] - raster[y, x]
                    if max(abs(y - j), abs(x - i)) == 1 and creases[y, x] and abs(drop) <= STEP:
                        creased = True
                    if not ground[y, x] or number[y, x] == k:
                        continue
                    beside = True
                    if drop > max(DROP, WALL * cell * np.sqrt(float((y - j) ** 2 + (x - i) ** 2))):
                        sectors[k, direction(sums[k], y, x)] = True
                        if drop > most:
                            most, foot = drop, raster[y, x]
            rims[k, 0] += most > 0.0
            rims[k, 1] += most == 0.0 and (beside or creased)
            rims[k, 2] += creased
            low[k, 0] += foot
            low[k, 1] = max(low[k, 1], most)


def roofs_of_hillsides(
    ground: NDArray[np.bool_], raster: NDArray[np.float32], cell: float
) -> NDArray[np.float32]:
    """What lies below the cells of the `ground` (h, w) that are roofs a slope runs into; HOLE elsewhere.

    `raster` (h, w) holds the heights of a minimum grid, in meters like `cell`, a cell's side; ground is measured everywhere.
    It looks less far than :func:`.openings.plateau_reach`.
    """
    creases = _creases(raster, max(1.0, ARM / cell), cell)
    number, size, side = linked_cells(
        np.where(creases, HOLE, raster), 1.5, lambda away: np.maximum(STEP, GRADE * cell * away)
    )
    count = len(size)
    grounds = np.bincount(number[ground & ~creases], minlength=count)
    asked = (grounds > FOOTING * size) & (side * cell < WIDEST) & (size * cell * cell >= SMALLEST)
    sectors, rims, low = (
        np.zeros((count, 16), bool),
        np.zeros((count, 3), np.int64),
        np.zeros((count, 2)),
    )
    _rims(
        number, asked, creases, ground, raster, cell, sums_of_sets(number, size), sectors, rims, low
    )
    walls, others, creased = rims.T
    roof = asked & (sectors.sum(axis=1) >= DIRECTIONS) & (walls >= SHARE * (walls + others))
    roof &= (creased <= CREASED * size) & (low[:, 1] >= HIGH)
    for k in np.flatnonzero(roof):
        j, i = np.nonzero(number == k)
        plane = np.column_stack([j - j[0], i - i[0], np.ones(len(j))])
        north, east, _ = np.linalg.lstsq(plane, raster[j, i])[0]
        roof[k] = np.hypot(north, east) < LEVEL * cell
    if not roof.any():
        return np.full(raster.shape, HOLE)
    below = np.append(np.where(roof, low[:, 0] / np.maximum(walls, 1), HOLE), HOLE)[number].astype(
        np.float32
    )
    # Beside the slope roofs are creases.
    beside = -highest_around(-below, max(1, int(BEYOND / cell)), 0)
    return np.where(ground, np.where(creases, beside, below), HOLE)
