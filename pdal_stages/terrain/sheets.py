"""Low noise that is the ground after all, of which a canopy lets single points through.

Taken back is what is low where more is than noise is; and under a closed canopy, where hardly a column around is level
with others, what lies on one plane with half of what is low there: echoes from below lie at any depth.
"""

from __future__ import annotations

import numpy as np

from ..base.jit import device, njit
from .envelope import FAR
from .openings import by_distance

#: More than such a share of the points around, and of the columns that hold any, so many at least, is no noise.
TOO_MANY, COLUMNS = 0.025, 6
#: A canopy is closed where at most such a share of the columns is level with others.
CLOSED = 1 / 3
#: Low places are so many columns apart at least, as a cluster of noise is one; so many of the nearest are looked at.
APART, MOST = 4, 20
#: So many of them, this one among them, and such a share are on a plane: no steeper than that, and within so many
#: meters, and so many more per column of distance.
PLACES, SHARE, STEEPEST, NEAR_PLANE, BEND = 6, 0.5, 1.0, 1.0, 0.2
#: Sine of the least angle between two places from which a plane is laid.
_ANGLE = 0.25

_OFFSETS, _ = by_distance(FAR)


@device
def _around(points, low, base, supported, j, i):
    """Whether more around a column is low than noise is, and whether the canopy is closed there."""
    h, w = points.shape
    every = deep = full = held = seen = level = 0
    for b in range(max(j - FAR, 0), min(j + FAR + 1, h)):
        for a in range(max(i - FAR, 0), min(i + FAR + 1, w)):
            if (b - j) ** 2 + (a - i) ** 2 <= FAR * FAR:
                every += points[b, a]
                deep += low[b, a]
                full += points[b, a] > 0
                held += low[b, a] > 0
                seen += base[b, a] < np.inf
                level += supported[b, a]
    many = held >= COLUMNS and held > TOO_MANY * full and deep > TOO_MANY * every
    return many, level <= CLOSED * seen


@device
def _places(lowest, offsets, j, i, u, v, dz):
    """How many low places are around this one, apart from each other; where, in columns, and how much higher."""
    h, w = lowest.shape
    n = 0
    for k in range(len(offsets)):
        b, a = j + offsets[k, 0], i + offsets[k, 1]
        if b < 0 or a < 0 or b >= h or a >= w or lowest[b, a] == np.inf:
            continue
        apart = max(abs(b - j), abs(a - i)) >= APART
        for q in range(n):
            apart = apart and max(abs(b - j - v[q]), abs(a - i - u[q])) >= APART
        if apart:
            u[n], v[n], dz[n] = a - i, b - j, lowest[b, a] - lowest[j, i]
            n += 1
            if n == MOST:
                break
    return n


@device
def _on_a_plane(n, u, v, dz, steepest):
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
            if across**2 + along**2 > steepest**2:
                continue
            on = 0
            for k in range(n):
                room = NEAR_PLANE + BEND * np.sqrt(u[k] ** 2 + v[k] ** 2)
                on += abs(dz[k] - across * u[k] - along * v[k]) <= room
            if on >= others:
                return True
    return False


@njit
def _ground(points, low, lowest, base, supported, offsets, steepest, back):
    h, w = points.shape
    u, v, dz = np.empty(MOST), np.empty(MOST), np.empty(MOST)
    for j in range(h):
        for i in range(w):
            if low[j, i]:
                many, closed = _around(points, low, base, supported, j, i)
                back[j, i] = many
                if closed and not many:
                    n = _places(lowest, offsets, j, i, u, v, dz)
                    back[j, i] = _on_a_plane(n, u, v, dz, steepest)


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


def take_back(z, column, row, left, bottom, base, supported, side, mark, marks):
    """Set the `marks` of points that are the ground from `mark` to 0.

    `base` (h, w) has the height of the lowest point of each column that is no small cluster's, from column and row
    `left`, `bottom` on; `supported` (h, w) says which of these have enough others of their level around; `side` is that
    of a column, meters.
    """
    points, low = np.zeros((2, *base.shape), np.int32)
    lowest = np.full(base.shape, np.inf)
    _count(z, column, row, left, bottom, marks, mark, points, low, lowest)
    back = np.zeros(base.shape, bool)
    _ground(points, low, lowest, base, supported, _OFFSETS, STEEPEST * side, back)
    _take(column, row, left, bottom, back, mark, marks)
