"""Points in the cells of the ground filter: the lowest of each cell, the mean of its ground."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.grid import GridWindow, cell_numbers
from ..base.jit import njit
from .cells import HOLE, lowest_points
from .surface import GroundRaster

#: Sums of coordinates are whole numbers of this part of a meter, so that order does not matter.
_PARTS = 2.0**20
#: Which cells (h, w) hold ground points, and their mean places (h, w, 3), as
#: :attr:`.surface.GroundRaster.place`.
CellMeans = tuple[NDArray[np.bool_], NDArray[np.float64]]


class GroundPoints(NamedTuple):
    """Points with finite coordinates in meters (n,) each, and the cells they fall in.

    A NamedTuple, as kernels read it.
    """

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    z: NDArray[np.float64]
    use: NDArray[np.bool_]  #: whether they may be ground
    column: NDArray[np.int64]
    row: NDArray[np.int64]

    @classmethod
    def in_cells(cls, x, y, z, use, cell: float) -> GroundPoints:
        """Return points with the cells of a grid that they fall in."""
        return cls(x, y, z, use, cell_numbers(x, cell), cell_numbers(y, cell))

    def take(self, rows: NDArray | slice) -> GroundPoints:
        """Return some of the points."""
        return GroundPoints._make(values[rows] for values in self)


def minimum_grid(points: GroundPoints, window: GridWindow, cell: float) -> GroundRaster:
    """Return the raster of the lowest points of the cells of a window that may be ground.

    All of them are ground, until later steps find objects. `cell` is the side of a cell in meters.
    """
    use = points.use & window.contains(points.column, points.row)
    # A slice makes no copy of all points.
    usable: slice | NDArray[np.int64] = slice(None) if use.all() else np.flatnonzero(use)
    x, y, z, _, column, row = points.take(usable)
    inside = window.flat_index(column, row)
    low = lowest_points(x, y, z, inside, window.width * window.height).reshape(window.shape)
    ground = low >= 0
    rows = low[ground]
    lowest, place = np.full(window.shape, HOLE), np.zeros((*window.shape, 3))
    lowest[ground] = z[rows]
    place[ground, 0] = x[rows] / cell - column[rows] - 0.5
    place[ground, 1] = y[rows] / cell - row[rows] - 0.5
    place[ground, 2] = z[rows]
    return GroundRaster(window, lowest, place, ground, lowest, {})


@njit
def _add_ground(points, is_ground, cell, corner, count, place):
    """Add points that are ground to their cells: number (h, w) and places (h, w, 3).

    Places are whole numbers, so that order does not matter.

    `points` are :class:`GroundPoints`; `corner` is the first column and row of the raster. Points
    outside the raster are passed over.
    """
    left, bottom = corner
    h, w = count.shape
    for p in range(len(points.x)):
        column, row = points.column[p], points.row[p]
        j, i = row - bottom, column - left
        if is_ground[p] and 0 <= j < h and 0 <= i < w:
            count[j, i] += 1
            place[j, i, 0] += np.rint((points.x[p] / cell - column - 0.5) * _PARTS)
            place[j, i, 1] += np.rint((points.y[p] / cell - row - 0.5) * _PARTS)
            place[j, i, 2] += np.rint(points.z[p] * _PARTS)


def ground_means(
    parts: Iterable[tuple[GroundPoints, NDArray[np.bool_]]], cell: float, window: GridWindow
) -> CellMeans:
    """Return which cells of a window hold ground, and its mean places.

    Parts are points, and which of them are ground.
    """
    count, place = np.zeros(window.shape, np.int32), np.zeros((*window.shape, 3))
    for points, is_ground in parts:
        _add_ground(points, is_ground, cell, window[:2], count, place)
    held = count > 0
    place[held] /= (_PARTS * count[held])[:, None]
    return held, place
