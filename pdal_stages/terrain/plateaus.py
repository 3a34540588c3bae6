"""Ground without a way up: what is higher than all around it on every side is a roof, not terrain.

Openings miss roofs wider than their window and roofs that fall in several small steps, and a few cells of a roof that were
taken for ground spread. So cells are linked where one can walk from one to the next. A set of linked cells that is no
wider than a large hall, and from which the ground around, on every side, lies a jump down, is a plateau without a ramp.
"""

from __future__ import annotations

import numpy as np

from ..base.jit import njit
from .linked import linked_cells

#: The widest roof, in meters along either axis.
WIDEST = 200.0
#: Two cells are linked across a step of so many meters, or of so much per meter of their distance.
STEP, GRADE = 0.75, 0.3
#: How far apart cells are linked, and how far beyond an edge ground is looked for, in cells.
LINK, BEYOND = 4, 8
#: A jump down has more than so many meters, and more than so much per meter of distance.
JUMP, WALL = 1.5, 0.75
#: The share of a set's cells that must have been taken for ground: a few are more likely ground among treetops.
FOOTING = 0.05
#: Lower ground must lie in so many of 16 directions from the middle, and be such a share of the ground that is lower or
#: less than a step away, where there may be a way up; a higher story does not count. Around ground on a steep slope as
#: much lies a jump higher as lower: from a plateau's ground, the former is no more than half of the latter.
DIRECTIONS, SHARE = 14, 0.8


def reach(cell: float) -> int:
    """How far away cells change what is a plateau, in cells."""
    return int(WIDEST / cell) + 1 + LINK + BEYOND


@njit
def _look_around(number, asked, ground, raster, cell, sums, sectors, around, level, uphill):
    """Of each set asked for: in which directions ground lies a jump lower, how often, how high, and how often level.

    And of the set's own ground, twice how often other ground lies a jump higher, less how often it lies a jump lower.
    """
    h, w = number.shape
    for j in range(h):
        for i in range(w):
            k = number[j, i]
            if k < 0 or not asked[k]:
                continue
            for y in range(max(j - BEYOND, 0), min(j + BEYOND + 1, h)):
                for x in range(max(i - BEYOND, 0), min(i + BEYOND + 1, w)):
                    if not ground[y, x] or number[y, x] == k:
                        continue
                    drop = raster[j, i] - raster[y, x]
                    jump = max(JUMP, WALL * cell * np.sqrt(float((y - j) ** 2 + (x - i) ** 2)))
                    if ground[j, i]:
                        uphill[k] += 2 * (drop < -jump) - (drop > jump)
                    if drop > jump:
                        around[k, 0] += 1
                        level[k] += raster[y, x]
                        # From the set's middle, times its size: whole numbers, the same wherever the array begins.
                        v, u = y * sums[k, 2] - sums[k, 0], x * sums[k, 2] - sums[k, 1]
                        turn = np.arctan2(float(v), float(u)) / (2 * np.pi) + 1.0
                        sectors[k, int(turn * 16) % 16] = True
                    elif abs(drop) < STEP:
                        around[k, 1] += 1


def remove_plateaus(
    ground: np.ndarray, floor: np.ndarray, raster: np.ndarray, cell: float, more: np.ndarray
) -> None:
    """Take plateaus from the `ground` (h, w) of a minimum grid; what lies around them becomes their `floor`.

    `raster` (h, w) holds the heights, in meters like `cell`, a cell's side; ground is measured everywhere. `more` cells,
    numbered row by row, become ground where they are of no plateau, and show none.
    """
    number, size, side = linked_cells(raster, LINK, lambda away: np.maximum(STEP, GRADE * cell * away))
    rows, columns = np.nonzero(number >= 0)
    sets = number[rows, columns]
    count = len(size)
    sums = np.column_stack([np.bincount(sets, rows, count), np.bincount(sets, columns, count), size]).astype(
        np.int64
    )
    grounds = np.bincount(number[ground], minlength=count)
    asked = (grounds > FOOTING * size) & (side < int(WIDEST / cell))
    sectors, around, level = np.zeros((count, 16), bool), np.zeros((count, 2), np.int64), np.zeros(count)
    uphill = np.zeros(count, np.int64)
    _look_around(number, asked, ground, raster, cell, sums, sectors, around, level, uphill)
    lower = around[:, 0]
    plateau = (sectors.sum(axis=1) >= DIRECTIONS) & (lower >= SHARE * around.sum(axis=1)) & (uphill <= 0)
    level[plateau] /= lower[plateau]
    ground.ravel()[more] = True
    taken = ground & np.append(plateau, False)[number]
    ground[taken] = False
    floor[taken] = level[number[taken]]
