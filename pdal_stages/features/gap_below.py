"""The gap below a point: how far down the next points lie, at and around its place.

A wire hangs in the air, and nothing is below it for meters; below the edge of a roof or the top of
a facade there is a wall, and below leaves there are leaves.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from ..base.grid import begins_run, compact_keys
from ..base.jit import njit

#: The feature's name, as dimensions have it.
NAME = "GapBelow"
#: Side of the columns, meters; those around a point's own count, too. Not tuned.
SIDE = 1.0
#: Points less than this much lower, in meters, are beside a point, not below it. Not tuned.
LEAST = 1.0
#: What is reported at most, meters, and where nothing is below.
MOST = 20.0
#: Meters, along x or y, to the farthest point that matters.
REACH = 2.0 * SIDE


def gap_below(
    names: Iterable[str], xyz: npt.NDArray[np.float64]
) -> dict[str, npt.NDArray[np.float32]]:
    """Compute the gap below each point (n, 3), in meters, where it is among `names`."""
    if NAME not in names:
        return {}
    keys, offsets = compact_keys(xyz[:, :2], SIDE)
    order = np.lexsort((xyz[:, 2], keys))
    keys, height = keys[order], xyz[order, 2]
    start = np.append(np.flatnonzero(begins_run(keys)), len(keys))
    gap = np.empty(len(keys), np.float32)
    gap[order] = _gaps(keys[start[:-1]], start, height, offsets)
    return {NAME: gap}


@njit
def _gaps(keys, start, height, offsets):
    """Return the gaps (n,) below points in the order of their cells, then of their heights.

    `keys` (m,) are those of the cells, ascending, `start` (m + 1,) where their points begin.
    """
    gaps = np.empty(len(height), np.float32)
    rows, n = len(offsets), len(keys)
    cursor, near = np.zeros(rows, np.int64), np.empty(3 * rows, np.int64)
    for k in range(n):
        count = 0
        for r in range(rows):
            middle, at = keys[k] + offsets[r], cursor[r]
            while at < n and keys[at] < middle - 1:
                at += 1
            cursor[r] = at
            while at < n and keys[at] <= middle + 1:
                near[count] = at
                count += 1
                at += 1
        for p in range(start[k], start[k + 1]):
            below = height[p] - MOST
            for c in range(count):
                low, high = start[near[c]], start[near[c] + 1]
                while low < high:  # the first point that is not below
                    middle = (low + high) // 2
                    if height[middle] <= height[p] - LEAST:
                        low = middle + 1
                    else:
                        high = middle
                if low > start[near[c]]:
                    below = max(below, height[low - 1])
            gaps[p] = height[p] - below
    return gaps
