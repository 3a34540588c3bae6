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
from ..terrain.cells import CellWindow, cell_numbers, levels, longest_sides, number_sets, patches

#: Side of the cells, meters.
CELL = 1.0
#: Wires hang higher than that above the ground, are no thicker in a cell, and have no more other levels around, in 5 x 5
#: cells.
LOWEST, THICK, CROWD = 4.0, 0.9, 14
#: Where points are in so many of those cells, others may be in such a share of them: wires side by side.
DENSE, SHARE = 24, 0.85
#: These are leaves unless what lies about as high, within half a line's length, is scattered so much less across than along
#: (squared).
ACROSS = 0.3
#: Half the length of the line that is looked for, pieces of it, and how far above or below it, and beside it, points may
#: lie; meters.
HALF, PIECE, NEAR, BESIDE = 12.0, 2.0, 0.35, 1.0
#: The steepest line, rise over run.
STEEPEST = 0.6
#: Pieces of the line that must be filled: of all, or of those to one side where it ends.
FILLED, ONE_SIDED = 8, 5
#: Around the line, from `CLEAR` meters farther on to `AROUND`, there is at most such a share of what is on it.
CLEAR, AROUND, MUCH = 0.45, 2.0, 0.34
#: Unless it is on other lines beside, all of which hold no more than so many times what is on the line.
MOST = 3.0
_BIN, _BINS = 0.4, 14
#: What lies `UNDER` meters below the line is counted up to `STRIP` meters from it, and to each side from `STRIP_FROM` to
#: `STRIP_TO`: below are so many of all that is not higher on the fuller side, for the same area, and to either side so many
#: of what is below on the other.
UNDER, STRIP, STRIP_FROM, STRIP_TO, SEEN, EITHER = 1.0, 0.6, 1.2, 3.6, 0.55, 0.2
#: Of the lines' levels on a line, so many hide nothing: a tree or a roof may stand close to a wire.
VOTE = 0.3
#: Lines are so long, and the gaps in them no longer; so far a wire goes on into what is not clear, as a tree or its tower.
LONG, HOP = 30.0, 6.0
#: How far away points matter, meters.
REACH = LONG + 3 * HALF + 2 * HOP + 6.0
#: Cells beside the high points' raster from which the ground near lines may be seen.
_MARGIN = int((HALF + STRIP_TO) / CELL) + 1
_PARTS = 1024


