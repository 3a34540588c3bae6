"""Trees of cells: tops of a smoothed canopy, and the crown that goes with each.

The steps are the field's: a canopy height model without pits, smoothed; its maxima in a window that grows with height
(Popescu, Wynne 2004); a watershed of which only the tops' basins stay (marker-controlled, Chen, Baldocchi, Gong, Kelly
2006), the others going to the top they belong to. Here every step reaches a bounded way: a cell climbs to its maximum, and a
maximum goes to a higher one within its window, over the highest saddle; what leads farther than `REACH` is given up. So
a tile with that much around it has the crowns of the whole forest.
"""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from ..base.jit import device, njit

#: Farthest that a cell lies from the top of its tree, meters.
REACH = 15.0
_RING = np.array([[True, True, True], [True, False, True], [True, True, True]])


def canopy(high: NDArray, ground: NDArray) -> NDArray[np.float64]:
    """Height of the canopy above the ground, 0 where there is none; pits and empty cells inside crowns filled.

    Cells are raised to the fourth highest of their eight neighbors where they lie more than half below it.

    Parameters
    ----------
    high : (r, c) float64
        Height of the highest point of vegetation in each cell, meters; NaN where there is none.
    ground : (r, c) float64
    """
    height = np.maximum(np.nan_to_num(high - ground), 0.0)
    fourth = scipy.ndimage.rank_filter(height, -4, footprint=_RING, mode="constant")
    return np.where(height < 0.5 * fourth, fourth, height)


def smoothed(height: NDArray, sigma: float) -> NDArray:
    """Heights averaged by a Gaussian of `sigma` cells; beyond the array there is no canopy."""
    out = scipy.ndimage.gaussian_filter(height, sigma, mode="constant", radius=int(np.ceil(2.5 * sigma)))
    return np.where(height > 0.0, out, 0.0)


@device
def _higher(z, a, b):
    """Whether cell a is higher than b; of equal ones the first."""
    return z[a] > z[b] or (z[a] == z[b] and a < b)


@device
def _saddle(s, r, c, i, j):
    """The lowest height on the line between two cells; the same either way."""
    steps = max(abs(i - r), abs(j - c))
    lowest = s[r, c]
    for k in range(1, steps):
        # Whole numbers, rounded alike, whichever cell the line begins at.
        a = (2 * (r * (steps - k) + i * k) + steps) // (2 * steps)
        b = (2 * (c * (steps - k) + j * k) + steps) // (2 * steps)
        lowest = min(lowest, s[a, b])
    return lowest


@njit
def crown_cells(s: NDArray, least: float, base: float, slope: float, depth: float, reach: float) -> NDArray:
    """Of each cell of a smoothed canopy the number of its tree's top cell, -1 where there is none.

    A cell goes to the highest cell beside it, up to a maximum. Of the higher maxima in a maximum's window, the one over
    the highest saddle (on the line between) takes it, where the saddle lies no more than `depth` times its height below.
    A window has a radius of `base` cells and `slope` per meter of height, half of `reach` at most. A cell belongs to a
    crown where it is at least 0.3 times as high as the top and within `reach` cells of it; tops are nearly as high as
    the `least` tree, meters.
    """
    rows, columns = s.shape
    z = s.ravel()
    up = np.full(rows * columns, -1, np.int64)  # where a cell goes; a top goes to itself
    for n in range(rows * columns):
        r, c = n // columns, n % columns
        if z[n] >= min(1.5, least / 2):
            up[n] = n
            for i in range(max(r - 1, 0), min(r + 2, rows)):
                for j in range(max(c - 1, 0), min(c + 2, columns)):
                    if _higher(z, i * columns + j, up[n]):
                        up[n] = i * columns + j
    maximum = up == np.arange(rows * columns)
    for n in range(rows * columns):
        if not maximum[n]:
            continue
        r, c = n // columns, n % columns
        radius = min(base + slope * z[n], reach / 2)
        k = int(radius)
        best, best_saddle, best_away = n, -1.0, 0
        for i in range(max(r - k, 0), min(r + k + 1, rows)):
            for j in range(max(c - k, 0), min(c + k + 1, columns)):
                m = i * columns + j
                away = (i - r) * (i - r) + (j - c) * (j - c)
                if not maximum[m] or m == n or away > radius * radius or not _higher(z, m, n):
                    continue
                saddle = _saddle(s, r, c, i, j)
                if saddle > best_saddle or (saddle == best_saddle and away < best_away):
                    best, best_saddle, best_away = m, saddle, away
        if best_saddle >= z[n] * (1.0 - depth):
            up[n] = best
    out = np.full(rows * columns, -1, np.int64)
    for n in range(rows * columns):
        r, c, at = n // columns, n % columns, up[n]
        while at >= 0:
            dr, dc = at // columns - r, at % columns - c
            if dr * dr + dc * dc > reach * reach:
                at = -1
            elif up[at] == at:
                break
            else:
                at = up[at]
        if at >= 0 and z[at] >= 0.8 * least and z[n] >= 0.3 * z[at]:
            out[n] = at
    return out.reshape(s.shape)
