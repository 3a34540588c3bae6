"""Means over cells of the grid and their neighbors, and the density of a cloud.

Means are of probabilities and of return flags: values are counted in 65535ths and added as whole
numbers over a point's own cell and the cells around it, then divided by the number of points
there. So a mean has the same bits for any order of points, number of threads, and in any tile that
holds those cells; and a point costs as much in a dense cloud as in a sparse one.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..base.grid import begins_run, compact_keys
from ..base.jit import njit
from ..base.key_order import order_by_key

#: A share of 1.
WHOLE = 65535
#: Side of the cells whose points are counted for the density, meters: large enough to hold points
#: of sparse surveys (4 at 1/m²), small enough that most cells lie inside the cloud. Not tuned.
CELL = 2.0
#: Points in the median cell of a very thin cloud: enough that one more or less matters little.
_SEVERAL = 8


def cell_means(
    coordinates: npt.NDArray[np.float64],
    shares: npt.NDArray[np.uint16],
    side: float,
    votes: bool = False,
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float32]]:
    """Return each point's cell (n,), and means (cells, columns) over each cell and those around it.

    Two coordinates make columns of any height; they and `side`, a power of two, are in meters.
    `shares` (n, columns) are in 65535ths; with `votes` the largest column of each point counts
    alone, as a whole.
    """
    keys, offsets = compact_keys(coordinates, side)
    order = order_by_key(keys)
    keys = keys[order]
    start = np.append(np.flatnonzero(begins_run(keys)), len(keys))
    occupied = keys[start[:-1]]
    cell = np.empty(len(keys), np.int32)
    del keys
    sums = np.zeros((len(occupied), shares.shape[1] + 1), np.int64)
    add_cells(order, start, shares, votes, cell, sums)
    means = np.empty((len(occupied), shares.shape[1]), np.float32)
    average_around(occupied, sums, offsets, means)
    return cell, means


def density(xyz: npt.NDArray[np.float64]) -> float:
    """Return points per square meter: the median over the occupied cells of :data:`CELL` meters.

    0 for an empty cloud. An occupied cell holds a point at least: where cells twice as wide hold a
    single one, too, cells are widened until they hold `_SEVERAL`, or are as wide as the cloud.
    Strays, holes and the cloud's outline do not matter, and the order of the points does not.
    """
    if not len(xyz):
        return 0.0
    cell, points = CELL, _points_per_cell(xyz, CELL)
    if points > 1 or _points_per_cell(xyz, 2 * CELL) > 1:
        return points / cell**2
    width = np.ptp(xyz[:, :2], axis=0).max()
    while points < _SEVERAL and cell < width:
        cell *= 2.0
        points = _points_per_cell(xyz, cell)
    return points / cell**2


def _points_per_cell(xyz: npt.NDArray[np.float64], cell: float) -> float:
    """Return the median number of points in the occupied cells of a width in meters."""
    keys, _ = compact_keys(xyz[:, :2], cell)
    keys.sort()
    starts = np.flatnonzero(begins_run(keys))
    return float(np.median(np.diff(np.append(starts, len(keys)))))


# ---- kernels ---------------------------------------------------------------------------------


@njit
def add_cells(order, start, shares, votes, cell, sums):
    """Fill `cell` with the points' cells, and `sums` with the cells' shares or votes and points."""
    classes = shares.shape[1]
    for k in range(len(start) - 1):
        for j in range(start[k], start[k + 1]):
            i = order[j]
            cell[i] = k
            if votes:
                best = 0
                for c in range(1, classes):
                    if shares[i, c] > shares[i, best]:
                        best = c
                sums[k, best] += WHOLE
            else:
                for c in range(classes):
                    sums[k, c] += np.int64(shares[i, c])
        sums[k, classes] = start[k + 1] - start[k]


@njit
def average_around(keys, sums, offsets, means):
    """Fill `means`: over each cell and those around it, sums of shares / (WHOLE x points)."""
    classes = sums.shape[1] - 1
    rows = len(offsets)
    cursor = np.zeros(rows, np.int64)
    total = np.empty(classes + 1, np.int64)
    n = len(keys)
    for k in range(n):
        total[:] = 0
        for r in range(rows):
            middle = keys[k] + offsets[r]
            at = cursor[r]
            while at < n and keys[at] < middle - 1:
                at += 1
            cursor[r] = at
            while at < n and keys[at] <= middle + 1:
                for c in range(classes + 1):
                    total[c] += sums[at, c]
                at += 1
        whole = float(total[classes]) * WHOLE
        for c in range(classes):
            means[k, c] = float(total[c]) / whole
