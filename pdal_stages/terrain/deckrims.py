"""What may be decks, judged by what is at their rims: drops, land at opposite ends, walls below."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from ..base.jit import device, njit
from .linked import longest_sides, root_of, sums_around
from .walkable import (
    ACROSS,
    AHEAD,
    DIAGONAL,
    DOWN,
    DROP,
    FAR,
    NOTHING,
    RIGHT,
    ROUGH,
    SOLID,
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
LINK, JOIN = 2, 2
#: For each cell of a rim at a drop, at most so many lead on, more across water, where bridges are short; for each way that
#: ends at a drop, at most so many end at something else.
OUTWARD, OUTWARD_ACROSS, WALLS = 0.7, 1.75, 0.7
#: Such a share of what leads on at an end, leads on to land: there is no drop as far ahead as decks are wide.
LAND = 0.5
#: At its sides, so much more aside than along, more cells are at a drop than lead on.
SIDE = 1.5
#: The cloud cuts an end in so many ways at least.
CUT = 8
#: Blocks in which long decks are judged, cells, and how many blocks away land must be seen.
BLOCK, FAR_ENDS = 64, 3
#: Deeper than so many meters below the rim, and so many above the ground, lies what is neither deck nor ground; a drop is
#: tall enough to show it from so many meters on. The ground is looked for so many cells ahead, faces so many.
_UNDER, _OVER, _TALL, _GROUND, _FACE = 2.5, 1.0, 4.5, 4, 2
#: Walls are where, in squares that go so many cells to all sides, so many drops are tall, such a share of these have a face
#: below, and at most such a share of all show the ground below the deck.
WINDOW, WALL_RIM, FACED, SHOWN = 10, 10, 0.4, 0.35
#: So many cells from there, rims too low for faces are walls' where so few show the ground.
LOW, SHOWN_LOW = 64, 0.45
#: How far away cells matter: blocks of a deck, its rim and the land at its ends, how far one walks and sees from there, and
#: walls.
REACH = BLOCK * (FAR_ENDS + 1) + LINK + 2 * WIDEST + AHEAD + FAR + 8 + 2 * _FILLS + JOIN + 2 * WINDOW + LOW


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
    return kind, _without_walls(z, start, h, w, kind, end, found)


def _judged(z, start, h, w, left, bottom, kind, goes_on, end, deck, over_nothing) -> NDArray[np.bool_]:
    """Which levels (n,) of what may be decks are some, by what is at the rims of their parts."""
    level = np.flatnonzero(deck)
    part = _parts(z, start, h, w, deck)
    on, to_land = (out[level] for out in _leads_on(z, start, h, w, kind, part, goes_on))
    part, end = part[level], end[level]
    row, column = np.divmod(np.repeat(np.arange(h * w), np.diff(start))[level], w)
    drop, across = (end == DOWN) | (end == ACROSS), (end == ACROSS).sum(axis=1)
    walled, cut = (end == WALLED).sum(axis=1), (end == NOTHING).sum(axis=1)
    if over_nothing:
        drop, cut = drop | (end == NOTHING), 0 * cut
    down, rim = drop.sum(axis=1), drop.any(axis=1)
    size = np.bincount(part)
    length = 1 + longest_sides(part, (row, column), len(size))

    def sums(values):
        return np.bincount(part, values, len(size))

    most = np.where(2 * sums(across) > sums(down), OUTWARD_ACROSS, OUTWARD)
    good = (size >= SMALLEST) & (length <= LONGEST) & (length > (FAR if over_nothing else 0))
    good &= (sums(walled) <= WALLS * sums(down)) & (sums(on) <= most * sums(rim))
    # The way along it is across its drops; from its middle, times the size: whole numbers, wherever the array begins.
    xx, xy, yy = (sums((drop * by).sum(axis=1)) for by in (RIGHT * RIGHT, RIGHT * UP, UP * UP))
    turn = 0.5 * np.arctan2(2 * xy, xx - yy) + np.pi / 2
    north, east = (at * size[part] - sums(at)[part] for at in (row, column))
    cos, sin = np.cos(turn)[part], np.sin(turn)[part]
    along, aside = east * cos + north * sin, north * cos - east * sin
    half = np.zeros(len(size))
    np.maximum.at(half, part, np.abs(along))
    first, second = along < -0.5 * half[part], along > 0.5 * half[part]
    lands = [sums(to_land & side) > LAND * sums(on & side) for side in (first, second)]
    ends = [at_land | (sums(cut * side) >= CUT) for at_land, side in zip(lands, (first, second), strict=True)]
    good &= ends[0] & ends[1] & (lands[0] | lands[1])
    for flank in (aside > SIDE * np.abs(along), -aside > SIDE * np.abs(along)):
        good &= sums(rim & flank) >= sums(on & flank)
    out = np.zeros(len(deck), bool)
    out[level] = good[part]
    long = length[part] > LONGEST
    if long.any():
        out[level[long]] = _stretches(
            row[long] + bottom, column[long] + left, *(v[long] for v in (down, walled, rim, on, to_land))
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
    good = (downs > 0) & (walls <= WALLS * downs) & (leads <= OUTWARD * drops)
    # Near land, or where it goes on to both sides as far as one looks: no roof is that long.
    good &= (sums_around(sums[4], FAR_ENDS) > 0) | _goes_on(sums[2] > 0) | _goes_on(sums[2].T > 0).T
    return good[b, a]


def _goes_on(rim: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Blocks with some of the rim FAR_ENDS rows up, and some as many rows down, no more columns to a side."""
    beside = np.any(sliding_window_view(np.pad(rim, FAR_ENDS), 2 * FAR_ENDS + 1, axis=1), axis=-1)
    return beside[: len(rim)] & beside[2 * FAR_ENDS :]


