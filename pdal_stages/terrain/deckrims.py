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
#: Cells across which one walks on from a deck to land, from one below which the ground is seen, and across which parts of
#: a deck belong together.
LINK, LINK_CLEAR, JOIN = 2, 5, 2
#: For each cell of a rim at a drop, at most so many lead on, more across water, where bridges are short; for each way that
#: ends at a drop, at most so many end at something else.
OUTWARD, OUTWARD_ACROSS, WALLS = 0.7, 1.75, 0.7
#: Of such a deck, so many cells that are not at its rim show what lies below.
CLEAR = 0.5
#: Directions from a deck's middle; an end has the sectors so near. The cloud cuts an end in so many ways at least.
SECTORS, NEAR, CUT = 16, 2, 8
#: The smallest land at a deck's ends, in cells, how far around an end it is looked for, and the most of its ways that end at
#: a drop right ahead, at any drop, at nothing.
LAND, AWAY, LAND_ENDS = 100, 40, (0.15, 0.35, 0.3)
#: Land behind a quay has so many cells, no more of its ways end at a drop, and so much of these add up in one direction.
QUAY, QUAY_DROPS, ONE_SIDED = 1000, 0.45, 0.5
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
#: How far away cells matter: blocks of a deck, its rim, and land at its ends, which all look around, and walls.
REACH = (
    BLOCK * (FAR_ENDS + 1)
    + LINK_CLEAR
    + AWAY
    + AHEAD
    + FAR
    + 8
    + WIDEST
    + 2 * _FILLS
    + JOIN
    + 2 * WINDOW
    + LOW
)


def deck_levels(z, start, h, w, left, bottom):
    """The kind of each level (n,) of a raster, whose first column and row have numbers, and whether it is of a deck."""
    kind = surfaces(z, start, h, w)
    way, last, end = ways(z, start, h, w, kind, WIDEST * STRAIGHT)
    steps = np.array([STRAIGHT, DIAGONAL, STRAIGHT, DIAGONAL])
    narrow = way[:, :4].astype(np.int32) + way[:, 4:] + steps <= WIDEST * STRAIGHT
    nothing = last == NOTHING
    deck, above = (narrow & ~nothing[:, :4] & ~nothing[:, 4:]).any(axis=1), narrow.any(axis=1)
    del way, last, narrow, nothing  # the most that is held
    for _ in range(_FILLS):
        deck = _filled(z, start, h, w, kind, deck)
    found = np.zeros(len(z), bool)
    # Where a river without returns is wider than one sees, decks lead on over nothing.
    for some, over_nothing in ((deck, False), (deck | above, True)):
        if deck.any() and (not over_nothing or (above & ~deck).any()):
            rims = _Rims((z, start, h, w, kind, end), some, over_nothing)
            found |= rims.whole_decks() | rims.stretches(left, bottom)
    return kind, _without_walls(z, start, h, w, kind, end, found)


