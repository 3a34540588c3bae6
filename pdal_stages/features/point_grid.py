"""A cloud sorted by the cells of the absolute grid, and a sparse table of its cells.

The size of cells follows from the neighborhoods alone, never from the cloud, so every tile of a
cloud sees the same cells with the same points in the same order. That order is what makes sums the
same to the last bit however the points were stored. Only occupied cells are kept, so one stray
point a million kilometers away costs one cell.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..base.errors import StageError
from ..base.grid import begins_run, cell_numbers, compact_keys
from ..base.key_order import order_by_key

#: Bits of a place along x within a cell, by which points are sorted first: fine enough that few are
#: equal, few enough that sorting is fast.
FINE_BITS = 22
#: Coordinates beyond this many meters are no point cloud (and would overflow cell numbers).
LIMIT = 1e12
#: Largest coordinate in float32, meters: from there on its steps are 8 mm and more, too coarse for
#: the features of small neighborhoods.
FLOAT32_LIMIT = 1e5


class CellGrid(NamedTuple):
    """A sorted cloud and its occupied cells, a named tuple because compiled kernels read it."""

    #: Edge of a cell in meters, a power of two (so that cell corners are exact).
    cell: float
    #: (n,) int32 or int64: ``order[i]`` is the index, in the cloud as it was given, of the i-th
    #: sorted point.
    order: np.ndarray
    #: (3, n) float64: sorted coordinates, meters; `x`, `y` and `z` are its rows.
    xyz: np.ndarray
    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    #: Column number of each occupied cell (m,) and its first point (m + 1,); cells ascend by row,
    #: then column.
    cell_ix: np.ndarray
    cell_start: np.ndarray
    #: Row number of each occupied row (r,) and its first cell (r + 1,).
    row_iy: np.ndarray
    row_start: np.ndarray


def check_xyz(xyz, what: str = "xyz") -> np.ndarray:
    """Return coordinates as an (n, 3) float64 array; StageError if they cannot be.

    No copy is made of an array that already is one. NaN, infinite and absurdly large (beyond 1e12
    m) coordinates are refused and counted, and so is float32 too coarse for the size of its
    numbers.
    """
    array = np.asarray(xyz)
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "fiu":
        raise StageError(
            f"'{what}' must be an array (n, 3) of float64 coordinates in meters",
            found=f"shape {array.shape}, dtype {array.dtype}",
        )
    # Two reductions and no copy; NaN comes through both.
    largest = float(np.maximum(float(array.max()), -float(array.min()))) if array.size else 0.0
    if not largest <= LIMIT:  # NaN too
        bad = ~(np.abs(array) <= LIMIT).all(axis=1)
        raise StageError(
            f"'{what}' has coordinates that are NaN, infinite or beyond {LIMIT:g} m",
            found=f"{np.count_nonzero(bad)} of {len(array)} points, the first at index "
            f"{int(np.argmax(bad))}",
            cure="Remove them first, e.g. with filters.range or filters.expression",
        )
    if array.dtype.itemsize < 8 and array.dtype.kind == "f" and largest > FLOAT32_LIMIT:
        raise StageError(
            f"'{what}' is {array.dtype}, too coarse for coordinates up to {largest:.0f} m",
            cure="Read the coordinates as float64",
        )
    return array.astype(np.float64, copy=False)


def build_grid(xyz: np.ndarray, cell: float) -> CellGrid:
    """Sort a checked (n, 3) float64 cloud into a :class:`CellGrid`.

    Memory while it runs: about 52 bytes a point; the result holds 28 (36 from 2^31 points on).
    """
    n = len(xyz)
    key, _ = compact_keys(xyz[:, :2], cell)
    order = _order(xyz, key, cell)
    starts = np.flatnonzero(begins_run(key[order]))
    del key
    ix, iy = (cell_numbers(xyz[order[starts], axis], cell) for axis in range(2))
    ordered = np.empty((3, n))
    for k in range(3):
        np.take(xyz[:, k], order, out=ordered[k], mode="clip")  # "raise" would make a copy
    ordered += 0.0  # -0.0 becomes 0.0: equal coordinates are equal bits
    cell_start = np.concatenate((starts, [n])).astype(np.int64)
    rows = np.flatnonzero(begins_run(iy))
    return CellGrid(
        cell=float(cell),
        order=order,
        xyz=ordered,
        x=ordered[0],
        y=ordered[1],
        z=ordered[2],
        cell_ix=ix,
        cell_start=cell_start,
        row_iy=iy[rows],
        row_start=np.concatenate((rows, [len(ix)])).astype(np.int64),
    )


def _order(xyz: np.ndarray, key: np.ndarray, cell: float) -> np.ndarray:
    """Return the order of points by cell and coordinates.

    They are sorted by one number of cell and x first, of which few are equal.
    """
    bits = min(62 - int(key.max(initial=0)).bit_length(), FINE_BITS)
    x = xyz[:, 0] * (1.0 / cell)
    fine = (key << bits) + np.floor((x - np.floor(x)) * 2.0**bits).astype(np.int64)
    order = order_by_key(fine)
    fine = fine[order]
    begins = begins_run(fine)
    tied = np.flatnonzero(~(begins & np.append(begins[1:], True)))
    again = order[tied]
    order[tied] = again[np.lexsort((xyz[again, 2], xyz[again, 1], xyz[again, 0], fine[tied]))]
    return order