def _without_walls(z, start, h, w, kind, end, deck) -> NDArray[np.bool_]:
    """The decks (n,) but for what is near rims below which walls are seen, as of roofs, dams and ramps.

    Beams come aslant: below the rim of a deck they reach the ground and nothing between, below that of a wall its face.
    """
    if not deck.any():
        return deck
    drops = _drops(z, start, h, w, kind, end, deck)
    count, shown, faces, tall = np.moveaxis(sums_around(drops, WINDOW), -1, 0)
    walls = (tall >= WALL_RIM) & (faces >= FACED * tall) & (shown <= SHOWN * count)
    low = (count >= WALL_RIM) & (2 * tall < count) & (shown <= SHOWN_LOW * count)
    walls |= low & (sums_around(walls, LOW) > 0)
    return deck & ~np.repeat(walls.ravel(), np.diff(start))


@device
def _drop(z, start, h, w, kind, deck, j, i, n, d):
    """Of a level's drop in a direction: whether it is one of a deck and not of a truck on it; whether the ground shows below
    the level and nothing between, whether something rough lies between, and whether the drop is tall.
    """
    low = 0.0
    for s in range(_GROUND + 1):
        b, a = j + s * UP[d], i + s * RIGHT[d]
        if b < 0 or a < 0 or b >= h or a >= w:
            break
        for m in range(start[b * w + a], start[b * w + a + 1]):
            if deck[m] and z[m] < z[n] - _OVER:
                return False, False, False, False
            if s > 0:
                low = min(low, z[m] - z[n])
    face = False
    shown = z[start[j * w + i]] < z[n] - DROP and z[start[j * w + i]] - z[n] < low + _OVER
    for s in range(_FACE + 1):
        b, a = j + s * UP[d], i + s * RIGHT[d]
        if b < 0 or a < 0 or b >= h or a >= w:
            break
        for m in range(start[b * w + a], start[b * w + a + 1]):
            if low + _OVER < z[m] - z[n] < -_UNDER:
                face |= kind[m] == ROUGH  # no bank
                shown &= s > 0
    return True, shown, face, low < -_TALL


@njit
def _drops(z, start, h, w, kind, end, deck):
    """Of the decks' drops straight ahead, by cell (h, w, 4): how many there are, how
    many show the ground below, how many have something between, how many are tall.
    """
    out = np.zeros((h, w, 4), np.int32)
    for j in range(h):
        for i in range(w):
            own = out[j, i]
            for n in range(start[j * w + i], start[j * w + i + 1]):
                if not deck[n]:
                    continue
                for d in range(0, 8, 2):
                    if end[n, d] == DOWN:
                        counts, shown, face, tall = _drop(z, start, h, w, kind, deck, j, i, n, d)
                        own[0] += counts
                        own[1] += shown
                        own[2] += face
                        own[3] += tall
    return out


@njit
def _filled(z, start, h, w, kind, deck):
    """The decks, and what is walked on and has more of them than of other ground around."""
    out = deck.copy()
    near = np.zeros((h, w), np.bool_)  # cells with some of it around: few
    for j in range(h):
        for i in range(w):
            if np.any(deck[start[j * w + i] : start[j * w + i + 1]]):
                near[max(j - 2, 0) : j + 3, max(i - 2, 0) : i + 3] = True
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
def _parts(z, start, h, w, deck):
    """Number the parts that hang together across up to JOIN cells (n,), -1 elsewhere."""
    parent = np.arange(len(z))
    for j in range(h):
        for i in range(w):
            for n in range(start[j * w + i], start[j * w + i + 1]):
                if not deck[n]:
                    continue
                for b in range(j, min(j + JOIN + 1, h)):
                    for a in range(max(i - JOIN, 0) if b > j else i + 1, min(i + JOIN + 1, w)):
                        for m in range(start[b * w + a], start[b * w + a + 1]):
                            if deck[m] and walkable(z[m] - z[n], distance(a - i, b - j)):
                                one, other = root_of(parent, n), root_of(parent, m)
                                parent[max(one, other)] = min(one, other)
    number, count = np.full(len(z), -1, np.int64), 0
    for n in range(len(z)):
        if deck[n]:
            root = root_of(parent, n)
            if root == n:
                number[n] = count
                count += 1
            else:
                number[n] = number[root]
    return number


@njit
def _leads_on(z, start, h, w, kind, part, goes_on):
    """Levels (n,) of parts from which one walks on to what is of none, and to land."""
    on, to_land = np.zeros(len(z), np.bool_), np.zeros(len(z), np.bool_)
    for j in range(h):
        for i in range(w):
            for n in range(start[j * w + i], start[j * w + i + 1]):
                if part[n] < 0:
                    continue
                for b in range(max(j - LINK, 0), min(j + LINK + 1, h)):
                    for a in range(max(i - LINK, 0), min(i + LINK + 1, w)):
                        for m in range(start[b * w + a], start[b * w + a + 1]):
                            if (
                                part[m] < 0
                                and kind[m] == SOLID
                                and walkable(z[m] - z[n], distance(a - i, b - j))
                            ):
                                on[n] = True
                                turn = int(np.rint(np.arctan2(float(b - j), float(a - i)) / (np.pi / 4)))
                                to_land[n] |= goes_on[m, turn % 8]
    return on, to_land
