"""Circular batches [WM19 3]: the points nearest to grid points, four for each on average.

The grid is anchored to absolute coordinates and its spacing is fixed when a model is trained, so a
tile sees the same batches as the whole cloud. What a batch holds follows from the coordinates,
never from the points' order.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import OptionError

#: Batches each point is in, on average, in a cloud of even density.
COVERAGE = 4.0
#: Farthest point a batch takes, in spacings. A batch of full size in even density has 1.13.
REACH = 1.5
#: How often a cell may be halved.
DEEPEST = 24


def spacing_for(points: int, per_square_meter: float) -> float:
    """Return the spacing in meters at which batches cover each point :data:`COVERAGE` times.

    A batch covers points / density square meters and each grid point stands for spacing^2 of them.
    """
    return max(round(math.sqrt(points / (COVERAGE * per_square_meter)), 2), 0.05)


def halo_m(spacing: float) -> float:
    """Return the meters around a tile that its results depend on.

    A point's batches have their grid points within ``REACH`` spacings of it and take points as far
    again; which grid points there are depends on the cell they were halved from, whose center is up
    to half a cell's diagonal away, and on what lies within reach of that.
    """
    return (2.0 * REACH + math.sqrt(0.5)) * spacing


class Batches:
    """The circular batches of a cloud.

    A cell of the grid is quartered, and its grid point replaced by four, while it holds more than
    half a batch, or while its own batch does not hold all of its points: so each point is in at
    least one batch, always.

    Parameters
    ----------
    xyz : (n, 3) float64
        Coordinates in meters.
    points : int
        Points of a batch; a batch in sparse surroundings has fewer.
    spacing : float
        Of the grid, meters.
    inputs : (n, c) array, optional
        Other values of the points, to tell points at the same place apart.

    Attributes
    ----------
    centers : (m, 2) float64
        Grid points, in an order that follows from the coordinates.
    sizes : (m,) int64
        Points a batch may hold: `points`, but for more than `points` at one and the same place.
    """

    def __init__(
        self,
        xyz: npt.NDArray[np.float64],
        points: int,
        spacing: float,
        inputs: npt.NDArray[Any] | None = None,
    ) -> None:
        from scipy.spatial import cKDTree

        if not spacing > 0.0:
            raise OptionError("the spacing of batches must be more than 0 m", found=spacing)
        self.points, self.spacing, self.reach = int(points), float(spacing), REACH * float(spacing)
        more = () if inputs is None else inputs.T
        self._row = np.lexsort([*more, xyz[:, 2], xyz[:, 1], xyz[:, 0]])  # the canonical order
        self._xy = np.ascontiguousarray(xyz[self._row, :2])
        self._tree = cKDTree(self._xy)
        self.centers, self.sizes = self._place()

    def __len__(self) -> int:
        """Return the number of batches."""
        return len(self.centers)

    def nearest_points(self, x: float, y: float, size: int | None = None) -> npt.NDArray[np.int64]:
        """Return the rows of the points nearest to a place in plan, within ``reach``.

        In the canonical order. Of points equally far the first in that order are taken.
        """
        size = self.points if size is None else size
        radius = self.reach * (1.0 + 1e-9)  # a few beyond too
        at = np.array(self._tree.query_ball_point((x, y), radius, return_sorted=True), np.int64)
        d2 = ((self._xy[at] - (x, y)) ** 2).sum(axis=1)
        at, d2 = at[d2 <= self.reach**2], d2[d2 <= self.reach**2]
        if len(at) > size:
            limit = np.partition(d2, size - 1)[size - 1]
            nearest = d2 < limit
            nearest[np.flatnonzero(d2 == limit)[: size - np.count_nonzero(nearest)]] = True
            at = at[nearest]
        return self._row[at]

    def members(self, number: int) -> npt.NDArray[np.int64]:
        """Return the rows of the points of a batch, in the canonical order."""
        x, y = self.centers[number]
        return self.nearest_points(float(x), float(y), int(self.sizes[number]))

    def holding(self, rows: npt.NDArray[np.int64] | None) -> npt.NDArray[np.int64]:
        """Return the numbers of the batches that can hold any of these rows; all for None."""
        from scipy.spatial import cKDTree

        if rows is None or not len(rows) or not len(self):
            return np.arange(len(self) if rows is None else 0)
        wanted = np.zeros(len(self._xy), bool)
        wanted[rows] = True
        distance, _ = cKDTree(self._xy[wanted[self._row]]).query(self.centers)
        return np.flatnonzero(distance <= self.reach * (1.0 + 1e-9))

    def _place(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
        """Return the grid points (m, 2) of the batches and the most points (m,) of each."""
        placed: list[tuple[float, float, int]] = []
        waiting = [(0, *part) for part in _parts(np.arange(len(self._xy)), self._xy, self.spacing)][
            ::-1
        ]
        while waiting:
            level, cell, at = waiting.pop()
            side = self.spacing / 2.0**level
            x, y = (cell + 0.5) * side
            if size := self._fits(at, x, y, level):
                placed.append((x, y, size))
            else:
                waiting += [(level + 1, *part) for part in _parts(at, self._xy, side / 2.0)][::-1]
        table = np.array(placed, dtype=np.float64).reshape(-1, 3)
        return table[:, :2].copy(), table[:, 2].astype(np.int64)

    def _fits(self, at: npt.NDArray[np.int64], x: float, y: float, level: int) -> int:
        """Return the size of the cell's batch, or 0 where the cell must be quartered."""
        if level < DEEPEST and len(at) > max(self.points // 2, 1):
            return 0
        far2 = float(((self._xy[at] - (x, y)) ** 2).sum(axis=1).max())
        radius = math.sqrt(far2) * (1.0 + 1e-9)
        count = int(self._tree.query_ball_point((x, y), radius, return_length=True))
        if count <= self.points:
            return self.points
        return 0 if level < DEEPEST else count


def _parts(at: npt.NDArray[np.int64], xy: npt.NDArray[np.float64], side: float):
    """Return the occupied cells of some points and their places, ordered by row, then column."""
    cell = np.floor(xy[at] / side)
    order = np.lexsort(cell.T)
    cell, at = cell[order], at[order]
    starts = np.flatnonzero((cell[1:] != cell[:-1]).any(axis=1)) + 1
    return list(zip(cell[[0, *starts]], np.split(at, starts), strict=True)) if len(at) else []
