"""Bridge decks: smooth surfaces that leave the ground at two ends and lie high above what is on both sides.

A deck is found as a whole, by the way one can walk (:mod:`.walkable`): to both sides, at most `WIDEST` meters apart, the
way ends at a drop, or at water. Such cells that hang together are a deck if their rim is drops for the most part, and if at
two ends, opposite each other, one walks on to land whose own rim is no drop, as a roof's is. Of what is longer than
`LONGEST`, such as a viaduct, each stretch is judged by its rim, and land at one end is enough (:mod:`.longdecks`). The rule
of Sithole and Vosselman [S06], raised in a profile across and level with the ground in the profile along, is applied to
the surface instead of to profiles.

The grid is anchored to absolute coordinates, all reaches are bounded (:data:`REACH`) and counts are whole numbers: the order
of points does not matter, and a tile with its surroundings finds the decks of the whole cloud.

[S06] Sithole, Vosselman (2006): Bridge detection in airborne laser scanner data. ISPRS Journal of Photogrammetry and
Remote Sensing 61(1), 33-46.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..base.jit import device, njit
from .deckparts import LONGEST, amid, extent, first_like, parts
from .deckrims import (
    AWAY,
    JOIN,
    LINK,
    LINK_THROUGH,
    NEAR,
    OUTWARD,
    OUTWARD_ACROSS,
    RIM,
    SECTORS,
    SMALLEST,
    WALLS,
    WITHIN,
    first_land,
    is_land,
    is_open,
    islets,
    may_be_land,
    no_ends,
    opposite_ends,
    rims,
    spread,
    through,
)  # fmt: skip
from .deckroofs import NEXT, ROOF, without_roofs
from .deckwalls import LOW, WINDOW, without_walls
from .levels import levels
from .longdecks import BLOCK, FAR_ENDS, LONG_RIM, OVER_NOTHING, stretches
from .minima import cell_numbers
from .patches import patches
from .walkable import (
    ACROSS,
    AHEAD,
    DIAGONAL,
    DOWN,
    FAR,
    NOTHING,
    ROUGH,
    SOLID,
    STEP,
    STRAIGHT,
    WALLED,
    distance,
    surfaces,
    walkable,
    ways,
)

#: Side of the cells, meters: what is said of cells below is said of meters.
CELL = 1.0
#: The widest deck.
WIDEST = 60
#: Of 5 x 5 cells, so many are of something broad.
BROAD = 18
#: How often what is walked on between deck cells becomes deck as well.
_FILLS = 2
#: A deck that the rim of the cloud cuts is so large and has for each cell that leads on so many at a drop.
CUT, CUT_RIM = 60, 3
#: Where it cuts both ends, or land at one is too little to tell, a deck of so many cells that goes on in so many ways at
#: each end is one if what lies below is seen from its sides.
CROSSING, CUT_END = 250, 8
#: How far from the deck's surface its points lie, meters: on it, and in cells beside it, where leaves are; parapets and cars
#: above; its flank below.
ON_DECK, ON_RIM, PARAPET, FLANK = 0.4, 0.25, 1.6, 2.0
#: Rise over run of banks, whose points are no flank of the deck above.
BANK = 0.7
#: Cells beyond those that were found, to the deck's edge and under its cars.
BESIDE = 2
#: More than NEXT squared cells away only among cells of a deck, whose mean is at most so many cells away.
AMONG = 1.5
#: How far away points matter, in meters: cells of a deck, its rim, and land at its ends, which all look around.
REACH = (
    BLOCK * (FAR_ENDS + 1)
    + LINK_THROUGH
    + AWAY
    + AHEAD
    + FAR
    + 8
    + WIDEST
    + 2 * _FILLS
    + 2 * BESIDE
    + ROOF
    + JOIN
    + WITHIN
    + 2 * WINDOW
    + LOW
) * CELL
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
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    z: NDArray[np.float64],
    use: NDArray[np.bool_],
    largest: int,
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """All that :func:`decks_of_levels` needs, of the points :func:`level_points` at least, and what these are numbers of.

    Levels in cells up to twice BESIDE from a deck (n, 5): column, row, height, whether it is a deck's, its kind; and the
    numbers of the points that are their lowest. No raster has more than `largest` cells, see :func:`.patches.patches`.
    """
    rows, numbers = [np.empty((0, 5))], [np.empty(0, np.int64)]
    if len(x):
        column, row = cell_numbers(x, CELL), cell_numbers(y, CELL)
        for points, own in patches(column, row, int(REACH), FAR + AHEAD, largest):
            found = _deck_levels(z[points], use[points], column[points], row[points])
            if found is None:
                continue
            *_, heights, lowest, start, kind, deck = found
            near = near_decks(start, *found[2:4], deck)
            if not isinstance(own, slice):
                near &= own[lowest]
            point = lowest[near] if isinstance(points, slice) else points[lowest[near]]
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
    for part, _own in patches(columns, rows, 0, 2 * BESIDE + 1):
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
def near_decks(start, h, w, deck):
    """Levels (n,) in cells up to twice BESIDE from one with a deck."""
    out = np.zeros(len(deck), np.bool_)
    for j in range(h):
        for i in range(w):
            for n in range(start[j * w + i], start[j * w + i + 1]):
                if deck[n]:
                    for b in range(max(j - 2 * BESIDE, 0), min(j + 2 * BESIDE + 1, h)):
                        for a in range(max(i - 2 * BESIDE, 0), min(i + 2 * BESIDE + 1, w)):
                            out[start[b * w + a] : start[b * w + a + 1]] = True
    return out


def _deck_levels(z, use, column, row):
    """The raster round points, its levels, and which of them are of decks; None where none is."""
    left, bottom, h, w = _raster(column, row)
    heights, lowest, start = levels(z, use, column, row, left, bottom, h, w)
    kind = surfaces(heights, start, h, w)
    way, last, end = ways(heights, start, h, w, kind, int(WIDEST / CELL) * STRAIGHT)
    deck, above = between_drops(way, last, int(WIDEST / CELL) * STRAIGHT)
    del way, last  # the most that is held
    if not deck.any():
        return None
    raster = heights, start, h, w, kind, end
    found = _judged(raster, deck, left, bottom)
    # Where a river without returns is wider than one sees, decks lead on over nothing.
    if above.any():
        found |= _judged(raster, deck | above, left, bottom, FAR)
    if found.any():
        found = without_walls(raster, found)
    return (left, bottom, h, w, heights, lowest, start, kind, found) if found.any() else None


def _judged(raster, deck, left, bottom, least=0) -> NDArray[np.bool_]:
    """Levels (n,) of decks, of those that may be of one; the decks longer than `least` cells."""
    heights, start, h, w, kind, end = raster
    for _ in range(_FILLS):
        deck = filled(heights, start, h, w, kind, deck)
    deck = deck | islets(heights, start, h, w, kind, deck)
    number, sums, box = parts(heights, start, h, w, deck, np.zeros(len(deck), bool))
    long = np.append(extent(box) > LONGEST, False)[number]
    found = whole_decks(raster, number, sums, box) & np.append(extent(box) > least, False)[number]
    if long.any():  # wires may join roofs to something long
        number, sums, box = parts(heights, start, h, w, long, broad(heights, start, h, w, long))
        found |= whole_decks(raster, number, sums, box)
        long = np.append(extent(box) > LONGEST, False)[number]
        found |= stretches(heights, start, h, w, kind, end, long, left, bottom)
    return without_roofs(raster, found) if found.any() else found


def _find(z, use, column, row) -> NDArray[np.uint8]:
    out = np.zeros(len(z), np.uint8)
    found = _deck_levels(z, use, column, row)
    if found is not None:
        left, bottom, h, w, heights, _, start, kind, deck = found
        _mark(z, use, column, row, left, bottom, h, w, heights, start, kind, deck, out)
    return out


@njit
def between_drops(way, last, most):
    """Levels (n,) with drops on opposite sides, no farther apart than `most` tenths of cells; and with nothing there."""
    found, above = np.zeros(len(way), np.bool_), np.zeros(len(way), np.bool_)
    for n in range(len(way)):
        for d in range(4):
            if way[n, d] + way[n, d + 4] + (STRAIGHT if d % 2 == 0 else DIAGONAL) <= most:
                one, other = last[n, d], last[n, d + 4]
                if one != NOTHING and other != NOTHING:
                    found[n] = True
                elif one != DOWN and other != DOWN:
                    above[n] = True
    return found, above & ~found


@njit
def filled(z, start, h, w, kind, deck):
    """The same, and what is walked on and has more of it than of other ground around."""
    out = deck.copy()
    near = np.zeros((h, w), np.bool_)  # cells with some of it around: few
    for j in range(h):
        for i in range(w):
            for n in range(start[j * w + i], start[j * w + i + 1]):
                if deck[n]:
                    near[max(j - 2, 0) : j + 3, max(i - 2, 0) : i + 3] = True
                    break
    for j in range(h):
        for i in range(w):
            if not near[j, i]:
                continue
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
def _near_broad(z, start, h, w, deck, core):
    """Levels (n,) of decks that lead on to some of the `core` within two cells."""
    out = np.zeros(len(z), np.bool_)
    for j in range(h):
        for i in range(w):
            for n in range(start[j * w + i], start[j * w + i + 1]):
                if not deck[n]:
                    continue
                for b in range(max(j - 2, 0), min(j + 3, h)):
                    for a in range(max(i - 2, 0), min(i + 3, w)):
                        m = first_like(z, start, b * w + a, deck, z[n], distance(a - i, b - j))
                        out[n] |= m >= 0 and core[m]
    return out


def broad(z, start, h, w, deck) -> NDArray[np.bool_]:
    """Levels (n,) of what may be deck that is broad, at least near: no wires that join roofs."""
    return _near_broad(z, start, h, w, deck, amid(z, start, h, w, deck, 2, BROAD))


def whole_decks(raster, number, sums, box) -> NDArray[np.bool_]:
    """Levels (n,) of the parts that are decks, but for those that are too long to be judged as a whole."""
    z, start, h, w, kind, end = raster
    opposite, long, link = {}, np.zeros(len(sums), bool), np.full(len(sums), LINK)
    crossing: list[int] = []
    judged = (sums[:, 0] >= SMALLEST) & (extent(box) <= LONGEST)
    clear = through(z, start, end, number, len(sums))
    for across in (LINK, LINK_THROUGH):
        if not judged.any():
            break
        outward, cut, drops, ends = rims(z, start, h, w, kind, end, number, sums, across)
        for k in map(int, np.flatnonzero(judged)):
            # What leads on no nearer must do so at both ends.
            rim = cut[k] * (across == LINK)
            found = _ends(int(sums[k, 0]), outward[k], rim, drops[k], ends[k])
            if found:
                opposite[k], link[k] = found, across
                long[k] = _is_long(int(sums[k, 0]), outward[k], drops[k])
            elif across == LINK and _crosses(int(sums[k, 0]), outward[k], cut[k], drops[k], ends[k]):
                crossing.append(k)
        judged &= clear & (link == LINK)
        judged[list(opposite)] = False
    good = np.zeros(len(sums) + 1, bool)
    if crossing:
        good[crossing] = is_open(z, start, h, w, end, number, len(sums))[crossing]
    # The deck beside one, as of a motorway, is no land that it leads on to.
    likely = good.copy()
    likely[list(opposite)] = True
    other = np.where(likely[number], number, -1)
    land, seen = np.empty((len(z), 3), np.int32), np.full(len(z), -1, np.int32)
    stamp = 0
    for part, found in opposite.items():
        there, maybe = 0, 0
        for sectors in found:
            over = no_ends()
            cells = first_land(
                z, start, h, w, kind, number, sums[part], box[part], part, sectors, land, seen, stamp, link[part]
            )  # fmt: skip
            cells = spread(z, start, h, w, kind, end, other, land, seen, stamp, cells, over)
            stamp += 1
            land_here = is_land(cells, over, bool(clear[part]))
            there += land_here
            maybe += not land_here and may_be_land(cells, over)
        good[part] |= there == len(found) or (maybe == 1 and there == 1 and long[part])
    return good[number]


def _is_long(size: int, outward: NDArray[np.int64], drops: NDArray[np.int64]) -> bool:
    """Whether a deck shows enough of its rim to do with land at one end."""
    return bool(size >= CUT and outward.sum() * CUT_RIM <= drops.sum())


def _crosses(size: int, outward, cut, drops, ends) -> bool:
    """Whether a part that the rim of the cloud cuts goes on at two opposite ends, and its sides are drops."""
    down, leads = ends[DOWN] + ends[ACROSS], outward + cut
    if size < CROSSING or ends[WALLED] > WALLS * down or outward.sum() > OUTWARD * drops.sum():
        return False
    found = opposite_ends(leads, leads)
    if found is None or not _is_free(found[0], leads, drops):
        return False
    return bool(
        min(leads[found[0]].sum(), leads[found[1]].sum()) >= CUT_END and cut[found[0] | found[1]].any()
    )


def _ends(size: int, outward, cut, drops, ends) -> list[NDArray[np.bool_]]:
    """Sectors of the ends at which a part must lead on to land, by what is at its rim; none where it is no deck."""
    down = ends[DOWN] + ends[ACROSS]
    most = OUTWARD_ACROSS if ends[ACROSS] > ends[DOWN] else OUTWARD
    if outward.sum() > most * drops.sum():
        return []
    opposite = opposite_ends(outward, outward)
    over_nothing = ends[NOTHING] > RIM * down
    walled = ends[WALLED] > WALLS * down
    if (over_nothing or opposite is None) and not walled and _is_long(size, outward, drops):
        cut_off = opposite_ends(outward, cut)
        if cut_off is not None and _is_free(cut_off[0], outward, drops):
            return [cut_off[0]]
    if over_nothing:
        # Over a wide river without returns drops are seen near the ends.
        walled = drops.sum() < LONG_RIM or ends[WALLED] > OVER_NOTHING * (down + ends[NOTHING])
    if opposite is None or walled or not _is_free(opposite[0], outward, drops):
        return []
    return list(opposite)


def _is_free(end: NDArray[np.bool_], outward: NDArray[np.int64], drops: NDArray[np.int64]) -> bool:
    """Whether, halfway between an end and the one opposite, on both sides more cells are at a drop than lead on."""
    middle = int(np.flatnonzero(np.roll(end, NEAR) & np.roll(end, -NEAR))[0])
    for quarter in (SECTORS // 4, -SECTORS // 4):
        flank = (middle + quarter + np.arange(-1, 2)) % SECTORS
        if drops[flank].sum() < outward[flank].sum():
            return False
    return True


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
