"""Wires: long thin lines that hang in the air, which a point's neighborhood cannot know.

A cell's points above the ground are parted into levels; thin ones with few others beside them may be of a wire. One is
where such levels, up to `HALF` meters to both sides, fill a straight line (a wire bends by decimeters over that length),
alone or with others side by side, around which the air is empty and which hides nothing: below it as much is seen as on
either side, which parts wires from eaves, cornices and balconies. Lines that hang together are wires if they are long. Sums
are whole numbers and all reaches are bounded (:data:`REACH`), so neither the order of points nor the tile matters.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..base.jit import device, njit
from ..base.unionfind import root as root_of
from .minima import cell_numbers
from .patches import patches
from .seenbelow import CELL, HALF, SeenBelow

#: How far apart in height the levels of a cell are at least, meters.
GAP = 1.0
#: Wires hang higher than that above the ground, are no thicker in a cell, and have no more other levels around, in 5 x 5
#: cells.
LOWEST, THICK, CROWD = 4.0, 0.9, 14
#: Where points are dense, that is in so many of those cells, others may be in such a share of them: wires side by side.
DENSE, SHARE = 24, 0.85
#: Those are leaves unless what lies about as high, within half a line's length, is scattered so much less across than along
#: (squared).
ACROSS = 0.3
#: Pieces of a line, and how far above or below it, and beside it, points may lie; meters.
PIECE, NEAR, BESIDE = 2.0, 0.35, 1.0
#: The steepest line, rise over run.
STEEPEST = 0.6
#: Pieces of the line that must be filled: of all, or of those to one side where it ends.
FILLED, ONE_SIDED = 8, 5
#: Around the line, from `CLEAR` meters farther on to `AROUND`, there is at most such a share of what is on it.
CLEAR, AROUND, MUCH = 0.45, 2.0, 0.34
#: Unless it is on other lines beside, all of which hold no more than so many times what is on the line.
MOST = 3.0
_BIN, _BINS = 0.4, 14
#: Of the lines' levels on a line, so many hide nothing: a tree or a roof may stand close to a wire.
VOTE = 0.3
#: Lines are so long, and the gaps in them no longer.
LONG, HOP = 30.0, 6
#: How far a wire goes on along its line into what is not clear, such as a tree or its tower.
ON = 6.0
#: How far away points matter, meters.
REACH = LONG + 3 * HALF + HOP + ON + 6.0
_PARTS = 1024


@njit
def _levels(x, y, z, column, row, left, bottom, h, w, order):
    """Levels of cells: mean place (n, 3), thickness, and each point's level; `order` sorts points by cell and height."""
    level = np.full(len(z), -1, np.int64)
    sums = np.zeros((len(z), 4), np.int64)
    thick = np.empty(len(z))
    cells = np.empty(len(z), np.int64)
    n, before, low, high = -1, -1, 0.0, 0.0
    for q in range(len(order)):
        p = order[q]
        k = (row[p] - bottom) * w + column[p] - left
        if k != before or z[p] - high > GAP:
            n += 1
            low, cells[n] = z[p], k
        before, high = k, z[p]
        thick[n] = high - low
        level[p] = n
        sums[n, 0] += 1
        sums[n, 1] += int(np.rint((x[p] - column[p] * CELL) * _PARTS))
        sums[n, 2] += int(np.rint((y[p] - row[p] * CELL) * _PARTS))
        sums[n, 3] += int(np.rint(z[p] * _PARTS))
    n += 1
    place = np.empty((n, 3))
    for m in range(n):
        for a in range(3):
            place[m, a] = sums[m, a + 1] / sums[m, 0] / _PARTS
    start = np.zeros(h * w + 1, np.int64)
    for m in range(n):
        start[cells[m] + 1] += 1
    for k in range(h * w):
        start[k + 1] += start[k]
    return place, thick[:n].copy(), cells[:n].copy(), level, start


@njit
def _thin(place, thick, cells, start, h, w, held):
    """Levels that may be of a wire, of cells `held` (h * w) by any point; and those among which leaves may be."""
    out, crowded = np.zeros(len(thick), np.bool_), np.zeros(len(thick), np.bool_)
    for n in range(len(thick)):
        if thick[n] > THICK:
            continue
        j, i = cells[n] // w, cells[n] % w
        others = cloud = 0
        for b in range(max(j - 2, 0), min(j + 3, h)):
            for a in range(max(i - 2, 0), min(i + 3, w)):
                cloud += held[b * w + a]
                for m in range(start[b * w + a], start[b * w + a + 1]):
                    others += m != n and abs(place[m, 2] - place[n, 2]) <= 2.0
        crowded[n] = others > CROWD
        out[n] = not crowded[n] or (cloud >= DENSE and others < SHARE * cloud)
    return out, crowded


