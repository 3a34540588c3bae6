"""The lowest point of every cell: all that filtered ground needs of points far away."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .lowest import lowest_points
from .minima import cell_numbers
from .patches import patches

#: Heights beyond this, in meters, are no terrain, and too much for the sums.
HIGHEST = 1e6
#: Groups of points farther apart, in cells, are worked on apart.
_APART = 128


def lowest_of_cells(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    z: NDArray[np.float64],
    use: NDArray[np.bool_],
    cell: float,
) -> NDArray[np.int64]:
    """Numbers of the points that are the lowest usable ones of their cells, ascending; meters, finite coordinates."""
    use = use & (np.abs(z) < HIGHEST)
    mine = np.flatnonzero(use)
    if not mine.size:
        return mine
    x, y, z = x[mine], y[mine], z[mine]
    column, row = cell_numbers(x, cell), cell_numbers(y, cell)
    found = []
    for points, own in patches(column, row, 0, _APART):
        at = np.arange(len(x))[points][own]
        left, bottom = int(column[at].min()), int(row[at].min())
        grid = np.empty((int(row[at].max()) - bottom + 1, int(column[at].max()) - left + 1), np.int64)
        every = np.ones(len(at), bool)
        lowest_points(z[at], x[at], y[at], every, column[at], row[at], left, bottom, grid)
        found.append(at[grid[grid >= 0]])
    return np.sort(mine[np.concatenate(found)])
