"""Bridge decks: surfaces one can walk on, with drops at both sides, that lead on to land at two opposite ends.

To both sides, at most `WIDEST` meters apart, the way (:mod:`.walkable`) ends at a drop, or at water. Such cells that hang
together are a deck if both their sides are drops for the most part, and if at two ends, opposite each other, all their width
leads on to land, or the cloud ends at one of them. On land the way goes on ahead and to both sides of that; on the next
roof it ends at a drop. Of what is longer than `LONGEST`, such as a viaduct, each block is judged by the rim around it, and
land at one end is enough. Near walls (:mod:`.deckwalls`) is none.
The rule of Sithole and Vosselman [S06],
raised in a profile across and level with the ground in the profile along, is applied to the surface instead of to profiles.

Limits: a deck that the cloud cuts at both ends is none, nor is one hardly wider than 3 m of few points; parts of roofs as
high as a deck that touch it, or that crowns link to it, may be taken for one, and roofs that the cloud cuts.

The grid is anchored to absolute coordinates, all reaches are bounded (:data:`REACH`) and counts are whole numbers: the order
of points does not matter, and a tile with its surroundings finds the decks of the whole cloud.

[S06] Sithole, Vosselman (2006): Bridge detection in airborne laser scanner data. ISPRS Journal of Photogrammetry and
Remote Sensing 61(1), 33-46.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from ..base.jit import device, njit
from .cells import (
    CellWindow,
    cell_numbers,
    keys_of,
    levels,
    longest_sides,
    number_sets,
    patches,
    places_among,
    sums_around,
)
from .deckwalls import REACH as WALLS_REACH
from .deckwalls import without_walls
from .openings import highest_around
from .walkable import (
    ACROSS,
    AHEAD,
    DIAGONAL,
    DOWN,
    FAR,
    NOTHING,
    RIGHT,
    ROUGH,
    SOLID,
    STEP,
    STRAIGHT,
    UP,
    WALLED,
    distance,
    surfaces,
    walkable,
    ways,
)

#: In cells of a meter: the widest deck, the longest that is judged as a whole, and the smallest.
WIDEST, LONGEST, SMALLEST = 60, 250, 20
#: How often what is walked on between deck cells becomes deck as well.
_FILLS = 2
#: Cells across which one walks on from a deck to land, and across which parts of a deck belong together.
LINK = 2
#: For each way that ends at a drop, at most so many end at something else.
WALLS = 0.7
#: For each meter of a deck's width, so many cells lead on to land at an end, or half as many ways end at the cloud's rim.
END = 1.5
#: At its sides, so much more aside than along, more cells are at a drop than lead on.
SIDE = 1.5
#: Blocks in which long decks are judged, cells, and how many blocks away land must be seen.
BLOCK, FAR_ENDS = 64, 3
#: How far away cells matter: blocks of a deck, its rim and the land at its ends, how far one walks and sees from there.
RIMS_REACH = (
    BLOCK * (FAR_ENDS + 1) + LINK + 2 * WIDEST + AHEAD + FAR + 8 + 2 * _FILLS + LINK + WALLS_REACH
)
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


def deck_levels(z, start, h, w, left, bottom):
    """The kind of each level (n,) of a raster, whose first column and row have numbers, and whether it is of a deck."""
    kind = surfaces(z, start, h, w)
    way, last, end = ways(z, start, h, w, kind, WIDEST * STRAIGHT)
    steps = np.array([STRAIGHT, DIAGONAL, STRAIGHT, DIAGONAL])
    narrow = way[:, :4].astype(np.int32) + way[:, 4:] + steps <= WIDEST * STRAIGHT
    nothing = last == NOTHING
    deck, above = (narrow & ~nothing[:, :4] & ~nothing[:, 4:]).any(axis=1), narrow.any(axis=1)
    goes_on = ~np.isin(last, (DOWN, ACROSS))
    del way, last, narrow, nothing  # the most that is held
    for _ in range(_FILLS):
        deck = _filled(z, start, h, w, kind, deck)
    found = np.zeros(len(z), bool)
    # Where a river without returns is wider than one sees, decks lead on over nothing.
    for some, over_nothing in ((deck, False), (deck | above, True)):
        if some.any() and (not over_nothing or (above & ~deck).any()):
            found |= _judged(z, start, h, w, left, bottom, kind, goes_on, end, some, over_nothing)
    return kind, without_walls(z, start, h, w, kind, end, found)


def _judged(
    z, start, h, w, left, bottom, kind, goes_on, end, deck, over_nothing
) -> NDArray[np.bool_]:
    """Which levels (n,) of what may be decks are some, by what is at the rims of their parts."""
    level, number = np.flatnonzero(deck), np.cumsum(deck) - 1
    row, column = np.divmod(np.repeat(np.arange(h * w), np.diff(start)), w)
    one, other = _beside(z, start, h, w, kind, deck)
    both, part = deck[other], np.empty(len(level), np.int64)
    number_sets(number[one[both]], number[other[both]], part)
    # Where one walks on to what is no deck, and to land: from there, ahead and to both sides of that.
    one, other = one[~both], other[~both]
    turn = np.rint(
        np.arctan2(row[other] - row[one], column[other] - column[one]) / (np.pi / 4)
    ).astype(int)
    land = goes_on[other[:, None], (turn[:, None] + (-1, 0, 1)) % 8].all(axis=1)
    on, to_land = (np.bincount(some, minlength=len(z))[level] > 0 for some in (one, one[land]))
    row, column, end = row[level], column[level], end[level]
    drop = (end == DOWN) | (end == ACROSS)
    walled, cut = (end == WALLED).sum(axis=1), (end == NOTHING).sum(axis=1)
    if over_nothing:
        drop, cut = drop | (end == NOTHING), 0 * cut
    down, rim = drop.sum(axis=1), drop.any(axis=1)
    size = np.bincount(part)
    length = 1 + longest_sides(part, (row, column), len(size))

    def sums(values):
        return np.bincount(part, values, len(size))

    good = (size >= SMALLEST) & (length <= LONGEST) & (length > (FAR if over_nothing else 0))
    good &= sums(walled) <= WALLS * sums(down)
    # The way along it is across its drops; from its middle, times the size: whole numbers, wherever the array begins.
    xx, xy, yy = (sums((drop * by).sum(axis=1)) for by in (RIGHT * RIGHT, RIGHT * UP, UP * UP))
    turn = 0.5 * np.arctan2(2 * xy, xx - yy) + np.pi / 2
    north, east = (at * size[part] - sums(at)[part] for at in (row, column))
    cos, sin = np.cos(turn)[part], np.sin(turn)[part]
    along, aside = east * cos + north * sin, north * cos - east * sin
    half = np.zeros(len(size))
    np.maximum.at(half, part, np.abs(along))
    first, second = along < -0.5 * half[part], along > 0.5 * half[part]
    whole = END * size**2 / (2 * half + size)
    lands = [sums(to_land & side) >= whole for side in (first, second)]
    ends = [
        at_land | (2 * sums(cut * side) >= whole)
        for at_land, side in zip(lands, (first, second), strict=True)
    ]
    good &= ends[0] & ends[1] & (lands[0] | lands[1])
    for flank in (aside > SIDE * np.abs(along), -aside > SIDE * np.abs(along)):
        good &= sums(rim & flank) >= sums(on & flank)
    out = np.zeros(len(deck), bool)
    out[level] = good[part]
    long = length[part] > LONGEST
    if long.any():
        out[level[long]] = _stretches(
            row[long] + bottom,
            column[long] + left,
            *(v[long] for v in (down, walled, rim, on, to_land)),
        )
    return out


def _stretches(row, column, down, walled, rim, on, to_land) -> NDArray[np.bool_]:
    """Levels (k,) of long parts whose rim, in the 3 x 3 blocks around, is drops, and that end at land near."""
    b, a = (at // BLOCK - at.min() // BLOCK for at in (row, column))
    shape = int(b.max()) + 1, int(a.max()) + 1
    sums = np.zeros((5, *shape), np.int64)
    for of, values in zip(sums, (down, walled, rim, on, to_land), strict=True):
        np.add.at(of, (b, a), values)
    downs, walls, drops, leads = (sums_around(of, 1) for of in sums[:4])
    good = (downs > 0) & (walls <= WALLS * downs) & (leads <= drops)
    # Near land, or where it goes on to both sides as far as one looks: no roof is that long.
    good &= (sums_around(sums[4], FAR_ENDS) > 0) | _goes_on(sums[2] > 0) | _goes_on(sums[2].T > 0).T
    return good[b, a]


def _goes_on(rim: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Blocks with some of the rim FAR_ENDS rows up, and some as many rows down, no more columns to a side."""
    beside = np.any(sliding_window_view(np.pad(rim, FAR_ENDS), 2 * FAR_ENDS + 1, axis=1), axis=-1)
    return beside[: len(rim)] & beside[2 * FAR_ENDS :]