def find_wires(
    xyz: NDArray[np.float64], height: NDArray[np.float64], use: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Points (n,) of wires: coordinates (n, 3) and heights above ground in meters, finite; only points to `use` count."""
    out = np.zeros(len(xyz), bool)
    high = np.flatnonzero(use & (height > LOWEST))
    if not len(high):
        return out
    column, row = cell_numbers(xyz[:, 0], CELL), cell_numbers(xyz[:, 1], CELL)
    for points, own in patches(column[high], row[high], int(REACH), int(LONG)):
        at = high[points]
        window = CellWindow.round(column[at], row[at]).grown(_MARGIN)
        near = np.flatnonzero(use & window.holds(column, row))
        found = _find(xyz, window.numbers(column, row), near, at, window.height, window.width)
        out[at[own]] = found[own]
    return out


def _find(xyz, cell, every, high, h, w) -> NDArray[np.bool_]:
    """Which of the high points are of wires; `cell` numbers those of a raster, of which `every` has the points there."""
    order, begins = levels(xyz[high, 2], cell[high])
    z, cells = xyz[high[order], 2], cell[high[order]]
    level = np.empty(len(high), np.int64)
    level[order] = np.cumsum(begins) - 1
    first = np.flatnonzero(begins)
    cells, thick = cells[first], z[np.r_[first[1:], len(z)] - 1] - z[first]
    # Places are within their own cells and sums of whole numbers, so that neither where the raster begins nor order matters.
    within = xyz[high] - np.floor(xyz[high] / CELL) * [CELL, CELL, 0.0]
    sums = [np.bincount(level, np.rint(axis * _PARTS)) for axis in within.T]
    place = np.column_stack(sums) / np.bincount(level)[:, None] / _PARTS
    start = np.searchsorted(cells, np.arange(h * w + 1))
    held = np.bincount(cell[every], minlength=h * w) > 0
    thin, crowded = _thin(place, thick, cells, start, h, w, held)
    line = np.zeros((len(thin), 3))
    good = _lines(place, cells, start, h, w, thin, crowded, line)
    if not good.any():
        return np.zeros(len(high), bool)
    order = every[np.argsort(cell[every], kind="stable")]
    begin = np.searchsorted(cell[order], np.arange(h * w + 1))
    on = np.zeros(len(xyz), bool)
    on[high] = good[level]
    x, y, z = (xyz[order] - np.floor(xyz[order] / CELL) * [CELL, CELL, 0.0]).T
    seen = _seen_through(place, cells, w, good, line, x, y, z, begin, on[order])
    one, other, along = _on_lines(place, cells, start, h, w, good, line)
    count = len(good)
    lines = good[other]
    good &= np.bincount(one[lines], seen[other[lines]], count) >= VOTE * np.bincount(
        one[lines], minlength=count
    )
    near = (along <= HOP) & good[one]
    linked = near & good[other]
    part = np.empty(count, np.int64)
    parts = number_sets(one[linked], other[linked], part)
    good &= (longest_sides(part, np.divmod(cells, w), parts) * CELL >= LONG)[part]
    good[other[near & good[one]]] = True
    return good[level]


@njit
def _thin(place, thick, cells, start, h, w, held):
    """Levels that may be of a wire: thin ones with few others around; and those among which leaves may be."""
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
    """How many levels around a line are on no other line beside it, filled like it."""
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
        if not NEAR + CLEAR < max(abs(aside) - BESIDE + NEAR, abs(above)) <= AROUND:
            continue
        a = min(max(int(np.floor(aside / _BIN)) + middle, 1), _BINS)
        b = min(max(int(np.floor(above / _BIN)) + middle, 1), _BINS)
        lower = upper = 0
        for s in range(2 * half):
            there = pieces[a - 1 : a + 2, b - 1 : b + 2, s].any()
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
                    dx = (a - i) * CELL + place[m, 0] - place[n, 0]
                    dy = (b - j) * CELL + place[m, 1] - place[n, 1]
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
                away = max(abs(aside) - BESIDE + NEAR, abs(above))
                if away <= NEAR:
                    on += slim[m]
                    filled[min(int((along + HALF) / PIECE), 2 * half - 1)] |= slim[m]
                elif NEAR + CLEAR < away <= AROUND:
                    beside += 1
            lower = upper = 0
            for s in range(half):
                lower += filled[s]
                upper += filled[half + s]
            if lower + upper < FILLED and max(lower, upper) < ONE_SIDED:
                continue
            score = lower + upper
            if score < best or (score == best and on <= many) or beside > MOST * on:
                continue
            if beside > MUCH * on and _clutter(near, count, slim, ux, uy, rise, pieces) > MUCH * on:
                continue
            best, many = score, on
            line[n, 0], line[n, 1], line[n, 2] = ux, uy, rise
            good[n] = True
    return good


@njit
def _seen_through(place, cells, w, good, line, x, y, z, begin, on):
    """Of the levels with lines, those that hide nothing.

    Of all points in the order of their cells, which begin at `begin`: places in these (x, y), heights, and whether they are
    `on` such lines.
    """
    out = good.copy()
    for n in range(len(good)):
        if not good[n]:
            continue
        j, i = cells[n] // w, cells[n] % w
        below, sides, under = 0, np.zeros(2, np.int64), np.zeros(2, np.int64)
        for b in range(j - _MARGIN, j + _MARGIN + 1):
            for a in range(i - _MARGIN, i + _MARGIN + 1):
                for p in range(begin[b * w + a], begin[b * w + a + 1]):
                    dx, dy = (
                        (a - i) * CELL + x[p] - place[n, 0],
                        (b - j) * CELL + y[p] - place[n, 1],
                    )
                    along, aside = (
                        dx * line[n, 0] + dy * line[n, 1],
                        dy * line[n, 0] - dx * line[n, 1],
                    )
                    if abs(along) > HALF or abs(aside) > STRIP_TO:
                        continue
                    above = z[p] - place[n, 2] - line[n, 2] * along
                    if abs(aside) <= STRIP:
                        below += above < -UNDER
                    elif abs(aside) > STRIP_FROM and above < UNDER and not on[p]:
                        sides[int(aside > 0.0)] += 1
                        under[int(aside > 0.0)] += above < -UNDER
        out[n] = below * (STRIP_TO - STRIP_FROM) >= SEEN * 2.0 * STRIP * sides.max()
        out[n] &= under.min() >= EITHER * under.max()
    return out


@njit
def _on_lines(place, cells, start, h, w, good, line):
    """Levels with lines, others on these up to `HALF` meters away, themselves included, and how far away (k,)."""
    one, other, far = np.empty(1024, np.int64), np.empty(1024, np.int64), np.empty(1024)
    count, reach = 0, int(HALF / CELL)
    for n in range(len(good)):
        if not good[n]:
            continue
        j, i = cells[n] // w, cells[n] % w
        for b in range(max(j - reach, 0), min(j + reach + 1, h)):
            for a in range(max(i - reach, 0), min(i + reach + 1, w)):
                for m in range(start[b * w + a], start[b * w + a + 1]):
                    dx, dy = (
                        (a - i) * CELL + place[m, 0] - place[n, 0],
                        (b - j) * CELL + place[m, 1] - place[n, 1],
                    )
                    along, aside = (
                        dx * line[n, 0] + dy * line[n, 1],
                        dy * line[n, 0] - dx * line[n, 1],
                    )
                    above = place[m, 2] - place[n, 2] - line[n, 2] * along
                    away = abs(along)
                    if away > HALF or abs(aside) > BESIDE or abs(above) > NEAR + 0.02 * away:
                        continue
                    if count == len(one):
                        one, other = np.concatenate((one, one)), np.concatenate((other, other))
                        far = np.concatenate((far, far))
                    one[count], other[count], far[count] = n, m, away
                    count += 1
    return one[:count], other[:count], far[:count]
