"""Points in cells of anchored grids: the lowest ones, vertical layers, sums around cells."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..base.errors import StageError
from ..base.grid import begins_run

#: What a raster has where nothing was measured.
HOLE = np.float32(np.inf)
#: Heights beyond this, in meters, are no terrain, and too much for the sums.
HIGHEST = 1e6
#: Least distance of the vertical layers of a cell, in meters; not tuned.
LAYER_GAP_M = 1.0


def columns(x: ArrayLike, y: ArrayLike | None, z: ArrayLike | None) -> list[NDArray[np.float64]]:
    """Return three arrays of one length, from three or one (n, 3); StageError for others."""
    three: Any = np.asarray(x).T if y is None and z is None else (x, y, z)
    axes = [np.asarray(axis, np.float64, order="C") for axis in three]
    if len(axes) != 3 or axes[0].ndim != 1 or len({axis.shape for axis in axes}) > 1:
        raise StageError(
            "points must be an array of shape (n, 3), or x, y and z of one length",
            found=f"{len(axes)} columns of shape {', '.join(str(a.shape) for a in axes[:3])}",
        )
    return axes


def usable(*axes: NDArray[np.float64], mask: ArrayLike | None = None) -> NDArray[np.bool_]:
    """Return which points (n,) are finite and in the mask, if any; StageError for another shape."""
    use = np.logical_and.reduce([np.isfinite(axis) for axis in axes])
    if mask is None:
        return use
    kept = np.asarray(mask, bool)
    if kept.shape != use.shape:
        raise StageError(
            "'mask' must have one value per point", found=f"{kept.shape}, {len(use):,} points"
        )
    return use & kept


def lowest_points(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    z: NDArray[np.float64],
    cell: NDArray[np.int64],
    count: int,
) -> NDArray[np.int64]:
    """Return the indices of the lowest points of `count` cells; -1 where a cell has none.

    `cell` (n,) has the numbers of the points' cells.

    Of points of one height the first by x, then y, is taken, so that order does not matter.
    """
    lowest, first = np.full(count, np.inf), np.full(count, -1)
    np.minimum.at(lowest, cell, z)
    low = np.flatnonzero(z == lowest[cell])
    first[cell[low]] = low
    tied = low[np.bincount(cell[low])[cell[low]] > 1]
    tied = tied[np.lexsort((y[tied], x[tied]))[::-1]]
    first[cell[tied]] = tied  # the last of a cell stands
    return first


def levels(
    z: NDArray[np.float64], cell: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Order points (n,) by cell and height: return the order, and which begin a vertical layer.

    Cells are numbered from 0 on, nearly without gaps.

    A cell's points are parted where a gap is wide: the ground and the deck over it, a roof and what
    it stands on. The lowest points of levels are levels again, each by itself, so they stand for
    all points of places far away.
    """
    rank = np.empty(len(z), np.int64)
    rank[np.argsort(z)] = np.arange(len(z))
    order = np.argsort(cell * len(z) + rank)
    return order, begins_run(cell[order]) | (np.diff(z[order], prepend=-np.inf) > LAYER_GAP_M)
