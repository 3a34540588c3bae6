"""Bridge decks: surfaces one can walk on, with drops at both sides, that lead on to land at two opposite ends.

To both sides, at most `WIDEST` meters apart, the way (:mod:`.walkable`) ends at a drop, or at water. Such cells that hang
together are a deck if their rim is drops for the most part, and if at two ends, opposite each other, one walks on to land
whose own rim is no drop, as a roof's is, or the cloud ends at one of them. Of what is longer than `LONGEST`, such as a
viaduct, each block is judged by the rim around it, and land at one end is enough. The rule of Sithole and Vosselman [S06],
raised in a profile across and level with the ground in the profile along, is applied to the surface instead of to profiles.

Limits: a deck that the cloud cuts at both ends is none, nor is one hardly wider than 3 m of few points; of roofs as high as
a deck that touch it, or that crowns link to it, a part may be taken for it.

The grid is anchored to absolute coordinates, all reaches are bounded (:data:`REACH`) and counts are whole numbers: the order
of points does not matter, and a tile with its surroundings finds the decks of the whole cloud.

[S06] Sithole, Vosselman (2006): Bridge detection in airborne laser scanner data. ISPRS Journal of Photogrammetry and
Remote Sensing 61(1), 33-46.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..base.jit import device, njit
from .cells import cell_numbers
from .deckrims import REACH as RIMS_REACH
from .deckrims import deck_levels
from .levels import levels
from .linked import sums_around
from .patches import patches
from .walkable import AHEAD, FAR, ROUGH, SOLID, STEP, distance

#: Side of the cells, meters: what is said of cells below is said of meters.
CELL = 1.0
#: How far from the deck's surface its points lie, meters: on it, and in cells beside it, where leaves are; parapets and cars
#: above; its flank below.
ON_DECK, ON_RIM, PARAPET, FLANK = 0.4, 0.25, 1.6, 2.0
#: Rise over run of banks, whose points are no flank of the deck above.
BANK = 0.7
#: Cells beyond those that were found, to the deck's edge and under its cars; more than `NEXT` squared cells away only among
#: cells of a deck, whose mean is at most so many cells away.
BESIDE, NEXT, AMONG = 2, 2, 1.5
#: How far away points matter, in meters.
REACH = (RIMS_REACH + 2 * BESIDE) * CELL
#: What points are: of a deck's surface, of its parapets and flanks, or of none.
SURFACE, PARTS = 1, 2


def find_decks(
    x: NDArray[np.float64], y: NDArray[np.float64], z: NDArray[np.float64], use: NDArray[np.bool_]
) -> NDArray[np.uint8]:
    """What each point is: 1 of a bridge deck's surface, 2 of what rises from it or of its flank, 0 neither.

    Coordinates in meters, finite; only points to `use` make decks, and are of them. Works from about 2 points/m2 on.
    """
    return decks_of_levels(x, y, z, use, levels_near_decks(x, y, z, use)[0])


def level_points(
    x: NDArray[np.float64], y: NDArray[np.float64], z: NDArray[np.float64], use: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """Numbers of the points that are all :func:`find_decks` needs of places far away, ascending."""
    column, row = cell_numbers(x, CELL), cell_numbers(y, CELL)
    found = [np.empty(0, np.int64)]
    if use.any():
        for points, own in patches(column, row, 0, AHEAD):
            at = np.arange(len(x))[points][own]
            raster = _raster(column[at], row[at])
            found.append(at[levels(z[at], use[at], column[at], row[at], *raster)[1]])
    return np.sort(np.concatenate(found))


def _raster(column, row):
    left, bottom = int(column.min()), int(row.min())
    return left, bottom, int(row.max()) + 1 - bottom, int(column.max()) + 1 - left


def levels_near_decks(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    z: NDArray[np.float64],
    use: NDArray[np.bool_],
    largest: int | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """All that :func:`decks_of_levels` needs, of the points :func:`level_points` at least, and what these are numbers of.

    Levels in cells up to twice BESIDE from a deck (n, 5): column, row, height, whether it is a deck's, its kind; and the
    numbers of the points that are their lowest. No raster has more than `largest` cells, see :func:`.patches.patches`.
    """
    rows, numbers = [np.empty((0, 5))], [np.empty(0, np.int64)]
    if len(x):
        column, row = cell_numbers(x, CELL), cell_numbers(y, CELL)
        for points, own in patches(column, row, int(REACH), FAR + AHEAD, largest):
            at = np.arange(len(x))[points]
            left, bottom, h, w = _raster(column[at], row[at])
            heights, lowest, start = levels(z[at], use[at], column[at], row[at], left, bottom, h, w)
            kind, deck = deck_levels(heights, start, h, w, left, bottom)
            cell = np.repeat(np.arange(h * w), np.diff(start))
            there = np.bincount(cell[deck], minlength=h * w).reshape(h, w) > 0
            near = (sums_around(there, 2 * BESIDE) > 0).ravel()[cell]
            mine = np.zeros(len(at), bool)
            mine[own] = True
            near &= mine[lowest]
            point = at[lowest[near]]
            rows.append(np.column_stack([column[point], row[point], heights[near], deck[near], kind[near]]))
            numbers.append(point)
    return np.concatenate(rows), np.concatenate(numbers)


def decks_of_levels(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    z: NDArray[np.float64],
    use: NDArray[np.bool_],
    table: NDArray[np.float64],
) -> NDArray[np.uint8]:
    """What :func:`find_decks` says of points, from the levels that :func:`levels_near_decks` found before."""
    out = np.zeros(len(x), np.uint8)
    if not len(table) or not len(x):
        return out
    column, row = cell_numbers(x, CELL), cell_numbers(y, CELL)
    columns, rows = table[:, 0].astype(np.int64), table[:, 1].astype(np.int64)
    for part, _own in patches(columns, rows, 0, 2 * BESIDE + 1, 1 << 62):
        mine = np.arange(len(table))[part]
        mine = mine[np.lexsort((table[mine, 2], columns[mine], rows[mine]))]
        left, bottom, h, w = _raster(columns[mine], rows[mine])
        left, bottom, h, w = left - BESIDE, bottom - BESIDE, h + 2 * BESIDE, w + 2 * BESIDE
        near = np.flatnonzero((column >= left) & (column < left + w) & (row >= bottom) & (row < bottom + h))
        place = (rows[mine] - bottom) * w + columns[mine] - left
        start = np.searchsorted(place, np.arange(h * w + 1))
        found = np.zeros(len(near), np.uint8)
        kind = table[mine, 4].astype(np.int8)
        _mark(
            z[near], use[near], column[near], row[near], left, bottom, h, w,
            np.ascontiguousarray(table[mine, 2]), start, kind, table[mine, 3] != 0, found,
        )  # fmt: skip
        out[near] = np.where(found != 0, found, out[near])
    return out


@njit
def _mark(z, use, column, row, left, bottom, h, w, heights, start, kind, deck, out):
    """Say of points whether they are on a deck, or of its parts: in cells next to those that were found, and BESIDE cells
    away among them, as around cars.
    """
    for p in range(len(z)):
        if not use[p]:
            continue
        j, i = row[p] - bottom, column[p] - left
        count = across = along = 0
        nearest = (BESIDE + 1) ** 2 * 2
        level = 0.0
        for b in range(max(j - BESIDE, 0), min(j + BESIDE + 1, h)):
            for a in range(max(i - BESIDE, 0), min(i + BESIDE + 1, w)):
                squared = (a - i) ** 2 + (b - j) ** 2
                for m in range(start[b * w + a], start[b * w + a + 1]):
                    if deck[m] and -FLANK - 1.0 <= z[p] - heights[m] <= PARAPET + 1.0:
                        count += 1
                        across += a - i
                        along += b - j
                        if squared < nearest or (squared == nearest and heights[m] > level):
                            nearest, level = squared, heights[m]
        if count == 0 or not -FLANK <= z[p] - level <= PARAPET:
            continue
        if nearest > NEXT and across * across + along * along > (AMONG * count) ** 2:
            continue
        if not _on_land(z[p], j, i, h, w, heights, start, kind, deck, nearest, level):
            out[p] = SURFACE if abs(z[p] - level) <= (ON_RIM if nearest else ON_DECK) else PARTS


@device
def _on_land(z, j, i, h, w, heights, start, kind, deck, nearest, level):
    """Whether ground that one walks on to, or the bank below, is as near to a point as its deck is."""
    below = z < level - ON_DECK
    for b in range(max(j - BESIDE, 0), min(j + BESIDE + 1, h)):
        for a in range(max(i - BESIDE, 0), min(i + BESIDE + 1, w)):
            squared = (a - i) ** 2 + (b - j) ** 2
            if squared > max(nearest, 2 if below else 0):
                continue
            for m in range(start[b * w + a], start[b * w + a + 1]):
                if deck[m] or kind[m] == ROUGH:
                    continue
                if below:
                    if abs(heights[m] - z) <= STEP + BANK * distance(a - i, b - j):
                        return True
                elif kind[m] == SOLID and abs(heights[m] - level) <= 2 * ON_DECK:
                    return True
    return False
