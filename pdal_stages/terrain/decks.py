"""Bridge decks: smooth surfaces that leave the ground at two ends and lie high above what is on both sides.

A deck is found as a whole, by the way one can walk (:mod:`.walkable`): to both sides, at most `WIDEST` meters apart, the
way ends at a drop, or at water. Such cells that hang together are a deck if their rim is drops for the most part, and if at
two ends, opposite each other, one walks on to land whose own rim is no drop, as a roof's is. Of what is longer than
`LONGEST`, such as a viaduct, each stretch is judged by its rim alone. The rule of Sithole and Vosselman [S06], raised in a
profile across and level with the ground in the profile along, is applied to the surface instead of to profiles.

The grid is anchored to absolute coordinates, all reaches are bounded (:data:`REACH`) and counts are whole numbers: the order
of points does not matter, and a tile with its surroundings finds the decks of the whole cloud.

[S06] Sithole, Vosselman (2006): Bridge detection in airborne laser scanner data. ISPRS Journal of Photogrammetry and
Remote Sensing 61(1), 33-46.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..base.jit import device, njit
from ..base.unionfind import root as root_of
from .levels import levels
from .minima import cell_numbers
from .patches import patches
from .walkable import (
    ACROSS,
    AHEAD,
    DIAGONAL,
    DOWN,
    FAR,
    NOTHING,
    SOLID,
    STRAIGHT,
    WALLED,
    distance,
    surfaces,
    walkable,
    ways,
)

#: Side of the cells, meters: what is said of cells below is said of meters.
CELL = 1.0
#: The widest deck, and the longest that is judged as a whole.
WIDEST, LONGEST = 60, 200
#: Cells across which one walks on from a deck, and across which its parts belong together.
LINK, JOIN = 2, 4
#: How often what is walked on between deck cells becomes deck as well.
_FILLS = 2
#: The smallest deck and the smallest land at its ends, in cells, and how far land is looked for.
SMALLEST, LAND, AWAY = 20, 100, 40
#: For each cell of a deck's rim at a drop, at most so many that lead on; for each way that ends at a drop, so many that end
#: at something else, and so many at nothing.
OUTWARD, WALLS, RIM = 1.75, 0.7, 0.3
#: The most of the ways over land that end at a drop, at any drop, at nothing.
_LAND_DROPS = (0.15, 0.35, 0.3)
#: A deck that the rim of the cloud cuts is so large and has for each cell that leads on so many at a drop.
CUT, CUT_RIM = 60, 3
#: Directions from a deck's middle; an end has the sectors so near.
SECTORS, NEAR = 16, 2
#: Blocks in which long decks are judged, cells.
BLOCK = 64
#: How far from the deck's surface its points lie, meters: on it; parapets and cars above; its flank below.
ON_DECK, PARAPET, FLANK = 0.4, 1.6, 2.0
#: Cells beyond those that were found, to the deck's edge and under its cars.
BESIDE = 2
#: How far away points matter, in meters: cells of a deck, its rim, and land at its ends, which all look around.
REACH = (LONGEST + LINK + AWAY + AHEAD + FAR + 4 + WIDEST + 2 * _FILLS) * CELL
#: What points are: of a deck's surface, of its parapets and flanks, or of none.
SURFACE, PARTS = 1, 2


def find_decks(
    x: NDArray[np.float64], y: NDArray[np.float64], z: NDArray[np.float64], use: NDArray[np.bool_]
) -> NDArray[np.uint8]:
    """What each point is: 1 of a bridge deck's surface, 2 of what rises from it or of its flank, 0 neither.

    Coordinates in meters, finite; only points to `use` make decks, and are of them. Works from about 2 points/m2 on.
    """
    out = np.zeros(len(x), np.uint8)
    if not len(x):
        return out
    column, row = cell_numbers(x, CELL), cell_numbers(y, CELL)
    for points, own in patches(column, row, int(REACH), FAR + AHEAD):
        found = _find(z[points], use[points], column[points], row[points])
        out[points if isinstance(points, slice) else points[own]] = found[own]
    return out


def level_points(
    x: NDArray[np.float64], y: NDArray[np.float64], z: NDArray[np.float64], use: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """Numbers of the points that are all :func:`find_decks` needs of places far away, ascending."""
    column, row = cell_numbers(x, CELL), cell_numbers(y, CELL)
    found = [np.empty(0, np.int64)]
    if use.any():
        for points, own in patches(column, row, 0, AHEAD):
            at = np.arange(len(x))[points][own]
            left, bottom, h, w = _raster(column[at], row[at])
            found.append(at[levels(z[at], use[at], column[at], row[at], left, bottom, h, w)[1]])
    return np.sort(np.concatenate(found))


def _raster(column, row):
    left, bottom = int(column.min()), int(row.min())
    return left, bottom, int(row.max()) + 1 - bottom, int(column.max()) + 1 - left


def levels_near_decks(
    x: NDArray[np.float64], y: NDArray[np.float64], z: NDArray[np.float64], use: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """All that :func:`decks_of_levels` needs, of the points :func:`level_points` at least, and what these are numbers of.

    Levels in cells up to BESIDE from a deck (n, 5): column, row, height, whether it is a deck's, whether it is solid; and
    the numbers of the points that are their lowest.
    """
    rows, numbers = [np.empty((0, 5))], [np.empty(0, np.int64)]
    if len(x):
        column, row = cell_numbers(x, CELL), cell_numbers(y, CELL)
        for points, own in patches(column, row, int(REACH), FAR + AHEAD):
            at = np.arange(len(x))[points]
            mine = np.ones(len(at), bool)[own] if isinstance(own, slice) else own
            found = _deck_levels(z[at], use[at], column[at], row[at])
            if found is None:
                continue
            *_, heights, lowest, start, kind, deck = found
            near = near_decks(start, *found[2:4], deck) & mine[lowest]
            point = at[lowest[near]]
            rows.append(
                np.column_stack([column[point], row[point], heights[near], deck[near], kind[near] == SOLID])
            )
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
    for part, _own in patches(columns, rows, 0, 2 * BESIDE + 1):
        mine = np.arange(len(table))[part]
        mine = mine[np.lexsort((table[mine, 2], columns[mine], rows[mine]))]
        left, bottom, h, w = _raster(columns[mine], rows[mine])
        left, bottom, h, w = left - BESIDE, bottom - BESIDE, h + 2 * BESIDE, w + 2 * BESIDE
        near = np.flatnonzero((column >= left) & (column < left + w) & (row >= bottom) & (row < bottom + h))
        place = (rows[mine] - bottom) * w + columns[mine] - left
        start = np.searchsorted(place, np.arange(h * w + 1))
        found = np.zeros(len(near), np.uint8)
        kind = np.where(table[mine, 4] != 0, SOLID, SOLID + 1).astype(np.int8)
        _mark(
            z[near], use[near], column[near], row[near], left, bottom, h, w,
            np.ascontiguousarray(table[mine, 2]), start, kind, table[mine, 3] != 0, found,
        )  # fmt: skip
        out[near] = np.where(found != 0, found, out[near])
    return out


@njit
def near_decks(start, h, w, deck):
    """Levels (n,) in cells up to BESIDE from one with a deck."""
    out = np.zeros(len(deck), np.bool_)
    for j in range(h):
        for i in range(w):
            for n in range(start[j * w + i], start[j * w + i + 1]):
                if deck[n]:
                    for b in range(max(j - BESIDE, 0), min(j + BESIDE + 1, h)):
                        for a in range(max(i - BESIDE, 0), min(i + BESIDE + 1, w)):
                            out[start[b * w + a] : start[b * w + a + 1]] = True
    return out


def _deck_levels(z, use, column, row):
    """The raster round points, its levels, and which of them are of decks; None where none is."""
    left, bottom, h, w = _raster(column, row)
    heights, lowest, start = levels(z, use, column, row, left, bottom, h, w)
    kind = surfaces(heights, start, h, w)
    way, end = ways(heights, start, h, w, kind, int(WIDEST / CELL) * STRAIGHT)
    deck = between_drops(way, int(WIDEST / CELL) * STRAIGHT)
    if not deck.any():
        return None
    for _ in range(_FILLS):
        deck = filled(heights, start, h, w, kind, deck)
    number, sums, box = parts(heights, start, h, w, deck)
    judged(heights, start, h, w, kind, end, number, sums, box, left, bottom, deck)
    return (left, bottom, h, w, heights, lowest, start, kind, deck) if deck.any() else None


def _find(z, use, column, row) -> NDArray[np.uint8]:
    out = np.zeros(len(z), np.uint8)
    found = _deck_levels(z, use, column, row)
    if found is not None:
        left, bottom, h, w, heights, _, start, kind, deck = found
        _mark(z, use, column, row, left, bottom, h, w, heights, start, kind, deck, out)
    return out


@njit
def between_drops(way, most):
    """Levels (n,) with drops on opposite sides, no farther apart than `most` tenths of cells."""
    found = np.zeros(len(way), np.bool_)
    for n in range(len(way)):
        for d in range(4):
            if way[n, d] + way[n, d + 4] + (STRAIGHT if d % 2 == 0 else DIAGONAL) <= most:
                found[n] = True
    return found


@njit
def filled(z, start, h, w, kind, deck):
    """The same, and what is walked on and has more of it than of other ground around."""
    out = deck.copy()
    for j in range(h):
        for i in range(w):
            for n in range(start[j * w + i], start[j * w + i + 1]):
                if kind[n] != SOLID or deck[n]:
                    continue
                more = 0
                for b in range(max(j - 2, 0), min(j + 3, h)):
                    for a in range(max(i - 2, 0), min(i + 3, w)):
                        for m in range(start[b * w + a], start[b * w + a + 1]):
                            if m != n and kind[m] == SOLID and walkable(z[m] - z[n], distance(a - i, b - j)):
                                more += 1 if deck[m] else -1
                out[n] = more > 0
    return out


@njit
def parts(z, start, h, w, deck):
    """Number the parts that hang together (n,), -1 elsewhere; their size and sums of rows and columns; their boxes."""
    parent = np.arange(len(z))
    for j in range(h):
        for i in range(w):
            for n in range(start[j * w + i], start[j * w + i + 1]):
                if not deck[n]:
                    continue
                for b in range(JOIN + 1):
                    for a in range(-JOIN if b else 1, JOIN + 1):
                        if j + b >= h or i + a < 0 or i + a >= w:
                            continue
                        k = (j + b) * w + i + a
                        for m in range(start[k], start[k + 1]):
                            if deck[m] and walkable(z[m] - z[n], distance(a, b)):
                                one, other = root_of(parent, n), root_of(parent, m)
                                parent[max(one, other)] = min(one, other)
    number = np.full(len(z), -1, np.int64)
    count = 0
    for n in range(len(z)):
        if deck[n]:
            root = root_of(parent, n)
            if root == n:
                number[n] = count
                count += 1
            else:
                number[n] = number[root]
    sums, box = np.zeros((count, 3), np.int64), np.zeros((count, 4), np.int64)
    box[:, 0], box[:, 2] = h, w
    for j in range(h):
        for i in range(w):
            for n in range(start[j * w + i], start[j * w + i + 1]):
                k = number[n]
                if k >= 0:
                    sums[k, 0] += 1
                    sums[k, 1] += j
                    sums[k, 2] += i
                    box[k, 0], box[k, 1] = min(box[k, 0], j), max(box[k, 1], j)
                    box[k, 2], box[k, 3] = min(box[k, 2], i), max(box[k, 3], i)
    return number, sums, box


@device
def _sector(j, i, sums):
    # From the middle, times the size: whole numbers, the same wherever the array begins.
    turn = np.arctan2(float(j * sums[0] - sums[1]), float(i * sums[0] - sums[2])) / (2 * np.pi) + 1.0
    return int(turn * SECTORS) % SECTORS


@device
def _leads_on(z, start, h, w, kind, number, j, i, n):
    """Whether one can walk on from a level of a part to what is of none."""
    for b in range(max(j - LINK, 0), min(j + LINK + 1, h)):
        for a in range(max(i - LINK, 0), min(i + LINK + 1, w)):
            for m in range(start[b * w + a], start[b * w + a + 1]):
                if number[m] < 0 and kind[m] == SOLID and walkable(z[m] - z[n], distance(a - i, b - j)):
                    return True
    return False


@njit
def rims(z, start, h, w, kind, end, number, sums):
    """Of each part, by sector: cells that lead on, and ways that end at nothing; cells at a drop, and how its ways end."""
    outward, cut = np.zeros((len(sums), SECTORS), np.int64), np.zeros((len(sums), SECTORS), np.int64)
    drops, ends = np.zeros(len(sums), np.int64), np.zeros((len(sums), 5), np.int64)
    for j in range(h):
        for i in range(w):
            for n in range(start[j * w + i], start[j * w + i + 1]):
                k = number[n]
                if k < 0:
                    continue
                drop = False
                for d in range(8):
                    ends[k, end[n, d]] += 1
                    drop |= end[n, d] == DOWN or end[n, d] == ACROSS
                    if end[n, d] == NOTHING:
                        cut[k, _sector(j, i, sums[k])] += 1
                drops[k] += drop
                if _leads_on(z, start, h, w, kind, number, j, i, n):
                    outward[k, _sector(j, i, sums[k])] += 1
    return outward, cut, drops, ends


@njit
def land(z, start, h, w, kind, end, number, sums, box, part, sector, stamp, seen, queue, place, ends):
    """How many cells of land one walks to from a part's end in some sectors, up to AWAY cells, and how its ways end."""
    length = 0
    low_j, high_j, low_i, high_i = h, -1, w, -1
    at = -1
    # First what the part leads on to, then what that does.
    for j in range(box[0], box[1] + 1):
        for i in range(box[2], box[3] + 1):
            for n in range(start[j * w + i], start[j * w + i + 1]):
                if number[n] != part or not sector[_sector(j, i, sums)]:
                    continue
                for b in range(max(j - LINK, 0), min(j + LINK + 1, h)):
                    for a in range(max(i - LINK, 0), min(i + LINK + 1, w)):
                        for m in range(start[b * w + a], start[b * w + a + 1]):
                            if number[m] >= 0 or kind[m] != SOLID or seen[m] == stamp:
                                continue
                            if walkable(z[m] - z[n], distance(a - i, b - j)):
                                seen[m] = stamp
                                queue[length], place[length, 0], place[length, 1] = m, b, a
                                length += 1
                                low_j, high_j = min(low_j, b), max(high_j, b)
                                low_i, high_i = min(low_i, a), max(high_i, a)
    while at + 1 < length:
        at += 1
        n, j, i = queue[at], place[at, 0], place[at, 1]
        for d in range(8):
            ends[end[n, d]] += 1
        for b in range(max(j - LINK, 0, low_j - AWAY), min(j + LINK + 1, h, high_j + AWAY + 1)):
            for a in range(max(i - LINK, 0, low_i - AWAY), min(i + LINK + 1, w, high_i + AWAY + 1)):
                for m in range(start[b * w + a], start[b * w + a + 1]):
                    if number[m] == part or kind[m] != SOLID or seen[m] == stamp:
                        continue
                    if walkable(z[m] - z[n], distance(a - i, b - j)):
                        seen[m] = stamp
                        queue[length], place[length, 0], place[length, 1] = m, b, a
                        length += 1
    return length


