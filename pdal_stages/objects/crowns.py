"""Trees of cells: tops of a smoothed canopy, and the crown that goes with each.

A canopy height model without pits is smoothed a little. Its tops are its h-maxima (the extended-maxima transform of Kwak,
Lee, Lee, Biging, Gong 2007): maxima from which every way to higher ground goes down by at least `depth`. That needs no
size of crowns, which in closed stands hangs more on the neighbors than on the height. A watershed gives the crowns
(marker-controlled, Chen, Baldocchi, Gong, Kelly 2006): other maxima go to the higher ground beside them. Every step reaches
a bounded way: higher ground is looked for within half of `REACH`, and a cell that leads farther than `REACH` is given up.
So a tile with that much around it has the crowns of the whole forest.
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
    out = scipy.ndimage.gaussian_filter(
        height, sigma, mode="constant", radius=int(np.ceil(2.5 * sigma))
    )
    return np.where(height > 0.0, out, 0.0)


@device
def _higher(z, a, b):
    """Whether cell a is higher than b; of equal ones the first."""
    return z[a] > z[b] or (z[a] == z[b] and a < b)


@njit
def crown_cells(s: NDArray, least: float, depth: float, reach: float) -> NDArray:
    """Of each cell of a smoothed canopy the number of its tree's top cell, -1 where there is none.

    A cell goes to the highest cell beside it, up to a maximum. A maximum goes to the nearest higher cell that a way over
    cells at most `depth` meters lower leads to, all within half of `reach` cells; where there is none it is a top. A cell
    belongs to a crown where it is at least 0.3 times as high as the top and within `reach` cells of it; tops are nearly as
    high as the `least` tree, meters.
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
    seen = np.full(rows * columns, -1, np.int64)  # by the flood of which maximum
    for n in range(rows * columns):
        if up[n] != n:
            continue
        r, c = n // columns, n % columns
        nearest, todo = 0.25 * reach * reach, [n]
        while todo:
            at = todo.pop()
            for i in range(max(at // columns - 1, 0), min(at // columns + 2, rows)):
                for j in range(max(at % columns - 1, 0), min(at % columns + 2, columns)):
                    m, away = i * columns + j, (i - r) ** 2 + (j - c) ** 2
                    if seen[m] == n or z[m] < z[n] - depth or away > 0.25 * reach * reach:
                        continue
                    seen[m] = n
                    if not _higher(z, m, n):
                        todo.append(m)
                    elif away < nearest or (
                        away == nearest and (up[n] == n or _higher(z, m, up[n]))
                    ):
                        up[n], nearest = m, away
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
