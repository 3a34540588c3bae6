"""Means over cells of an absolute grid and those around them: of probabilities, of return flags.

Values are counted in 65535ths and added as whole numbers over a point's own cell and the cells around it, then divided
by the number of points there. So a mean has the same bits for any order of points, number of threads, and in any
tile that holds those cells; and a point costs as much in a dense cloud as in a sparse one.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.arrays import begins_run
from ..base.jit import njit
from .index import cell_numbers

#: Points whose cells are numbered in one go: they stay in a core's cache.
_TOGETHER = 1 << 16
#: A share of 1.
WHOLE = 65535


def cell_means(
    coordinates: npt.NDArray[np.float64], shares: npt.NDArray[np.uint16], side: float, votes: bool = False
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float32]]:
    """(cell of each point, means (cells, columns) over each cell and those around it).

    Two coordinates make columns of any height; they and `side`, one of :data:`SIDES`, are in meters. `shares` (n, columns)
    are in 65535ths; with `votes` the largest column of each point counts alone, as a whole.
    """
    keys, offsets = cell_keys(coordinates, side)
    order = np.argsort(keys)
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


def cell_keys(
    coordinates: npt.NDArray[np.float64], side: float
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """A number for each point's cell, such that cells beside each other along the last axis follow each other.

    And offsets (3 or 9,): added to a number, they give the middle cells of the rows of three around it.
    """
    axes, n = _ORDER[coordinates.shape[1]], len(coordinates)
    spans = np.array([[coordinates[:, k].min(), coordinates[:, k].max()] if n else [0.0, 0.0] for k in axes])
    first, last = cell_numbers(spans, side).T
    # One empty cell beside the last, so that no cell has neighbors at the other end of the grid.
    lengths = [int(length) + 2 for length in last - first]
    numbers = None
    if float(np.prod(np.array(lengths, float))) >= 2.0**62:
        numbers = [_without_gaps(cell_numbers(coordinates[:, k], side)) for k in axes]
        lengths = [int(number.max(initial=0)) + 2 for number in numbers]
    keys = np.empty(n, np.int64)
    for start in range(0, n, _TOGETHER):
        part = slice(start, start + _TOGETHER)
        key: Any = 0
        for place, (k, length) in enumerate(zip(axes, lengths, strict=True)):
            number = (
                cell_numbers(coordinates[part, k], side) - first[place]
                if numbers is None
                else numbers[place][part]
            )
            key = key * length + number
        keys[part] = key
    steps = [1]
    for length in lengths[1:]:
        steps = [step * length for step in steps] + [1]
    offsets = np.zeros(1, np.int64)
    for step in steps[:-1]:
        offsets = np.add.outer(offsets, np.array([-step, 0, step])).reshape(-1)
    return keys, np.sort(offsets)


#: Axes from the slowest to the fastest.
_ORDER = {2: (1, 0), 3: (1, 0, 2)}


def _without_gaps(number: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Strays far apart: empty stretches become one empty cell."""
    there, at = np.unique(number, return_inverse=True)
    return np.concatenate(([0], np.cumsum(np.minimum(np.diff(there), 2))))[at]


# ---- kernels --------------------------------------------------------------------------------------------


@njit
def add_cells(order, start, shares, votes, cell, sums):
    """Fill `cell` with each point's, and `sums` with each cell's shares (or votes) and, last, its points."""
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


@njit
def take_means(cell, means, points, out):
    """The means of the points' cells."""
    for i in range(len(points)):
        k = cell[points[i]]
        for c in range(means.shape[1]):
            out[i, c] = means[k, c]