def judged(z, start, h, w, kind, end, number, sums, box, left, bottom, deck) -> None:
    """Leave in `deck` (n,) the parts that are decks."""
    outward, cut, drops, ends = rims(z, start, h, w, kind, end, number, sums)
    seen, queue = np.full(len(z), -1, np.int64), np.empty(len(z), np.int64)
    place = np.empty((len(z), 2), np.int64)
    good = np.zeros(len(sums), bool)
    extent = np.maximum(box[:, 1] - box[:, 0], box[:, 3] - box[:, 2]) + 1
    long = extent > LONGEST / CELL
    stamp = 0
    for k in np.flatnonzero((sums[:, 0] >= SMALLEST) & ~long):
        down = ends[k, DOWN] + ends[k, ACROSS]
        if outward[k].sum() > OUTWARD * drops[k] or ends[k, WALLED] > WALLS * down:
            continue
        opposite = _opposite(outward[k], outward[k])
        whole = opposite is not None and ends[k, NOTHING] <= RIM * down
        if not whole:
            if sums[k, 0] < CUT or outward[k].sum() * CUT_RIM > drops[k]:
                continue
            opposite = _opposite(outward[k], cut[k])
            if opposite is None:
                continue
        assert opposite is not None
        for sectors in opposite if whole else opposite[:1]:
            ways_end = np.zeros(5, np.int64)
            cells = land(
                z,
                start,
                h,
                w,
                kind,
                end,
                number,
                sums[k],
                box[k],
                k,
                sectors,
                stamp,
                seen,
                queue,
                place,
                ways_end,
            )
            stamp += 1
            if not _is_land(cells, ways_end):
                break
        else:
            good[k] = True
    if long.any():
        deck &= np.append(good, False)[number] | stretches(
            start, h, w, kind, end, number, np.append(long, False), left, bottom, z
        )
    else:
        deck &= np.append(good, False)[number]