def _filled(z, start, h, w, kind, deck) -> NDArray[np.bool_]:
    """The decks, and what is walked on and has more of them than of other ground around."""
    cell = np.repeat(np.arange(h * w), np.diff(start))
    near = highest_around(
        np.bincount(cell[deck], minlength=h * w).reshape(h, w) > 0, LINK, 0
    ).ravel()
    one, other = _beside(z, start, h, w, kind, near[cell] & ~deck)
    return deck | (np.bincount(one, np.where(deck[other], 1, -1), len(z)) > 0)


@njit
def _beside(z, start, h, w, kind, some):
    """Pairs (k,), (k,) of levels up to LINK cells apart between which one can walk; the first of each is one of `some`."""
    one, other, count = np.empty(1024, np.int32), np.empty(1024, np.int32), 0
    for j in range(h):
        for i in range(w):
            for n in range(start[j * w + i], start[j * w + i + 1]):
                if not some[n] or kind[n] != SOLID:
                    continue
                for b in range(max(j - LINK, 0), min(j + LINK + 1, h)):
                    for a in range(max(i - LINK, 0), min(i + LINK + 1, w)):
                        for m in range(start[b * w + a], start[b * w + a + 1]):
                            if (
                                m == n
                                or kind[m] != SOLID
                                or not walkable(z[m] - z[n], distance(a - i, b - j))
                            ):
                                continue
                            if count == len(one):
                                one, other = (
                                    np.concatenate((one, one)),
                                    np.concatenate((other, other)),
                                )
                            one[count], other[count] = n, m
                            count += 1
    return one[:count], other[:count]


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
            window = CellWindow.round(c, r)
            left, bottom, w, h = window
            cell = window.numbers(c, r)
            order, begins = levels(z[points], cell)
            lowest = order[begins]
            heights, cell = z[points][lowest], cell[lowest]
            kind, deck = deck_levels(
                heights, np.searchsorted(cell, np.arange(h * w + 1)), h, w, left, bottom
            )
            there = np.bincount(cell[deck], minlength=h * w).reshape(h, w) > 0
            near = highest_around(there, 2 * BESIDE, 0).ravel()[cell]
            mine = np.zeros(len(c), bool)
            mine[own] = True
            near &= mine[lowest]
            lowest = lowest[near]
            rows.append(
                np.column_stack([c[lowest], r[lowest], heights[near], deck[near], kind[near]])
            )
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
    start = np.append(start, len(keys))
    out[near] = _mark(z[near], cell[near], np.where(held, around, -1), heights, start, kind, deck)
    return out


@njit
def _mark(z, cell, around, heights, start, kind, deck):
    """Whether points (n,) are on a deck, or of its parts: in cells next to those that were found, and BESIDE cells
    away among them, as around cars. `around` (cells, 25) numbers the cells round each, -1 where there is none.
    """
    out = np.zeros(len(z), np.uint8)
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
    return out


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
