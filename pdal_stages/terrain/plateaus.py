"""Ground without a way up: what is higher than all around it on every side is a roof, not terrain.

Openings miss roofs wider than their window and roofs that fall in several small steps, and a few cells of a roof that were
taken for ground spread. So cells are linked where one can walk from one to the next. A set of linked cells that is no
wider than a large hall, and from which the ground around, on every side, lies a jump down, is a plateau without a ramp.
"""

from __future__ import annotations

import numpy as np

from ..base.jit import njit
from ..base.unionfind import root as root_of
from .openings import HOLE

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


def _ways(cell):
    """Offsets (row, column) of the cells that one is linked to and that come after it, and across which step."""
    j, i = np.mgrid[: LINK + 1, -LINK : LINK + 1]
    after = ((j > 0) | (i > 0)) & (j * j + i * i <= LINK * LINK)
    steps = np.maximum(STEP, GRADE * cell * np.sqrt((j * j + i * i).astype(float)))
    return np.column_stack([j[after], i[after]]), steps[after]


@njit
def _linked(raster, offsets, steps, number):
    """Number the measured cells of each linked set alike; returns how many sets there are."""
    h, w = raster.shape
    # With holes beside and below, so that no step has to look where the raster ends.
    stride = w + 2 * LINK
    heights = np.full((h + LINK) * stride + LINK, HOLE)
    for j in range(h):
        for i in range(w):
            heights[j * stride + LINK + i] = raster[j, i]
    parent = np.arange(len(heights))
    ahead = offsets[:, 0] * stride + offsets[:, 1]
    for j in range(h):
        for at in range(j * stride + LINK, j * stride + LINK + w):
            here = heights[at]
            if here == HOLE:
                continue
            mine = root_of(parent, at)
            for k in range(len(steps)):
                other = at + ahead[k]
                if abs(heights[other] - here) <= steps[k] and parent[other] != mine:  # nor a hole
                    other = root_of(parent, other)
                    if other > mine:
                        parent[other] = mine
                    elif other < mine:
                        parent[mine] = other
                        mine = other
    count = 0
    names = np.empty(len(heights), np.int32)  # of those who stand for sets, each the first of its own
    for j in range(h):
        for i in range(w):
            at = j * stride + LINK + i
            number[j, i] = -1
            if heights[at] != HOLE:
                root = root_of(parent, at)
                if root == at:
                    names[at] = count
                    count += 1
                number[j, i] = names[root]
    return count


@njit
def _extents(number, ground, box, sums, grounds):
    """First and last row and column of each set, its rows' and columns' sums and its size, and how many are ground."""
    h, w = number.shape
    box[:, 0], box[:, 2] = h, w
    for j in range(h):
        for i in range(w):
            k = number[j, i]
            if k >= 0:
                box[k, 0], box[k, 1] = min(box[k, 0], j), max(box[k, 1], j)
                box[k, 2], box[k, 3] = min(box[k, 2], i), max(box[k, 3], i)
                sums[k, 0] += j
                sums[k, 1] += i
                sums[k, 2] += 1
                grounds[k] += ground[j, i]


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


@njit
def _take(number, plateau, level, ground, floor):
    h, w = number.shape
    for j in range(h):
        for i in range(w):
            if ground[j, i] and plateau[number[j, i]]:
                ground[j, i] = False
                floor[j, i] = level[number[j, i]]


def remove_plateaus(
    ground: np.ndarray, floor: np.ndarray, raster: np.ndarray, cell: float, more: np.ndarray
) -> None:
    """Take plateaus from the `ground` (h, w) of a minimum grid; what lies around them becomes their `floor`.

    `raster` (h, w) holds the heights, in meters like `cell`, a cell's side; ground is measured everywhere. `more` cells,
    numbered row by row, become ground where they are of no plateau, and show none.
    """
    number = np.empty(ground.shape, np.int64)
    count = _linked(raster, *_ways(cell), number)
    box, sums, grounds = (np.zeros((count, *rest), np.int64) for rest in ((4,), (3,), ()))
    _extents(number, ground, box, sums, grounds)
    widest = int(WIDEST / cell)
    asked = grounds > FOOTING * sums[:, 2]
    asked &= (box[:, 1] - box[:, 0] < widest) & (box[:, 3] - box[:, 2] < widest)
    sectors, around, level = np.zeros((count, 16), bool), np.zeros((count, 2), np.int64), np.zeros(count)
    uphill = np.zeros(count, np.int64)
    _look_around(number, asked, ground, raster, cell, sums, sectors, around, level, uphill)
    lower = around[:, 0]
    plateau = (sectors.sum(axis=1) >= DIRECTIONS) & (lower >= SHARE * around.sum(axis=1)) & (uphill <= 0)
    level[plateau] /= lower[plateau]
    ground.ravel()[more] = True
    _take(number, plateau, level, ground, floor)