def _opposite(
    one: NDArray[np.int64], other: NDArray[np.int64]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]] | None:
    """The sectors of two ends that lie opposite each other and hold the most: of one kind, and of the other."""
    best, found = (0, 0), None
    for a in range(SECTORS):
        here = np.zeros(SECTORS, bool)
        here[(a + np.arange(-NEAR, NEAR + 1)) % SECTORS] = True
        there = np.roll(here, SECTORS // 2)
        score = (
            int(min(one[here].sum(), other[there].sum())),
            int(one[a] + other[(a + SECTORS // 2) % SECTORS]),
        )
        if score > best and score[0] > 0:
            best, found = score, (here, there)
    return found


def _is_land(cells: int, ends: NDArray[np.int64]) -> bool:
    over = max(int(ends[1:].sum()), 1)
    down, any_down, nothing = ends[DOWN] / over, (ends[DOWN] + ends[ACROSS]) / over, ends[NOTHING] / over
    return (
        cells >= LAND and down <= _LAND_DROPS[0] and any_down <= _LAND_DROPS[1] and nothing <= _LAND_DROPS[2]
    )


@njit
def stretches(start, h, w, kind, end, number, long, left, bottom, z):
    """Levels (n,) of long parts whose rim, in the 3 x 3 blocks around, is drops."""
    low_a, low_b = left // BLOCK - 1, bottom // BLOCK - 1
    across, along = (left + w) // BLOCK + 2 - low_a, (bottom + h) // BLOCK + 2 - low_b
    sums = np.zeros((along, across, 4), np.int64)
    for j in range(h):
        for i in range(w):
            for n in range(start[j * w + i], start[j * w + i + 1]):
                if number[n] < 0 or not long[number[n]]:
                    continue
                own = sums[(j + bottom) // BLOCK - low_b, (i + left) // BLOCK - low_a]
                drop = False
                for d in range(8):
                    if end[n, d] == DOWN or end[n, d] == ACROSS:
                        own[0] += 1
                        drop = True
                    elif end[n, d] == WALLED:
                        own[1] += 1
                own[2] += drop
                own[3] += _leads_on(z, start, h, w, kind, number, j, i, n)
    good = np.zeros((along, across), np.bool_)
    for b in range(1, along - 1):
        for a in range(1, across - 1):
            near = np.zeros(4, np.int64)
            for v in range(b - 1, b + 2):
                for u in range(a - 1, a + 2):
                    near += sums[v, u]
            good[b, a] = near[0] > 0 and near[1] <= WALLS * near[0] and near[3] <= OUTWARD / 2 * near[2]
    found = np.zeros(len(number), np.bool_)
    for j in range(h):
        for i in range(w):
            for n in range(start[j * w + i], start[j * w + i + 1]):
                if number[n] >= 0 and long[number[n]]:
                    found[n] = good[(j + bottom) // BLOCK - low_b, (i + left) // BLOCK - low_a]
    return found


@njit
def _mark(z, use, column, row, left, bottom, h, w, heights, start, kind, deck, out):
    """Say of points whether they are on a deck, up to BESIDE cells from those that were found, or of its parts."""
    for p in range(len(z)):
        if not use[p]:
            continue
        j, i = row[p] - bottom, column[p] - left
        weights = 0
        nearest = (BESIDE + 1) ** 2 * 2
        level = 0.0
        for b in range(max(j - BESIDE, 0), min(j + BESIDE + 1, h)):
            for a in range(max(i - BESIDE, 0), min(i + BESIDE + 1, w)):
                squared = (a - i) ** 2 + (b - j) ** 2
                for m in range(start[b * w + a], start[b * w + a + 1]):
                    if deck[m] and -FLANK - 1.0 <= z[p] - heights[m] <= PARAPET + 1.0:
                        weights += 1
                        if squared < nearest or (squared == nearest and heights[m] > level):
                            nearest, level = squared, heights[m]
        if weights == 0 or not -FLANK <= z[p] - level <= PARAPET:
            continue
        # Ground that one walks on to is no deck.
        own = False
        for m in range(start[j * w + i], start[j * w + i + 1]):
            if kind[m] == SOLID and not deck[m] and abs(heights[m] - level) <= 2 * ON_DECK:
                own = True
        if not own:
            out[p] = SURFACE if abs(z[p] - level) <= ON_DECK else PARTS
