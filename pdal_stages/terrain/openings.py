"""What stands on the ground of a minimum grid: what openings by octagons of growing radius show [P13], and plateaus.

A hole is ``+inf``: erosion passes over it, and no window is centered on one, so an opening is the highest
level that a window centered on measured cells reaches. Octagons (squares and diamonds taken in turn) treat
ridges alike whatever their direction, as discs do, but fall apart into lines, so an opening costs the
logarithm of its radius.

Openings miss roofs wider than their window and roofs that fall in several small steps, and a few cells of a roof that were
taken for ground spread. So cells are linked where one can walk from one to the next. A set of linked cells that is no
wider than a large hall, and from which the ground around, on every side, lies a jump down, is a plateau without a ramp: a
roof, not terrain.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.jit import device, njit
from .cells import HOLE, linked_cells

#: Drops beyond this, in meters, are objects however large the window: halls are not higher for being wider.
LARGEST_DROP = 3.5
#: Windows from this radius on, in meters, show halls; how steep the land is, is seen in the first of them. A hall is also
#: lowered by more than such a share of what the land falls within the radius, and a wall is so many times as steep.
WIDE, FALLS, STEEPER = 20.0, 0.5, 3.0


def opening_radius(window: float, cell: float) -> int:
    """Radius in cells of a window of about `window` meters, the middle cell counted."""
    return max(1, round((window / cell - 1) / 2))


def opening_radii(largest: int) -> list[int]:
    """Radii in cells: each is larger than the one before by a fifth, by 1 or 2 cells: or slopes would drop as objects do."""
    radii = [1]
    while (radius := radii[-1] + min(max(1, radii[-1] // 5), 2)) < largest:
        radii.append(radius)
    return sorted({*radii, largest})


def _steps(radius: int) -> tuple[int, int]:
    """How many squares and diamonds of radius 1 add up to an octagon: tan(22.5 degrees) of them are squares."""
    squares = int(0.41421356 * radius)
    return squares, radius - squares


def highest_around(raster: NDArray[Any], squares: int, diamonds: int) -> NDArray[Any]:
    """Maximum (h, w) over so many squares and diamonds round each cell.

    Each line of an octagon is a running maximum on the flat raster with a margin round it, by doubling: a maximum of 2m
    cells is that of two of m. Two diagonals and a cross of five cells make a diamond.
    """
    pad = squares + diamonds + 1
    h, w = raster.shape
    padded = np.full((h + 2 * pad, w + 2 * pad), raster.min(), raster.dtype)
    padded[pad : pad + h, pad : pad + w] = raster
    values, stride = padded.ravel(), w + 2 * pad
    spare, n = np.empty_like(values), values.size
    side = 2 * squares + 1
    for step, length in ((1, side), (stride, side), (stride + 1, diamonds), (stride - 1, diamonds)):
        done = 1
        while done < length:
            more = min(done, length - done)
            n -= more * step
            np.maximum(values[:n], values[more * step :][:n], out=spare[:n])
            values, spare = spare, values
            done += more
    start = pad * (stride + 1) - squares * (stride + 1) - max(diamonds - 1, 0) * stride
    size = (h - 1) * stride + w

    def shifted(by: int) -> NDArray[Any]:
        return values[start + by : start + by + size]

    out = shifted(0)
    if diamonds:
        out = np.maximum(out, shifted(1), out=spare[:size])
        for by in (-1, stride, -stride):
            np.maximum(out, shifted(by), out=out)
    rows = np.lib.stride_tricks.as_strided(out, (h, w), (stride * out.itemsize, out.itemsize))
    return np.ascontiguousarray(rows)


def wide_radius(window: int, cell: float) -> int:
    """The first radius, in cells, from `WIDE` on; 0 where the largest `window` is smaller."""
    return next((radius for radius in opening_radii(window) if radius * cell >= WIDE), 0)


def _steepness(
    heights: NDArray[np.float32], opened: NDArray[Any], measured: NDArray[np.bool_], radius: int
) -> NDArray[np.float32]:
    """How steep the land is round each cell (h, w), in meters per cell.

    That is how far it goes both up and down within `radius` cells of one of those as near: a hall goes only up or down.
    `opened` (h, w) are the ranks of its `heights`.
    """
    steps, last = _steps(min(radius, sum(opened.shape))), len(heights) - 1
    level = heights[opened[measured]]
    up = heights[highest_around(opened * measured, *steps)[measured]] - level
    down = level - heights[last - highest_around((last - opened) * measured, *steps)[measured]]
    steep = np.zeros(opened.shape, np.float32)
    steep[measured] = np.minimum(up, down) / np.float32(radius)
    return highest_around(steep, *steps)


@njit
def _lower(fall, land, drop, falls, again, after, below, found):
    """Find cells (n,) that an opening lowers by more than `drop` and than `falls` times what steep land falls, or once more
    by more than `again` and than walls on it; what is then `below` them.

    `fall` is by how much they fall to what is there `after`, and `land` how far steep land falls.
    """
    for k in range(len(fall)):
        if fall[k] > (max(again, STEEPER * land[k]) if found[k] else max(drop, falls * land[k])):
            below[k], found[k] = after[k], True


def objects_of(
    raster: NDArray[np.float32], cell: float, slope: float, window: int, keep: Collection[int] = ()
) -> tuple[
    NDArray[np.bool_], NDArray[np.float32], dict[int, NDArray[np.float32]], NDArray[np.float32]
]:
    """Cells that an opening lowers by more than `slope` times its radius, or than `LARGEST_DROP`.

    Wide windows also lower steep land that the rim of the cloud cuts off uphill, so there they must lower by more (see
    `WIDE`). What an opening leaves of an object may be a lower roof or treetop: wider ones take that, too, down a wall.
    `raster` is the minimum grid (h, w), float32, with holes; it and `cell`, a cell's side, are in meters. `window` is the
    largest radius and `keep` lists radii whose openings are wanted, in cells. Returned are the objects (h, w), what openings
    left there (elsewhere the cell's own height), the openings of `keep`, and how steep the land is (h, w), in meters per
    cell.
    """
    measured = raster != HOLE
    # Heights by their rank: that takes half the bytes, and order is all that openings look at.
    heights, rank = np.unique(raster[measured], return_inverse=True)
    heights = np.concatenate(([-HOLE], heights, [HOLE]))
    last = len(heights) - 1
    most = measured * np.min_scalar_type(last).type(last)
    upended = np.zeros_like(most)
    upended[measured] = last - 1 - rank
    openings, taken = {}, (0, 0)
    cells, before = np.flatnonzero(measured), raster[measured]
    below, found = before.copy(), np.zeros(len(cells), bool)
    # An opening lowers nothing by more than all heights differ.
    drops = {r: np.float32(min(slope * r * cell, LARGEST_DROP)) for r in opening_radii(window)}
    drops = {radius: drop for radius, drop in drops.items() if drop < heights[-2] - heights[1]}
    wide, again, steep = wide_radius(window, cell), np.inf, np.zeros(raster.shape, np.float32)
    if wide:
        steps, again = _steps(min(wide, sum(raster.shape))), LARGEST_DROP
        opened = highest_around(np.minimum(last - highest_around(upended, *steps), most), *steps)
        steep = _steepness(heights, opened, measured, wide)
    land = steep[measured]
    for radius in sorted({*drops, *keep}):
        squares, diamonds = _steps(min(radius, sum(raster.shape)))
        upended = highest_around(upended, squares - taken[0], diamonds - taken[1])
        taken = squares, diamonds
        opened = highest_around(np.minimum(last - upended, most), squares, diamonds)
        if radius in keep:
            openings[radius] = heights[opened]
        if radius in drops:
            after = heights[opened.ravel()[cells]]
            falls = FALLS if 0 < wide <= radius else 0.0
            fallen = np.float32(radius) * land
            _lower(before - after, fallen, drops[radius], falls, again, after, below, found)
            before = after
    objects, floor = np.zeros(raster.shape, bool), raster.copy()
    objects[measured], floor[measured] = found, below
    return objects, floor, openings, steep


def opening_names(windows: Sequence[float]) -> list[str]:
    """Dimensions of the windows: ``HeightAboveOpening_5``; a decimal point becomes ``_``."""
    return [f"HeightAboveOpening_{window:g}".replace(".", "_") for window in windows]


@njit
def above_opening(x, y, z, cell, left, bottom, opening, fallback, out):
    """z minus the opening, bilinear between the centers of measured cells; `fallback` where there is none."""
    h, w = opening.shape
    for p in range(len(x)):
        u, v = x[p] / cell - 0.5, y[p] / cell - 0.5
        i, j = int(np.floor(u)), int(np.floor(v))
        s, t = u - i, v - j
        level, total = 0.0, 0.0
        for b in range(2):
            for a in range(2):
                row, column = j + b - bottom, i + a - left
                if not (0 <= row < h and 0 <= column < w):
                    continue
                value = opening[row, column]
                weight = (s if a else 1.0 - s) * (t if b else 1.0 - t)
                if np.isfinite(value) and weight > 0.0:
                    level += weight * value
                    total += weight
        out[p] = z[p] - level / total if total > 0.0 else fallback[p]


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
#: At most so many cells for the root of the number of all lie at the rim: crowns have ground below them everywhere.
RIM = 14.0


def plateau_reach(cell: float) -> int:
    """How far away cells change what is a plateau, in cells."""
    return int(WIDEST / cell) + 1 + LINK + BEYOND


def sums_of_sets(number: NDArray[np.int64], size: NDArray[np.int64]) -> NDArray[np.int64]:
    """Sums of the rows and of the columns of the cells of each set, and how many they are (n, 3), from their `size` (n,)."""
    rows, columns = np.nonzero(number >= 0)
    sets = number[rows, columns]
    sums = [np.bincount(sets, at, len(size)) for at in (rows, columns)]
    return np.column_stack([*sums, size]).astype(np.int64)


@device
def direction(sums, j, i):
    """Which of 16 directions a cell lies in from the middle of a set, of which sums are given."""
    # Times the set's size: whole numbers, the same wherever the array begins.
    v, u = j * sums[2] - sums[0], i * sums[2] - sums[1]
    return int((np.arctan2(float(v), float(u)) / (2 * np.pi) + 1.0) * 16) % 16


@njit
def _look_around(
    number, asked, ground, raster, steep, cell, sums, sectors, around, level, uphill, rim
):
    """Of each set asked for: in which directions ground lies a jump lower, how often, how high, and how often level.

    And of the set's own ground, twice how often other ground lies a jump higher, less how often it lies a jump lower; and
    how many cells lie at the rim.
    """
    h, w = number.shape
    for j in range(h):
        for i in range(w):
            k = number[j, i]
            if k < 0 or not asked[k]:
                continue
            at_rim = False
            for y in range(max(j - BEYOND, 0), min(j + BEYOND + 1, h)):
                for x in range(max(i - BEYOND, 0), min(i + BEYOND + 1, w)):
                    if not ground[y, x] or number[y, x] == k:
                        continue
                    drop = raster[j, i] - raster[y, x]
                    far = np.sqrt(float((y - j) ** 2 + (x - i) ** 2))
                    jump = max(JUMP, WALL * cell * far)
                    if ground[j, i]:
                        uphill[k] += 2 * (drop < -jump) - (drop > jump)
                    if drop > max(jump, STEEPER * steep[j, i] * far):
                        around[k, 0] += 1
                        level[k] += raster[y, x]
                        at_rim |= far < 3.0
                        sectors[k, direction(sums[k], y, x)] = True
                    elif abs(drop) < STEP:
                        around[k, 1] += 1
            rim[k] += at_rim


def remove_plateaus(
    ground: np.ndarray, floor: np.ndarray, raster: np.ndarray, steep: np.ndarray, cell: float
) -> None:
    """Take plateaus from the `ground` (h, w) of a minimum grid; what lies around them becomes their `floor`.

    `raster` (h, w) holds the heights, in meters like `cell`, a cell's side; ground is measured everywhere. `steep` (h, w)
    is how steep the land is, in meters per cell.
    """
    number, size, side = linked_cells(
        raster, LINK, lambda away: np.maximum(STEP, GRADE * cell * away)
    )
    count, sums = len(size), sums_of_sets(number, size)
    grounds = np.bincount(number[ground], minlength=count)
    asked = (grounds > FOOTING * size) & (side < int(WIDEST / cell))
    sectors, around, level = (
        np.zeros((count, 16), bool),
        np.zeros((count, 2), np.int64),
        np.zeros(count),
    )
    uphill, rim = np.zeros((2, count), np.int64)
    _look_around(
        number, asked, ground, raster, steep, cell, sums, sectors, around, level, uphill, rim
    )
    lower = around[:, 0]
    plateau = (
        (sectors.sum(axis=1) >= DIRECTIONS) & (lower >= SHARE * around.sum(axis=1)) & (uphill <= 0)
    )
    plateau &= rim <= RIM * np.sqrt(size)
    level[plateau] /= lower[plateau]
    taken = ground & np.append(plateau, False)[number]
    ground[taken] = False
    floor[taken] = level[number[taken]]