@device
def _clutter(near, count, slim, ux, uy, rise, pieces):
    """Levels around a line that are on no other line beside it, filled like it."""
    half, middle = pieces.shape[2] // 2, _BINS // 2 + 1
    pieces[:] = False
    for m in range(count):
        along = near[m, 0] * ux + near[m, 1] * uy
        a = int(np.floor((near[m, 1] * ux - near[m, 0] * uy) / _BIN)) + middle
        b = int(np.floor((near[m, 2] - rise * along) / _BIN)) + middle
        if slim[m] and 0 <= a < _BINS + 2 and 0 <= b < _BINS + 2:
            pieces[a, b, min(int((along + HALF) / PIECE), 2 * half - 1)] = True
    beside = 0
    for m in range(count):
        along = near[m, 0] * ux + near[m, 1] * uy
        aside, above = near[m, 1] * ux - near[m, 0] * uy, near[m, 2] - rise * along
        away = max(max(abs(aside) - BESIDE + NEAR, 0.0), abs(above))
        if not NEAR + CLEAR < away <= AROUND:
            continue
        a, b = int(np.floor(aside / _BIN)) + middle, int(np.floor(above / _BIN)) + middle
        a, b = min(max(a, 1), _BINS), min(max(b, 1), _BINS)
        lower = upper = 0
        for s in range(2 * half):
            there = False
            for c in range(a - 1, a + 2):
                for d in range(b - 1, b + 2):
                    there |= pieces[c, d, s]
            lower += there and s < half
            upper += there and s >= half
        beside += not slim[m] or (lower + upper < FILLED and max(lower, upper) < ONE_SIDED)
    return beside


@njit
def _lines(place, cells, start, h, w, thin, crowded, line):
    """Fill `line` (n, 3) with the direction (x, y; rise over run) of the line through each level; returns which have one."""
    good = np.zeros(len(thin), np.bool_)
    reach = int(HALF / CELL) + 1
    half = int(HALF / PIECE)
    near = np.empty((4096, 3))
    slim = np.empty(4096, np.bool_)
    filled = np.zeros(2 * half, np.bool_)
    pieces = np.zeros((_BINS + 2, _BINS + 2, 2 * half), np.bool_)
    for n in range(len(thin)):
        if not thin[n]:
            continue
        j, i = cells[n] // w, cells[n] % w
        count = 0
        xx = xy = yy = 0.0
        for b in range(max(j - reach, 0), min(j + reach + 1, h)):
            for a in range(max(i - reach, 0), min(i + reach + 1, w)):
                for m in range(start[b * w + a], start[b * w + a + 1]):
                    if m == n or count == len(near):
                        continue
                    # Places are within their own cells, so that nothing depends on where the array begins.
                    dx, dy = (
                        (a - i) * CELL + place[m, 0] - place[n, 0],
                        (b - j) * CELL + place[m, 1] - place[n, 1],
                    )
                    dz = place[m, 2] - place[n, 2]
                    if abs(dz) > STEEPEST * HALF + AROUND or dx * dx + dy * dy > HALF * HALF:
                        continue
                    if crowded[n] and thin[m] and abs(dz) <= 2.0:
                        xx, xy, yy = xx + dx * dx, xy + dx * dy, yy + dy * dy
                    near[count, 0], near[count, 1], near[count, 2] = dx, dy, dz
                    slim[count] = thin[m]
                    count += 1
        if crowded[n] and xx * yy - xy * xy > ACROSS / (1.0 + ACROSS) ** 2 * (xx + yy) ** 2:
            continue
        best, many = 0, 0
        for c in range(count):
            run = np.sqrt(near[c, 0] ** 2 + near[c, 1] ** 2)
            if not slim[c] or run < 5.0 or abs(near[c, 2]) > STEEPEST * run:
                continue
            ux, uy, rise = near[c, 0] / run, near[c, 1] / run, near[c, 2] / run
            if ux < 0.0 or (ux == 0.0 and uy < 0.0):
                ux, uy, rise = -ux, -uy, -rise
            filled[:] = False
            on, beside = 1, 0
            for m in range(count):
                along = near[m, 0] * ux + near[m, 1] * uy
                aside, above = near[m, 1] * ux - near[m, 0] * uy, near[m, 2] - rise * along
                aside = max(abs(aside) - BESIDE + NEAR, 0.0)
                away = max(aside, abs(above))
                if away <= NEAR:
                    on += slim[m]
                    filled[min(int((along + HALF) / PIECE), 2 * half - 1)] |= slim[m]
                elif NEAR + CLEAR < away <= AROUND:
                    beside += 1
            lower, upper = 0, 0
            for s in range(half):
                lower += filled[s]
                upper += filled[half + s]
            if lower + upper < FILLED and max(lower, upper) < ONE_SIDED:
                continue
            score = 2 * (lower + upper)
            if score < best or (score == best and on <= many):
                continue
            if beside > MUCH * on and (
                beside > MOST * on or _clutter(near, count, slim, ux, uy, rise, pieces) > MUCH * on
            ):
                continue
            best, many = score, on
            line[n, 0], line[n, 1], line[n, 2] = ux, uy, rise
            good[n] = True
    return good