class _Rims:
    """What is at the rims of parts of what may be decks, and which of these are decks.

    Of each of their levels (n,): its number in the raster, its part, row and column; whether one walks on from it to land,
    at how many of its eight sides there is a drop, nothing, or something else. Of each part: size, length in cells.
    """

    def __init__(self, raster, deck, over_nothing) -> None:
        z, start, h, w, kind, end = self._raster = raster
        self._parts = _parts(z, start, h, w, deck)
        self._level = np.flatnonzero(deck)
        cell = np.repeat(np.arange(h * w), np.diff(start))[self._level]
        self._part, end = self._parts[self._level], end[self._level]
        self._row, self._column = np.divmod(cell, w)
        self._down, self._nothing = (
            ((end == DOWN) | (end == ACROSS)).sum(axis=1),
            (end == NOTHING).sum(axis=1),
        )
        self._across, self._walled = (end == ACROSS).sum(axis=1), (end == WALLED).sum(axis=1)
        self._size = np.bincount(self._part)
        self._length = 1 + longest_sides(self._part, (self._row, self._column), len(self._size))
        # Where most of a deck shows what lies below, one walks on farther to land.
        shown, within = z[start[cell]] < z[self._level] - DROP, self._down == 0
        many = np.bincount(self._part, within)
        clear = (many >= SMALLEST) & (np.bincount(self._part, within & shown) >= CLEAR * many)
        self._clear = clear[self._part]
        links = np.full(len(z), LINK)
        links[self._level[self._clear]] = LINK_CLEAR
        self._leads = _leads_on(z, start, h, w, kind, self._parts, links)[self._level]
        self._shortest = 0
        if over_nothing:
            self._down, self._nothing, self._shortest = self._down + self._nothing, 0 * self._nothing, FAR
        self._queue, self._seen, self._stamp = (
            np.empty((len(z), 3), np.int32),
            np.full(len(z), -1, np.int32),
            0,
        )

    def whole_decks(self) -> NDArray[np.bool_]:
        """Levels (n,) of the parts that are decks, but for those that are too long to be judged as a whole."""
        part, size = self._part, self._size
        # From the middle, times the size: whole numbers, the same wherever the array begins.
        north, east = (
            at * size[part] - np.bincount(part, at)[part].astype(np.int64) for at in (self._row, self._column)
        )
        turn = np.arctan2(north.astype(float), east.astype(float)) / (2 * np.pi) + 1.0
        sector = (turn * SECTORS).astype(np.int64) % SECTORS

        def sums(values):
            return (
                np.bincount(part * SECTORS + sector, values, len(size) * SECTORS)
                .astype(int)
                .reshape(-1, SECTORS)
            )

        outward, drops, cut = (sums(v) for v in (self._leads, self._down > 0, self._nothing * ~self._clear))
        down, across, walled = (sums(v).sum(axis=1) for v in (self._down, self._across, self._walled))
        most = np.where(2 * across > down, OUTWARD_ACROSS, OUTWARD)
        good = (size >= SMALLEST) & (self._length > self._shortest) & (self._length <= LONGEST)
        good &= (walled <= WALLS * down) & (outward.sum(axis=1) <= most * drops.sum(axis=1))
        for k in np.flatnonzero(good):
            ends = _opposite_ends(outward[k] + cut[k])
            if ends is None or not _is_free(ends[0], outward[k], drops[k]):
                good[k] = False
                continue
            leading = (part == k) & self._leads
            at_land = [self._lead_to_land(leading & end[sector]) for end in ends]
            cut_off = [cut[k][end].sum() >= CUT for end in ends]
            good[k] = any(at_land) and all(a or b for a, b in zip(at_land, cut_off, strict=True))
        return np.append(good, False)[self._parts]

    def stretches(self, left, bottom) -> NDArray[np.bool_]:
        """Levels (n,) of long parts whose rim, in the 3 x 3 blocks around, is drops, and that end at land near."""
        long = self._length[self._part] > LONGEST
        out = np.zeros(len(self._parts), bool)
        if not long.any():
            return out
        b, a = (self._row + bottom) // BLOCK, (self._column + left) // BLOCK
        b, a = b - b.min(), a - a.min()
        shape = int(b.max()) + 1, int(a.max()) + 1
        block = b * shape[1] + a

        def sums(values):
            return np.bincount(block[long], values[long], shape[0] * shape[1]).astype(int).reshape(shape)

        own = [sums(v) for v in (self._down, self._walled, self._down > 0, self._leads)]
        down, walled, drops, leads = (sums_around(v, 1) for v in own)
        good = (down > 0) & (walled <= WALLS * down) & (leads <= OUTWARD * drops)
        ends = np.zeros(shape, bool)
        for k in np.flatnonzero(own[3]):
            ends.flat[k] = self._lead_to_land(long & self._leads & (block == k))
        # Near land, or where it goes on to both sides as far as one looks: no roof is that long.
        good &= (sums_around(ends, FAR_ENDS) > 0) | _goes_on(own[2] > 0) | _goes_on(own[2].T > 0).T
        out[self._level[long & good.ravel()[block]]] = True
        return out

    def _lead_to_land(self, which: NDArray[np.bool_]) -> bool:
        """Whether some of the levels of parts lead on to land."""
        ends = np.zeros(WALLED + 1 + 8, np.int64)
        link = np.where(self._clear, LINK_CLEAR, LINK)
        seeds = np.column_stack([v[which] for v in (self._level, self._row, self._column, link)])
        cells = _spread(*self._raster, self._parts, seeds, self._queue, self._seen, self._stamp, ends)
        self._stamp += 1
        return is_land(cells, ends)


