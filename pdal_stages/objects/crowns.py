"""Trees of cells: tops of a smoothed canopy, and the crown around each.

A pit-free canopy height model is smoothed a little. Its tops are its h-maxima (the extended-maxima
transform of Kwak, Lee, Lee, Biging, Gong 2007): maxima from which every path to higher canopy
descends by at least the `saddle`. That needs no size of crowns, which in closed stands depends more
on the neighbors than on the height. A watershed gives the crowns (marker-controlled, Chen,
Baldocchi, Gong, Kelly 2006): other maxima join the higher canopy beside them. Every step has a
bounded reach: higher canopy is searched within half of `REACH`, and a cell that leads farther than
`REACH` is dropped. So a tile with that much around it has the crowns of the whole forest.
"""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from ..base.jit import device, njit

# Values without a reason are not tuned.
#: Farthest that a cell lies from the top of its tree, meters: large enough for crowns 30 m wide,
#: small enough that a tile needs little around it.
REACH = 15.0
#: Canopy lower than this, meters (or half the lowest tree), belongs to no crown.
LOWEST_CROWN = 1.5
#: Height of a top in the smoothed canopy / height of the lowest tree: smoothing lowers tops.
TOP_SHARE = 0.8
#: Height of a crown's edge / height of its top; lower cells are undergrowth.
CROWN_SHARE = 0.3
#: Pits: cells lower than this share of the fourth highest of their eight neighbors. Where a pulse
#: passes through a crown, at least half of the cells around hold its canopy.
PIT_SHARE = 0.5
#: Standard deviation of the Gaussian that smooths the canopy, meters; chosen on five plots of
#: forest ("chosen" in benchmarks/trees.py).
SMOOTHING = 0.3
#: Distance at which the Gaussian is cut off, standard deviations: 96 % of its weight lie within.
GAUSS_REACH = 2.5
_RING = np.array([[True, True, True], [True, False, True], [True, True, True]])


def canopy(high: NDArray, ground: NDArray) -> NDArray[np.float64]:
    """Return the canopy height model, meters above the ground, with pits filled.

    Cells lower than `PIT_SHARE` of the fourth highest of their eight neighbors are raised to it.

    Parameters
    ----------
    high : (r, c) float64
        Height of the highest point of vegetation in each cell, meters; NaN where there is none.
    ground : (r, c) float64
        Height of the ground, meters.
    """
    height = np.maximum(np.nan_to_num(high - ground), 0.0)
    fourth = scipy.ndimage.rank_filter(height, -4, footprint=_RING, mode="constant")
    return np.where(height < PIT_SHARE * fourth, fourth, height)


def smooth(height: NDArray, sigma: float) -> NDArray:
    """Return heights averaged by a Gaussian of `sigma` cells; no canopy lies beyond the array."""
    radius = int(np.ceil(GAUSS_REACH * sigma))
    out = scipy.ndimage.gaussian_filter(height, sigma, mode="constant", radius=radius)
    return np.where(height > 0.0, out, 0.0)


@device
def _is_higher(z, a, b):
    """Return whether cell a is higher than b; of equal ones the first."""
    return z[a] > z[b] or (z[a] == z[b] and a < b)


@njit
def crown_cells(s: NDArray, lowest: float, saddle: float, reach: float) -> NDArray:
    """Return the index of the top of each cell's tree in a smoothed canopy; -1 for none.

    A cell leads to the highest cell beside it, up to a maximum. A maximum leads to the nearest
    higher cell that a path over cells at most `saddle` meters lower reaches, all within half of
    `reach` cells; without one it is a top. A cell belongs to a crown where it is at least
    `CROWN_SHARE` times as high as the top and within `reach` cells of it; tops are at least
    `TOP_SHARE` times as high as the `lowest` tree, meters.
    """
    rows, columns = s.shape
    z = s.ravel()
    up = np.full(rows * columns, -1, np.int64)  # where a cell leads to; a top leads to itself
    for n in range(rows * columns):
        r, c = n // columns, n % columns
        if z[n] >= min(LOWEST_CROWN, lowest / 2):
            up[n] = n
            for i in range(max(r - 1, 0), min(r + 2, rows)):
                for j in range(max(c - 1, 0), min(c + 2, columns)):
                    if _is_higher(z, i * columns + j, up[n]):
                        up[n] = i * columns + j
    seen = np.full(rows * columns, -1, np.int64)  # the maximum whose flood visited a cell last
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
                    if seen[m] == n or z[m] < z[n] - saddle or away > 0.25 * reach * reach:
                        continue
                    seen[m] = n
                    if not _is_higher(z, m, n):
                        todo.append(m)
                    elif away < nearest or (
                        away == nearest and (up[n] == n or _is_higher(z, m, up[n]))
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
        if at >= 0 and z[at] >= TOP_SHARE * lowest and z[n] >= CROWN_SHARE * z[at]:
            out[n] = at
    return out.reshape(s.shape)
