"""Low noise that is the ground after all, of which a canopy lets single points through.

Taken back is what is low where more is than noise is; and under a closed canopy, where hardly a column around is level
with others, what lies on one plane with half of what is low there: echoes from below lie at any depth. The latter
holds for the low outliers of a minimum grid, too.
"""

from __future__ import annotations

import math

import numpy as np

from ..base.jit import device, njit
from .envelope import FAR, supported_columns
from .openings import by_distance

#: More than such a share of the points around, and of the columns that hold any, so many at least, is no noise.
TOO_MANY, COLUMNS = 0.025, 6
#: A canopy is closed where at most such a share of the columns is level with others.
CLOSED = 1 / 3
#: Low places are so many meters apart at least, as a cluster of noise is one; so many of the nearest are looked at.
APART, MOST = 6.0, 20
#: How far away they are looked for, in meters.
OTHERS = 45.0
#: So many of them, this one among them, and such a share are on a plane: no steeper than that, and within so many
#: meters, and so many more per meter of distance.
PLACES, SHARE, STEEPEST, NEAR_PLANE, BEND = 6, 0.5, 1.0, 1.0, 0.13
#: Sine of the least angle between two places from which a plane is laid.
_ANGLE = 0.25


def reach(side: float) -> int:
    """How far away others are looked for, in columns."""
    return math.ceil(OTHERS / side)


@device
def _too_many(points, low, j, i):
    """Whether more around a column is low than noise is."""
    h, w = points.shape
    every = deep = full = held = 0
    for b in range(max(j - FAR, 0), min(j + FAR + 1, h)):
        for a in range(max(i - FAR, 0), min(i + FAR + 1, w)):
            if (b - j) ** 2 + (a - i) ** 2 <= FAR * FAR:
                every += points[b, a]
                deep += low[b, a]
                full += points[b, a] > 0
                held += low[b, a] > 0
    return held >= COLUMNS and held > TOO_MANY * full and deep > TOO_MANY * every


@device
def _is_closed(base, supported, j, i):
    """Whether hardly a column around is level with others."""
    h, w = base.shape
    seen = level = 0
    for b in range(max(j - FAR, 0), min(j + FAR + 1, h)):
        for a in range(max(i - FAR, 0), min(i + FAR + 1, w)):
            if (b - j) ** 2 + (a - i) ** 2 <= FAR * FAR:
                seen += base[b, a] < np.inf
                level += supported[b, a]
    return level <= CLOSED * seen


@device
def _places(lowest, offsets, apart, j, i, u, v, dz):
    """How many low places are around this one, apart from each other; where, in columns, and how much higher."""
    h, w = lowest.shape
    n = 0
    for k in range(len(offsets)):
        b, a = j + offsets[k, 0], i + offsets[k, 1]
        if b < 0 or a < 0 or b >= h or a >= w or lowest[b, a] == np.inf:
            continue
        new = max(abs(b - j), abs(a - i)) >= apart
        for q in range(n):
            new = new and max(abs(b - j - v[q]), abs(a - i - u[q])) >= apart
        if new:
            u[n], v[n], dz[n] = a - i, b - j, lowest[b, a] - lowest[j, i]
            n += 1
            if n == MOST:
                break
    return n


@device
def _on_a_plane(n, u, v, dz, side):
    """Whether enough of the places lie on one plane through this one."""
    others = max(PLACES, SHARE * (n + 1)) - 1
    if n < others:
        return False
    for p in range(n):
        for q in range(p):
            turn = u[p] * v[q] - u[q] * v[p]
            if abs(turn) < _ANGLE * np.sqrt((u[p] ** 2 + v[p] ** 2) * (u[q] ** 2 + v[q] ** 2)):
                continue
            across, along = (dz[p] * v[q] - dz[q] * v[p]) / turn, (dz[q] * u[p] - dz[p] * u[q]) / turn
            if across**2 + along**2 > (STEEPEST * side) ** 2:
                continue
            on = 0
            for k in range(n):
                room = NEAR_PLANE + BEND * side * np.sqrt(u[k] ** 2 + v[k] ** 2)
                on += abs(dz[k] - across * u[k] - along * v[k]) <= room
            if on >= others:
                return True
    return False


@njit
def _on_sheets(lowest, offsets, side, on):
    """Of each low column whether it lies on one plane with most of those around."""
    h, w = lowest.shape
    u, v, dz = np.empty(MOST), np.empty(MOST), np.empty(MOST)
    apart = np.ceil(APART / side)
    for j in range(h):
        for i in range(w):
            if lowest[j, i] < np.inf:
                n = _places(lowest, offsets, apart, j, i, u, v, dz)
                on[j, i] = _on_a_plane(n, u, v, dz, side)


@njit
def _under_canopy(base, supported, on):
    """Leave out what no closed canopy is above."""
    h, w = base.shape
    for j in range(h):
        for i in range(w):
            on[j, i] = on[j, i] and _is_closed(base, supported, j, i)


@njit
def _many(points, low, back):
    h, w = points.shape
    for j in range(h):
        for i in range(w):
            back[j, i] = back[j, i] or (low[j, i] > 0 and _too_many(points, low, j, i))


@njit
def _count(z, column, row, left, bottom, marks, mark, points, low, lowest):
    for p in range(len(marks)):
        j, i = row[p] - bottom, column[p] - left
        points[j, i] += 1
        if marks[p] == mark:
            low[j, i] += 1
            lowest[j, i] = min(lowest[j, i], z[p])


@njit
def _take(column, row, left, bottom, back, mark, marks):
    for p in range(len(marks)):
        if marks[p] == mark and back[row[p] - bottom, column[p] - left]:
            marks[p] = 0


def seen_through_canopy(lowest, base, supported, side):
    """Which of the low columns (h, w) are ground of which a closed canopy lets single points through.

    `lowest` (h, w) has the lowest low point of each column, `base` (h, w) the lowest of what is not low, both ``inf``
    where there is none; `supported` (h, w) says which of the latter have enough others of their level around, or None
    that this is to be found; `side` is that of a column, meters.
    """
    on = np.zeros(base.shape, bool)
    _on_sheets(lowest, by_distance(reach(side))[0], side, on)
    if on.any():
        if supported is None:
            supported = np.zeros(base.shape, bool)
            supported_columns(base, supported)
        _under_canopy(base, supported, on)
    return on


def take_back(z, column, row, left, bottom, base, supported, side, mark, marks):
    """Set the `marks` of points that are the ground from `mark` to 0.

    Columns and rows begin at `left`, `bottom`; the others are as in :func:`seen_through_canopy`.
    """
    points, low = np.zeros((2, *base.shape), np.int32)
    lowest = np.full(base.shape, np.inf)
    _count(z, column, row, left, bottom, marks, mark, points, low, lowest)
    back = seen_through_canopy(lowest, base, supported, side)
    _many(points, low, back)
    _take(column, row, left, bottom, back, mark, marks)
