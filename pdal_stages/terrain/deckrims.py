"""What may be decks, judged by what is at their rims: drops, land at opposite ends."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from ..base.jit import njit
from .linked import longest_sides, number_sets, sums_around
from .walkable import (
    ACROSS,
    AHEAD,
    DIAGONAL,
    DOWN,
    FAR,
    NOTHING,
    RIGHT,
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
LINK = 2
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
#: How far away cells matter: blocks of a deck, its rim and the land at its ends, how far one walks and sees from there.
REACH = BLOCK * (FAR_ENDS + 1) + LINK + 2 * WIDEST + AHEAD + FAR + 8 + 2 * _FILLS + LINK


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
    return kind, found


def _judged(z, start, h, w, left, bottom, kind, goes_on, end, deck, over_nothing) -> NDArray[np.bool_]:
    """Which levels (n,) of what may be decks are some, by what is at the rims of their parts."""
    level, number = np.flatnonzero(deck), np.cumsum(deck) - 1
    row, column = np.divmod(np.repeat(np.arange(h * w), np.diff(start)), w)
    one, other = _beside(z, start, h, w, kind, deck)
    both, part = deck[other], np.empty(len(level), np.int64)
    number_sets(number[one[both]], number[other[both]], part)
    # Where one walks on to what is no deck, and to land.
    one, other = one[~both], other[~both]
    turn = (
        np.rint(np.arctan2(row[other] - row[one], column[other] - column[one]) / (np.pi / 4)).astype(int) % 8
    )
    on, to_land = (
        np.bincount(some, minlength=len(z))[level] > 0 for some in (one, one[goes_on[other, turn]])
    )
    row, column, end = row[level], column[level], end[level]
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


def _filled(z, start, h, w, kind, deck) -> NDArray[np.bool_]:
    """The decks, and what is walked on and has more of them than of other ground around."""
    cell = np.repeat(np.arange(h * w), np.diff(start))
    near = sums_around(np.bincount(cell[deck], minlength=h * w).reshape(h, w), LINK).ravel() > 0
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
                                one, other = np.concatenate((one, one)), np.concatenate((other, other))
                            one[count], other[count] = n, m
                            count += 1
    return one[:count], other[:count]
