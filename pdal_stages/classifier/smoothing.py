"""Probabilities averaged with those of the neighbors: what a point is not sure of, its surroundings may be.

Each class's probability becomes the mean of the point's own and of the mean over the classified points in a sphere
around it, itself included: half of what counts stays the point's own, so that thin layers (low vegetation over
ground) are not drowned by what is above and below them. Probabilities are counted in 65535ths and added as whole
numbers, so the result has the same bits for any order of points, number of threads, or tile.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.jit import njit
from ..base.threads import map_blocks
from ..features.cells import WHOLE
from ..features.index import build_grid, check_xyz

#: Farthest that can be asked for, meters: beyond it nothing is a neighbor any more.
FARTHEST = 10.0

#: Points of a piece of work.
_PIECE = 100_000


def count_shares(probabilities: npt.NDArray[Any]) -> npt.NDArray[np.uint16]:
    """Probabilities (n, classes) in 65535ths."""
    return np.rint(np.asarray(probabilities) * WHOLE).astype(np.uint16)


def smooth(
    xyz: npt.NDArray[np.float64], shares: npt.NDArray[np.uint16], radius: float, threads: int | None = None
) -> npt.NDArray[np.float32]:
    """Half the point's own probabilities, half their mean over the sphere of a radius around it.

    Parameters
    ----------
    xyz : (n, 3) float64
        The classified points, meters.
    shares : (n, classes) uint16
        See :func:`count_shares`.
    radius : float
        Meters, above 0.
    threads : int, optional

    Returns
    -------
    (n, classes) float32
        Rows sum to 1.
    """
    out = np.empty(shares.shape, np.float32)
    if not len(shares):
        return out
    grid = build_grid(check_xyz(xyz), 2.0 ** math.floor(math.log2(radius)))
    sorted_shares = shares[grid.order]
    first_point = grid.cell_start[grid.row_start]
    cuts = np.searchsorted(first_point, np.arange(0, len(shares), _PIECE))
    cuts = np.unique(np.append(np.minimum(cuts, len(grid.row_iy)), len(grid.row_iy)))
    pieces = list(zip(cuts[:-1].tolist(), cuts[1:].tolist(), strict=True))
    reach = math.ceil(radius / grid.cell)

    def one(piece: tuple[int, int]) -> tuple[int, npt.NDArray[np.float32]]:
        start, stop = int(first_point[piece[0]]), int(first_point[piece[1]])
        means = np.empty((stop - start, shares.shape[1]), np.float32)
        average_rows(*grid.tables(), *piece, reach, radius * radius, sorted_shares, means)
        return start, means

    for start, means in map_blocks(one, pieces, threads):
        out[grid.order[start : start + len(means)]] = means
    return out


@njit
def average_rows(
    x, y, z, cell_ix, cell_start, row_iy, row_start, first_row, last_row, reach, r2, shares, out
):  # fmt: skip
    """Fill `out` for the points of the grid's rows first_row to last_row; see :func:`smooth`."""
    classes = shares.shape[1]
    rows = 2 * reach + 1
    around, total = np.zeros(classes, np.int64), np.empty(classes, np.int64)
    members = 0
    begin, end = np.empty(rows, np.int64), np.empty(rows, np.int64)  # points of each row of cells around
    cursor = np.empty(rows, np.int64)
    base = cell_start[row_start[first_row]]
    for row in range(first_row, last_row):
        low = row
        while low > 0 and row_iy[low - 1] >= row_iy[row] - reach:
            low -= 1
        high = row
        while high + 1 < len(row_iy) and row_iy[high + 1] <= row_iy[row] + reach:
            high += 1
        near = high - low + 1
        for k in range(near):
            cursor[k] = row_start[low + k]
        for cell in range(row_start[row], row_start[row + 1]):
            ix = cell_ix[cell]
            for k in range(near):
                last = row_start[low + k + 1]
                while cursor[k] < last and cell_ix[cursor[k]] < ix - reach:
                    cursor[k] += 1
                stop = cursor[k]
                while stop < last and cell_ix[stop] <= ix + reach:
                    stop += 1
                begin[k], end[k] = cell_start[cursor[k]], cell_start[stop]
            for i in range(cell_start[cell], cell_start[cell + 1]):
                # Points of a cell are sorted by coordinates: a heap of copies is looked at once.
                if i == cell_start[cell] or x[i] != x[i - 1] or y[i] != y[i - 1] or z[i] != z[i - 1]:
                    around[:] = 0
                    members = 0
                    for k in range(near):
                        for j in range(begin[k], end[k]):
                            dx, dy, dz = x[j] - x[i], y[j] - y[i], z[j] - z[i]
                            if dx * dx + dy * dy + dz * dz <= r2:
                                members += 1
                                for c in range(classes):
                                    around[c] += np.int64(shares[j, c])
                whole = 0
                for c in range(classes):
                    total[c] = around[c] + np.int64(members) * np.int64(shares[i, c])
                    whole += total[c]
                for c in range(classes):
                    out[i - base, c] = total[c] / whole
