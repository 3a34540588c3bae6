"""Where what may be a deck ends: its rim, and the land that one walks on to from it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..base.jit import device, njit
from .walkable import ACROSS, DOWN, DROP, NOTHING, ON, RIGHT, SOLID, UP, WALLED, distance, walkable

#: Cells across which one walks on from a deck, and from one below which the ground is seen, as if there were no deck, up to
#: its end; and across which parts belong together.
LINK, LINK_THROUGH, JOIN = 2, 5, 4
#: Of such a deck, so many cells show what lies below.
THROUGH = 0.5
#: What lies so many meters lower, as it does below few roofs, is seen so many cells from a drop at a deck's side, beside
#: such a share of these drops; beams come in so far per meter, and farther in it is seen in such a share of them at most.
LOFTY, INWARD, OPEN, ASLANT, GLASS = 10.0, 3, 0.45, 0.7, 0.1
#: The smallest deck and the smallest land at its ends, in cells, and how far land is looked for.
SMALLEST, LAND, AWAY = 20, 100, 40
#: Of land that the rim of the cloud cuts so many of the ways end at nothing; what is clear of drops may have so few cells.
_CUT_OFF, _LITTLE, _LITTLE_DROPS = 0.1, 25, 0.05
#: Patches that decks alone lead on to are holes in these, not land, if they have fewer cells and lie in so many rows and
#: columns; a part goes on behind what ends a way so many cells on.
ISLET, WITHIN, BEHIND = 32, 10, 16
#: For each cell of a deck's rim at a drop, at most so many that lead on, and across water, where bridges are short; for each
#: way that ends at a drop, so many that end at something else, and so many at nothing.
OUTWARD, OUTWARD_ACROSS, WALLS, RIM = 0.7, 1.75, 0.7, 0.3
#: The most of the ways over land that end at a drop, at any drop, at nothing.
_LAND_DROPS = (0.15, 0.35, 0.3)
#: Land behind a quay has so many cells, no more of its ways end at a drop, and so much of these add up in one direction.
QUAY, QUAY_DROPS, ONE_SIDED = 1000, 0.45, 0.5
#: How ways over land end, and at drops in eight directions.
ENDS, DIRECTIONS = 5, 8
#: Directions from a deck's middle; an end has the sectors so near.
SECTORS, NEAR = 16, 2


@device
def sector_of(j, i, sums):
    # From the middle, times the size: whole numbers, the same wherever the array begins.
    turn = np.arctan2(float(j * sums[0] - sums[1]), float(i * sums[0] - sums[2])) / (2 * np.pi) + 1.0
    return int(turn * SECTORS) % SECTORS


@device
def leads_on(z, start, h, w, kind, number, j, i, n, link):
    """Whether one can walk on from a level of a part to what is of none, so many cells away."""
    for b in range(max(j - link, 0), min(j + link + 1, h)):
        for a in range(max(i - link, 0), min(i + link + 1, w)):
            for m in range(start[b * w + a], start[b * w + a + 1]):
                if number[m] < 0 and kind[m] == SOLID and walkable(z[m] - z[n], distance(a - i, b - j)):
                    return True
    return False


@device
def goes_on(start, h, w, number, j, i, n, d):
    """Whether a part goes on behind what ends a way in a direction: a car, a lamp, a hole."""
    for s in range(1, BEHIND + 1):
        b, a = j + s * UP[d], i + s * RIGHT[d]
        if b < 0 or a < 0 or b >= h or a >= w:
            return False
        for m in range(start[b * w + a], start[b * w + a + 1]):
            if number[m] == number[n]:
                return True
    return False


def through(z, start, end, number, count) -> NDArray[np.bool_]:
    """Of each part, whether most of its cells that are not at its rim show what lies below."""
    lowest = np.repeat(z[np.minimum(start[:-1], len(z) - 1)], np.diff(start))
    within = (number >= 0) & ~np.any((end == DOWN) | (end == ACROSS), axis=1)
    cells = np.bincount(number[within], minlength=count)
    shown = np.bincount(number[within & (lowest < z - DROP)], minlength=count)
    return (cells >= SMALLEST) & (shown >= THROUGH * cells)


@device
def _shown(z, start, h, w, number, j, i, part):
    """How much lower than a part something lies in one of its cells, -1 where there is none of it."""
    if 0 <= j < h and 0 <= i < w:
        for m in range(start[j * w + i], start[j * w + i + 1]):
            if number[m] == part:
                return z[m] - z[start[j * w + i]]
    return -1.0


@njit
def _below(z, start, h, w, end, number, count):
    """Of each part: drops straight ahead (count, 0); those beside which one sees what lies far below; cells in which one
    does, though the part goes on farther to all sides than a beam comes in.
    """
    out = np.zeros((count, 3), np.int64)
    for j in range(h):
        for i in range(w):
            for n in range(start[j * w + i], start[j * w + i + 1]):
                k = number[n]
                if k < 0:
                    continue
                low = z[n] - z[start[j * w + i]]
                far, amid = INWARD + int(low * ASLANT), low > LOFTY
                for d in range(0, DIRECTIONS, 2):
                    b, a = UP[d], RIGHT[d]
                    amid = amid and _shown(z, start, h, w, number, j + far * b, i + far * a, k) >= 0.0
                    if end[n, d] == DOWN or end[n, d] == ACROSS:
                        seen = _shown(z, start, h, w, number, j - INWARD * b, i - INWARD * a, k)
                        out[k, 0] += 1
                        out[k, 1] += seen > LOFTY
                out[k, 2] += amid
    return out


def is_open(z, start, h, w, end, number, count) -> NDArray[np.bool_]:
    """Of each part, whether beams that come aslant pass below its sides, as they do not below walls, and none through it,
    as through glass.
    """
    drops, seen, glass = _below(z, start, h, w, end, number, count).T
    return (seen > OPEN * drops) & (glass <= GLASS * seen)


@njit
def rims(z, start, h, w, kind, end, number, sums, link=LINK):
    """Of each part, by sector: cells that lead on across `link` cells, ways that end at nothing, cells at a drop; and how
    its ways end, but for what only stands on it.
    """
    outward, cut = np.zeros((len(sums), SECTORS), np.int64), np.zeros((len(sums), SECTORS), np.int64)
    drops, ends = np.zeros((len(sums), SECTORS), np.int64), np.zeros((len(sums), ENDS), np.int64)
    for j in range(h):
        for i in range(w):
            for n in range(start[j * w + i], start[j * w + i + 1]):
                k = number[n]
                if k < 0:
                    continue
                drop = False
                for d in range(DIRECTIONS):
                    on = end[n, d] == WALLED and goes_on(start, h, w, number, j, i, n, d)
                    ends[k, ON if on else end[n, d]] += 1
                    drop |= end[n, d] == DOWN or end[n, d] == ACROSS
                    if end[n, d] == NOTHING:
                        cut[k, sector_of(j, i, sums[k])] += 1
                drops[k, sector_of(j, i, sums[k])] += drop
                if leads_on(z, start, h, w, kind, number, j, i, n, link):
                    outward[k, sector_of(j, i, sums[k])] += 1
    return outward, cut, drops, ends


@njit
def islets(z, start, h, w, kind, deck):
    """Levels (n,) of small patches that one reaches from decks alone: no land, but holes in these."""
    out, seen = np.zeros(len(z), np.bool_), np.full(len(z), -1, np.int32)
    number, land = np.zeros(len(z), np.int8), np.empty((len(z), 3), np.int32)
    known = np.zeros(len(z), np.bool_)
    for n in range(len(z)):
        number[n] = 0 if deck[n] else -1
    for j in range(h):
        for i in range(w):
            for n in range(start[j * w + i], start[j * w + i + 1]):
                if not deck[n]:
                    continue
                for b in range(max(j - LINK, 0), min(j + LINK + 1, h)):
                    for a in range(max(i - LINK, 0), min(i + LINK + 1, w)):
                        for m in range(start[b * w + a], start[b * w + a + 1]):
                            if deck[m] or known[m] or kind[m] != SOLID:
                                continue
                            if not walkable(z[m] - z[n], distance(a - i, b - j)):
                                continue
                            land[0, 0], land[0, 1], land[0, 2] = m, b, a
                            seen[m] = m
                            length, at, large = 1, 0, False
                            low_j, high_j, low_i, high_i = b, b, a, a
                            while at < length and not large:
                                q, row, column = land[at, 0], land[at, 1], land[at, 2]
                                low_j, high_j = min(low_j, row), max(high_j, row)
                                low_i, high_i = min(low_i, column), max(high_i, column)
                                # An islet would have been seen whole.
                                large = known[q] or max(high_j - low_j, high_i - low_i) >= WITHIN
                                length = step_on(
                                    z, start, h, w, kind, number, row, column, q, land, seen, m, length
                                )
                                large |= length >= ISLET
                                at += 1
                            for q in range(length):
                                known[land[q, 0]] = True
                                out[land[q, 0]] = not large
    return out


@njit
def first_land(z, start, h, w, kind, number, sums, box, part, sector, land, seen, stamp, link=LINK):
    """Put what a part leads on to in some sectors into `land` (number, row, column); returns how many cells that are."""
    length = 0
    for j in range(box[0], box[1] + 1):
        for i in range(box[2], box[3] + 1):
            for n in range(start[j * w + i], start[j * w + i + 1]):
                if number[n] == part and sector[sector_of(j, i, sums)]:
                    length = step_on(z, start, h, w, kind, number, j, i, n, land, seen, stamp, length, link)
    return length


@device
def step_on(z, start, h, w, kind, number, j, i, n, land, seen, stamp, length, link=LINK):
    """Add the land that one can walk on to, which is of no part."""
    for b in range(max(j - link, 0), min(j + link + 1, h)):
        for a in range(max(i - link, 0), min(i + link + 1, w)):
            for m in range(start[b * w + a], start[b * w + a + 1]):
                if kind[m] != SOLID or seen[m] == stamp or number[m] >= 0:
                    continue
                if walkable(z[m] - z[n], distance(a - i, b - j)):
                    seen[m] = stamp
                    land[length, 0], land[length, 1], land[length, 2] = m, b, a
                    length += 1
    return length


@njit
def spread(z, start, h, w, kind, end, number, land, seen, stamp, length, ends):
    """Add all one walks on to from there, up to AWAY cells, and count how its ways end, and at drops by direction.

    Returns how many cells that are.
    """
    low_j, high_j, low_i, high_i = h, -1, w, -1
    for q in range(length):
        low_j, high_j = min(low_j, land[q, 1]), max(high_j, land[q, 1])
        low_i, high_i = min(low_i, land[q, 2]), max(high_i, land[q, 2])
    at = 0
    while at < length:
        n, j, i = land[at, 0], land[at, 1], land[at, 2]
        at += 1
        if j < low_j - AWAY or j > high_j + AWAY or i < low_i - AWAY or i > high_i + AWAY:
            continue
        for d in range(DIRECTIONS):
            ends[end[n, d]] += 1
            ends[ENDS + d] += end[n, d] == DOWN or end[n, d] == ACROSS
        length = step_on(z, start, h, w, kind, number, j, i, n, land, seen, stamp, length)
    return length


def no_ends() -> NDArray[np.int64]:
    """What :func:`spread` counts in."""
    return np.zeros(ENDS + DIRECTIONS, np.int64)


def _shares(ends: NDArray[np.int64]) -> tuple[float, float, float]:
    """Of the ways over land that end, those at a drop right ahead, at any drop, at nothing."""
    over = max(int(ends[1:ENDS].sum()), 1)
    return ends[DOWN] / over, (ends[DOWN] + ends[ACROSS]) / over, ends[NOTHING] / over


def may_be_land(cells: int, ends: NDArray[np.int64]) -> bool:
    """Whether what is too small for land may be the beginning of it: cut by the rim of the cloud, or clear of drops."""
    down, any_down, nothing = _shares(ends)
    if nothing >= _CUT_OFF:
        return bool(down <= _LAND_DROPS[0] and any_down <= _LAND_DROPS[1])
    return bool(cells >= _LITTLE and any_down <= _LITTLE_DROPS)


def is_land(cells: int, ends: NDArray[np.int64], bare: bool = False) -> bool:
    """Whether it is land; a `bare` plain is, where nothing but its quay ends a way."""
    down, any_down, nothing = _shares(ends)
    if cells < LAND or nothing > _LAND_DROPS[2]:
        return False
    if down <= _LAND_DROPS[0] and any_down <= _LAND_DROPS[1]:
        return True
    # A quay, unlike a roof, ends at a drop to one side.
    length = np.hypot(RIGHT, UP)
    side = np.hypot(np.sum(ends[ENDS:] * RIGHT / length), np.sum(ends[ENDS:] * UP / length))
    enough = cells >= QUAY and (bare or any_down <= QUAY_DROPS)
    return bool(enough and side >= ONE_SIDED * ends[ENDS:].sum())


#: The sectors of an end in each direction, and those that lie opposite them.
_ENDS = np.array([[(a - b + NEAR) % SECTORS <= 2 * NEAR for a in range(SECTORS)] for b in range(SECTORS)])
_OPPOSITE = np.roll(_ENDS, SECTORS // 2, axis=1)


def opposite_ends(
    one: NDArray[np.int64], other: NDArray[np.int64]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]] | None:
    """The sectors of two ends that lie opposite each other and hold the most: of one kind, and of the other."""
    both = np.minimum(_ENDS @ one, _OPPOSITE @ other)
    middle = one + np.roll(other, SECTORS // 2)
    best = np.lexsort((-np.arange(SECTORS), middle, both))[-1]  # of equal ones the first
    return (_ENDS[best], _OPPOSITE[best]) if both[best] > 0 else None