@device
def _on_line(place, line, n, m, dj, di, along_most):
    """Whether a level lies on the line through another."""
    dx, dy = di * CELL + place[m, 0] - place[n, 0], dj * CELL + place[m, 1] - place[n, 1]
    along = dx * line[n, 0] + dy * line[n, 1]
    aside = dy * line[n, 0] - dx * line[n, 1]
    above = place[m, 2] - place[n, 2] - line[n, 2] * along
    return abs(along) <= along_most and abs(aside) <= BESIDE and abs(above) <= NEAR + 0.02 * abs(along)


@njit
def _voted(place, cells, start, h, w, good, line, seen):
    """Levels of lines, of whose levels near by most are `seen` through."""
    out = np.zeros(len(good), np.bool_)
    reach = int(HALF / CELL)
    for n in range(len(good)):
        if not good[n]:
            continue
        j, i = cells[n] // w, cells[n] % w
        all_of, those = 0, 0
        for b in range(max(j - reach, 0), min(j + reach + 1, h)):
            for a in range(max(i - reach, 0), min(i + reach + 1, w)):
                for m in range(start[b * w + a], start[b * w + a + 1]):
                    if good[m] and _on_line(place, line, n, m, b - j, a - i, HALF):
                        all_of += 1
                        those += seen[m]
        out[n] = those >= VOTE * all_of
    return out


@njit
def _joined(place, cells, start, h, w, good, line):
    """Levels of lines that are long."""
    parent = np.arange(len(good))
    for n in range(len(good)):
        if not good[n]:
            continue
        j, i = cells[n] // w, cells[n] % w
        for b in range(max(j - HOP, 0), min(j + HOP + 1, h)):
            for a in range(max(i - HOP, 0), min(i + HOP + 1, w)):
                for m in range(start[b * w + a], start[b * w + a + 1]):
                    if good[m] and m != n and _on_line(place, line, n, m, b - j, a - i, float(HOP)):
                        one, other = root_of(parent, n), root_of(parent, m)
                        parent[max(one, other)] = min(one, other)
    box = np.empty((len(good), 4), np.int64)
    for n in range(len(good)):
        box[n, 0] = box[n, 2] = 1 << 60
        box[n, 1] = box[n, 3] = -1
    for n in range(len(good)):
        if good[n]:
            own = box[root_of(parent, n)]
            j, i = cells[n] // w, cells[n] % w
            own[0], own[1], own[2], own[3] = min(own[0], j), max(own[1], j), min(own[2], i), max(own[3], i)
    out = np.zeros(len(good), np.bool_)
    for n in range(len(good)):
        if good[n]:
            own = box[root_of(parent, n)]
            out[n] = max(own[1] - own[0], own[3] - own[2]) * CELL >= LONG
    return out


@njit
def _extended(place, cells, start, h, w, good, line):
    """The same, and levels near on their lines."""
    out = good.copy()
    reach = int(ON / CELL)
    for n in range(len(good)):
        if not good[n]:
            continue
        j, i = cells[n] // w, cells[n] % w
        for b in range(max(j - reach, 0), min(j + reach + 1, h)):
            for a in range(max(i - reach, 0), min(i + reach + 1, w)):
                for m in range(start[b * w + a], start[b * w + a + 1]):
                    if not out[m] and _on_line(place, line, n, m, b - j, a - i, ON):
                        out[m] = True
    return out


def find_wires(
    xyz: NDArray[np.float64], height: NDArray[np.float64], use: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Points (n,) of wires: coordinates (n, 3) and heights above ground in meters, finite; only points to `use` count."""
    out = np.zeros(len(xyz), bool)
    high = np.flatnonzero(use & (height > LOWEST))
    if not len(high):
        return out
    x, y, z = (np.ascontiguousarray(axis) for axis in xyz[high].T)
    column, row = cell_numbers(x, CELL), cell_numbers(y, CELL)
    below = SeenBelow(xyz, use, high)
    for points, own in patches(column, row, int(REACH), int(LONG)):
        at = np.arange(len(high))[points]
        c, r = column[at], row[at]
        left, bottom = int(c.min()), int(r.min())
        h, w = int(r.max()) + 1 - bottom, int(c.max()) + 1 - left
        order = np.lexsort((z[at], c, r))
        place, thick, cells, level, start = _levels(x[at], y[at], z[at], c, r, left, bottom, h, w, order)
        thin, crowded = _thin(place, thick, cells, start, h, w, below.held((left, bottom, h, w)))
        line = np.zeros((len(thin), 3))
        good = _lines(place, cells, start, h, w, thin, crowded, line)
        if not good.any():
            continue
        seen = below.seen_through(good, line, place, cells, (left, bottom, h, w), at, level)
        good = _voted(place, cells, start, h, w, good, line, seen)
        good = _joined(place, cells, start, h, w, good, line)
        found = _extended(place, cells, start, h, w, good, line)[level]
        out[high[at[own]]] = found[own]
    return out
