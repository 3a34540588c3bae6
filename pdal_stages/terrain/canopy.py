"""Low places that are the ground after all, of which a canopy lets single points through.

More is low there than noise is; and under a closed canopy, where hardly a column around is level with others, what lies on
one plane with half of what is low there is the ground: echoes from below lie at any depth.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..base.jit import device, njit
from .linked import sums_around

#: A canopy is closed where at most such a share of the columns is level with others, within so many columns.
CLOSED, AROUND = 1 / 3, 20
#: More than such a share of the points around, and of the columns that hold any, so many at least, is no noise.
TOO_MANY, COLUMNS = 0.025, 6
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


def _by_distance(reach: int) -> NDArray[np.int64]:
    """Offsets (row, column) within `reach` columns, nearest first."""
    j, i = (axis.ravel() for axis in np.mgrid[-reach : reach + 1, -reach : reach + 1])
    squared = j * j + i * i
    order = np.lexsort((i, j, squared))
    return np.column_stack([j, i])[order[(squared[order] > 0) & (squared[order] <= reach * reach)]]


def seen_through_canopy(
    lowest: NDArray, base: NDArray, supported: NDArray[np.bool_], side: float
) -> NDArray[np.bool_]:
    """Which of the low columns (h, w) are ground of which a closed canopy lets single points through.

    `lowest` (h, w) has the lowest low point of each column, `base` (h, w) the lowest of what is not low, both ``inf``
    where there is none; `supported` (h, w) says which of the latter have enough others of their level around; `side` is
    that of a column, meters.
    """
    on = np.zeros(base.shape, bool)
    _on_sheets(lowest, _by_distance(reach(side)), side, on)
    if not on.any():
        return on
    return on & (sums_around(supported, AROUND) <= CLOSED * sums_around(np.isfinite(base), AROUND))


def more_than_noise(low: NDArray[np.int64], points: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Columns (h, w) around which more is low than noise is, of so many low points and points in all (h, w)."""
    held = sums_around(low > 0, AROUND)
    many = (held >= COLUMNS) & (held > TOO_MANY * sums_around(points > 0, AROUND))
    return many & (sums_around(low, AROUND) > TOO_MANY * sums_around(points, AROUND))