def _goes_on(rim: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Blocks with some of the rim FAR_ENDS rows up, and some as many rows down, no more columns to a side."""
    beside = np.any(sliding_window_view(np.pad(rim, FAR_ENDS), 2 * FAR_ENDS + 1, axis=1), axis=-1)
    return beside[: len(rim)] & beside[2 * FAR_ENDS :]


#: The sectors of an end in each direction.
_ENDS = np.array([[(a - b + NEAR) % SECTORS <= 2 * NEAR for a in range(SECTORS)] for b in range(SECTORS)])


def _opposite_ends(leads: NDArray[np.int64]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]] | None:
    """The sectors of two ends that lie opposite each other and lead on the most."""
    half = SECTORS // 2
    ends = _ENDS @ leads
    both = np.minimum(ends, np.roll(ends, -half))
    order = -np.arange(SECTORS), leads + np.roll(leads, half), both  # of equal ones the first
    best = np.lexsort(order)[-1]
    return (_ENDS[best], np.roll(_ENDS[best], half)) if both[best] > 0 else None


def _is_free(end: NDArray[np.bool_], outward: NDArray[np.int64], drops: NDArray[np.int64]) -> bool:
    """Whether, halfway between an end and the one opposite, on both sides more cells are at a drop than lead on."""
    middle = int(np.flatnonzero(np.roll(end, NEAR) & np.roll(end, -NEAR))[0])
    for quarter in (SECTORS // 4, -SECTORS // 4):
        flank = (middle + quarter + np.arange(-1, 2)) % SECTORS
        if drops[flank].sum() < outward[flank].sum():
            return False
    return True


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


def is_land(cells: int, ends: NDArray[np.int64]) -> bool:
    """Whether what has so many cells is land, by how its ways end (5 numbers), and at drops by direction (8)."""
    over, drops = max(int(ends[1 : WALLED + 1].sum()), 1), ends[WALLED + 1 :]
    down, any_down, nothing = ends[DOWN] / over, drops.sum() / over, ends[NOTHING] / over
    if cells < LAND or nothing > LAND_ENDS[2]:
        return False
    if down <= LAND_ENDS[0] and any_down <= LAND_ENDS[1]:
        return True
    # A quay, unlike a roof, ends at a drop to one side.
    length = np.hypot(RIGHT, UP)
    side = np.hypot(np.sum(drops * RIGHT / length), np.sum(drops * UP / length))
    return bool(cells >= QUAY and any_down <= QUAY_DROPS and side >= ONE_SIDED * drops.sum())


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
def _leads_on(z, start, h, w, kind, part, link):
    """Levels (n,) of parts from which one walks on to what is of none."""
    out = np.zeros(len(z), np.bool_)
    for j in range(h):
        for i in range(w):
            for n in range(start[j * w + i], start[j * w + i + 1]):
                if part[n] < 0:
                    continue
                r = link[n]
                for b in range(max(j - r, 0), min(j + r + 1, h)):
                    for a in range(max(i - r, 0), min(i + r + 1, w)):
                        for m in range(start[b * w + a], start[b * w + a + 1]):
                            on = part[m] < 0 and kind[m] == SOLID
                            out[n] |= on and walkable(z[m] - z[n], distance(a - i, b - j))
    return out


@device
def _step_on(z, start, h, w, kind, part, n, j, i, queue, seen, stamp, length, link):
    """Add the land to a queue that one can walk on to."""
    for b in range(max(j - link, 0), min(j + link + 1, h)):
        for a in range(max(i - link, 0), min(i + link + 1, w)):
            for m in range(start[b * w + a], start[b * w + a + 1]):
                if kind[m] != SOLID or seen[m] == stamp or part[m] >= 0:
                    continue
                if walkable(z[m] - z[n], distance(a - i, b - j)):
                    seen[m] = stamp
                    queue[length, 0], queue[length, 1], queue[length, 2] = m, b, a
                    length += 1
    return length


@njit
def _spread(z, start, h, w, kind, end, part, seeds, queue, seen, stamp, ends):
    """Walk on from some levels over land, up to AWAY cells from where it begins; how many cells that is.

    Counts how its ways end, and at drops by direction.
    """
    length = 0
    for n in range(len(seeds)):
        length = _step_on(
            z,
            start,
            h,
            w,
            kind,
            part,
            seeds[n, 0],
            seeds[n, 1],
            seeds[n, 2],
            queue,
            seen,
            stamp,
            length,
            seeds[n, 3],
        )
    if length == 0:
        return 0
    low_j, high_j = queue[:length, 1].min() - AWAY, queue[:length, 1].max() + AWAY
    low_i, high_i = queue[:length, 2].min() - AWAY, queue[:length, 2].max() + AWAY
    at = 0
    while at < length:
        n, j, i = queue[at, 0], queue[at, 1], queue[at, 2]
        at += 1
        if not (low_j <= j <= high_j and low_i <= i <= high_i):
            continue
        for d in range(8):
            ends[end[n, d]] += 1
            ends[WALLED + 1 + d] += end[n, d] == DOWN or end[n, d] == ACROSS
        length = _step_on(z, start, h, w, kind, part, n, j, i, queue, seen, stamp, length, LINK)
    return length
