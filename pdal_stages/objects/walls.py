"""What straight outlines look at along boundaries of cells: places, the direction of walls, corners."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..base.jit import njit

#: Places of a line that are as far off, but for rounding, cells: the first is taken.
_ALIKE = 1e-9
#: So acute a corner (cosine) that cuts off less than so many cells is no building's: a small annex that the grid cut.
_ACUTE, _SPIKE = math.cos(math.radians(60.0)), 16.0


@njit
def middles(corners: NDArray) -> NDArray:
    """Middles (m, 2) of the unit steps of a boundary along cells, of which corners (n, 2) are given as whole numbers."""
    count = 0
    for n in range(len(corners) - 1):
        count += int(max(abs(corners[n + 1, 0] - corners[n, 0]), abs(corners[n + 1, 1] - corners[n, 1])))
    out = np.empty((count, 2))
    count = 0
    for n in range(len(corners) - 1):
        x, y = corners[n + 1, 0] - corners[n, 0], corners[n + 1, 1] - corners[n, 1]
        many = int(max(abs(x), abs(y)))
        for k in range(many):
            share = (k + 0.5) / many
            out[count, 0], out[count, 1] = corners[n, 0] + share * x, corners[n, 1] + share * y
            count += 1
    return out


@njit
def _extents(away: NDArray, c: NDArray, s: NDArray) -> NDArray:
    """The sum of extents of steps (n, 2) along both axes of frames of which cosines and sines are given."""
    out = np.empty(len(c))
    for k in range(len(c)):
        total = 0.0
        for n in range(len(away)):
            total += abs(c[k] * away[n, 0] + s[k] * away[n, 1]) + abs(c[k] * away[n, 1] - s[k] * away[n, 0])
        out[k] = total
    return out


def main_direction(places: NDArray) -> float:
    """The angle, radians in [0, pi/2), of the frame in which the walls through places (n, 2) along boundaries run.

    The one in which the steps from a place to the fifth after it are longest along one axis and shortest along the other:
    the least sum of their extents along both.
    """
    away = np.roll(places, -5, axis=0) - places
    away = away[np.hypot(*away.T) < 8.0]  # not from one ring to the next
    if not len(away):
        return 0.0
    best = math.pi / 4
    for step, span in ((math.radians(2.0), math.pi / 4), (math.radians(0.2), math.radians(3.0))):
        angles = best + np.arange(-round(span / step), round(span / step) + 1) * step
        total = _extents(away, np.cos(angles), np.sin(angles))
        best = float(angles[np.argmin(np.round(total, 6))])
    return best % (math.pi / 2)


@njit
def peucker(xy: NDArray, tolerance: float) -> NDArray:
    """Numbers of the places that stay of a line (n, 2), in order (Douglas, Peucker 1973)."""
    keep = np.zeros(len(xy), np.bool_)
    keep[0] = keep[-1] = True
    todo = [(0, len(xy) - 1)]
    while len(todo):
        a, b = todo.pop()
        if b - a < 2:
            continue
        x, y = xy[b, 0] - xy[a, 0], xy[b, 1] - xy[a, 1]
        squared = x * x + y * y
        far, most = a, 0.0
        for n in range(a + 1, b):
            u, v = xy[n, 0] - xy[a, 0], xy[n, 1] - xy[a, 1]
            t = min(max((u * x + v * y) / squared, 0.0), 1.0) if squared > 0.0 else 0.0
            off = np.sqrt((u - t * x) ** 2 + (v - t * y) ** 2)
            if off > most + _ALIKE:
                far, most = n, off
        if most > tolerance:
            keep[far] = True
            todo.append((a, far))
            todo.append((far, b))
    return np.flatnonzero(keep)


def blunted(corners: NDArray) -> NDArray:
    """Corners (k, 2) of a ring without small acute ones, out or in; the most acute goes first, four stay."""
    xy = np.asarray(corners, np.float64)
    while len(xy) > 4:
        back, on = np.roll(xy, 1, axis=0) - xy, np.roll(xy, -1, axis=0) - xy
        cut = 0.5 * np.abs(back[:, 0] * on[:, 1] - back[:, 1] * on[:, 0])
        cosine = (back * on).sum(axis=1) / np.maximum(np.hypot(*back.T) * np.hypot(*on.T), _ALIKE)
        spike = np.where((cosine > _ACUTE) & (cut < _SPIKE), np.round(cosine, 6), -1.0)
        if spike.max() < 0.0:
            break
        xy = np.delete(xy, int(np.argmax(spike)), axis=0)
    return xy
