"""Bridge decks: surfaces one can walk on, with drops at both sides, that lead on to land at two opposite ends.

To both sides, at most `WIDEST` meters apart, the way (:mod:`.walkable`) ends at a drop, or at water. Such cells that hang
together are a deck if their rim is drops for the most part, and if at two ends, opposite each other, one walks on to land
whose own rim is no drop, as a roof's is, or the cloud ends at one of them. Of what is longer than `LONGEST`, such as a
viaduct, each block is judged by the rim around it, and land at one end is enough. The rule of Sithole and Vosselman [S06],
raised in a profile across and level with the ground in the profile along, is applied to the surface instead of to profiles.

Limits: a deck that the cloud cuts at both ends is none, nor is one hardly wider than 3 m of few points; a road raised
between upright walls is taken for one, as are parts of roofs as high as a deck that touch it, or that crowns link to it.

The grid is anchored to absolute coordinates, all reaches are bounded (:data:`REACH`) and counts are whole numbers: the order
of points does not matter, and a tile with its surroundings finds the decks of the whole cloud.

[S06] Sithole, Vosselman (2006): Bridge detection in airborne laser scanner data. ISPRS Journal of Photogrammetry and
Remote Sensing 61(1), 33-46.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..base.jit import device, njit
from .cells import cell_numbers, keys_of, levels, patches, places_among
from .deckrims import REACH as RIMS_REACH
from .deckrims import deck_levels
from .linked import sums_around
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
_SIDE = 2 * BESIDE + 1
_SQUARE = _SIDE * _SIDE
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
    column, row = (cell_numbers(axis[use], CELL) for axis in (x, y))
    return decks_of_levels(x, y, z, use, levels_near_decks(column, row, z[use]))


def level_points(
    x: NDArray[np.float64], y: NDArray[np.float64], z: NDArray[np.float64], use: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """Numbers of the points that are all :func:`find_decks` needs of places far away, ascending."""
    mine = np.flatnonzero(use)
    order, begins = levels(z[mine], np.unique(_keys(x[mine], y[mine]), return_inverse=True)[1])
    return np.sort(mine[order[begins]])


def _keys(x, y):
    return keys_of(cell_numbers(x, CELL), cell_numbers(y, CELL))


def levels_near_decks(
    column: NDArray[np.int64], row: NDArray[np.int64], z: NDArray[np.float64]
) -> NDArray[np.float64]:
    """All that :func:`decks_of_levels` needs, of the points :func:`level_points` at least and the cells they fall in.

    Levels in cells up to twice BESIDE from a deck (n, 5): column, row, height, whether it is a deck's, its kind.
    """
    rows = [np.empty((0, 5))]
    if len(z):
        for points, own in patches(column, row, int(REACH), FAR + AHEAD):
            c, r = column[points], row[points]
            left, bottom = int(c.min()), int(r.min())
            h, w = int(r.max()) + 1 - bottom, int(c.max()) + 1 - left
            cell = (r - bottom) * w + c - left
            order, begins = levels(z[points], cell)
            lowest = order[begins]
            heights, cell = z[points][lowest], cell[lowest]
            kind, deck = deck_levels(heights, np.searchsorted(cell, np.arange(h * w + 1)), h, w, left, bottom)
            there = np.bincount(cell[deck], minlength=h * w).reshape(h, w) > 0
            near = (sums_around(there, 2 * BESIDE) > 0).ravel()[cell]
            mine = np.zeros(len(c), bool)
            mine[own] = True
            near &= mine[lowest]
            lowest = lowest[near]
            rows.append(np.column_stack([c[lowest], r[lowest], heights[near], deck[near], kind[near]]))
    return np.concatenate(rows)


def decks_of_levels(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    z: NDArray[np.float64],
    use: NDArray[np.bool_],
    table: NDArray[np.float64],
) -> NDArray[np.uint8]:
    """What :func:`find_decks` says of points, from the levels that :func:`levels_near_decks` found before."""
    out = np.zeros(len(x), np.uint8)
    if not len(table):
        return out
    keys = keys_of(*table[:, :2].astype(np.int64).T)
    order = np.lexsort((table[:, 2], keys))
    heights, deck, kind = table[order, 2], table[order, 3] > 0, table[order, 4].astype(np.int8)
    cells, start = np.unique(keys[order], return_index=True)
    # Every cell near a deck that holds a point has levels.
    cell, there = places_among(cells, _keys(x, y))
    near = np.flatnonzero(use & there)
    steps = np.arange(-BESIDE, BESIDE + 1)
    around, held = places_among(cells, cells[:, None] + ((steps << 32)[:, None] + steps).ravel())
    found = np.zeros(len(near), np.uint8)
    _mark(
        z[near],
        cell[near],
        np.where(held, around, -1),
        heights,
        np.append(start, len(keys)),
        kind,
        deck,
        found,
    )
    out[near] = found
    return out


@njit
def _mark(z, cell, around, heights, start, kind, deck, out):
    """Say of points whether they are on a deck, or of its parts: in cells next to those that were found, and BESIDE cells
    away among them, as around cars. `around` (cells, 25) numbers the cells round each, -1 where there is none.
    """
    for p in range(len(z)):
        count = across = along = 0
        nearest = (BESIDE + 1) ** 2 * 2
        level = 0.0
        for k in range(_SQUARE):
            b, a = k // _SIDE - BESIDE, k % _SIDE - BESIDE
            c = around[cell[p], k]
            if c < 0:
                continue
            for m in range(start[c], start[c + 1]):
                if deck[m] and -FLANK - 1.0 <= z[p] - heights[m] <= PARAPET + 1.0:
                    count += 1
                    across += a
                    along += b
                    squared = a * a + b * b
                    if squared < nearest or (squared == nearest and heights[m] > level):
                        nearest, level = squared, heights[m]
        if count == 0 or not -FLANK <= z[p] - level <= PARAPET:
            continue
        if nearest > NEXT and across * across + along * along > (AMONG * count) ** 2:
            continue
        if not _on_land(z[p], around[cell[p]], heights, start, kind, deck, nearest, level):
            out[p] = SURFACE if abs(z[p] - level) <= (ON_RIM if nearest else ON_DECK) else PARTS


@device
def _on_land(z, around, heights, start, kind, deck, nearest, level):
    """Whether ground that one walks on to, or the bank below, is as near to a point as its deck is."""
    below = z < level - ON_DECK
    for k in range(_SQUARE):
        b, a = k // _SIDE - BESIDE, k % _SIDE - BESIDE
        c = around[k]
        if c < 0 or a * a + b * b > max(nearest, 2 if below else 0):
            continue
        for m in range(start[c], start[c + 1]):
            if deck[m] or kind[m] == ROUGH:
                continue
            if below:
                if abs(heights[m] - z) <= STEP + BANK * distance(a, b):
                    return True
            elif kind[m] == SOLID and abs(heights[m] - level) <= 2 * ON_DECK:
                return True
    return False
