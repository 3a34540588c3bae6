"""Circular batches [WM19]: the points nearest to grid points, so spaced that every point is in several.

The grid is anchored to absolute coordinates and its spacing is fixed when a model is trained, so a tile sees the
same circles as the whole cloud. What a circle holds follows from the coordinates, never from the points' order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import OptionError

#: Circles each point is in, on average, in a cloud of even density.
COVERAGE = 4.0
#: Farthest point a circle takes, in spacings. A circle of full size in even density has 1.13.
REACH = 1.5
#: How often a cell may be halved.
DEEPEST = 24


def density(clouds: Sequence[npt.NDArray[np.float64]]) -> float:
    """Points per square meter of the ground that is covered, over several clouds."""
    points, area = 0, 0.0
    for xyz in clouds:
        if not len(xyz):
            continue
        span = np.maximum(np.ptp(xyz[:, :2], axis=0), 1.0)
        side = max(math.sqrt(16.0 * span[0] * span[1] / len(xyz)), 0.1)  # some 16 points a cell
        cells = np.floor(xyz[:, :2] / side).astype(np.int64)
        cells -= cells.min(axis=0)
        area += len(np.unique(cells[:, 1] * (int(cells[:, 0].max()) + 1) + cells[:, 0])) * side * side
        points += len(xyz)
    return points / area if area else 1.0


def spacing_for(points: int, per_square_meter: float) -> float:
    """Spacing in meters at which circles of `points` points cover each point :data:`COVERAGE` times.

    A circle covers points / density square meters and each grid point stands for spacing^2 of them.
    """
    return max(round(math.sqrt(points / (COVERAGE * per_square_meter)), 2), 0.05)


def halo_m(spacing: float) -> float:
    """Meters around a tile that its results depend on.

    A point's circles have their grid points within ``REACH`` spacings of it and take points as far again; which
    grid points there are depends on the cell they were halved from, whose center is up to half a cell's diagonal
    away, and on what lies within reach of that.
    """
    return (2.0 * REACH + math.sqrt(0.5)) * spacing


class Circles:
    """The circular batches of a cloud.

    A cell of the grid is quartered, and its grid point replaced by four, while it holds more than half a batch, or
    while its own circle does not hold all of its points: so each point is in at least one circle, always.

    Parameters
    ----------
    xyz : (n, 3) float64
        Coordinates in meters.
    points : int
        Points of a batch; a circle in sparse surroundings has fewer.
    spacing : float
        Of the grid, meters.
    inputs : (n, c) array, optional
        Other values of the points, to tell points at the same place apart.

    Attributes
    ----------
    centers : (m, 2) float64
        Grid points, in an order that follows from the coordinates.
    sizes : (m,) int64
        Points a circle may hold: `points`, but for more than `points` at one and the same place.
    """

    def __init__(
        self,
        xyz: npt.NDArray[np.float64],
        points: int,
        spacing: float,
        inputs: npt.NDArray[Any] | None = None,
    ) -> None:
        if not spacing > 0.0:
            raise OptionError("the spacing of batches must be more than 0 m", found=spacing)
        self.points, self.spacing, self.reach = int(points), float(spacing), REACH * float(spacing)
        keys = [xyz[:, 2], xyz[:, 1], xyz[:, 0]]
        if inputs is not None:
            keys = [*(inputs[:, k] for k in range(inputs.shape[1])), *keys]
        canonical = np.lexsort(keys)
        self._side = self.spacing / 2.0
        cell = np.floor(xyz[canonical, :2] / self._side).astype(np.int64)
        self._first = cell.min(axis=0) if len(cell) else np.zeros(2, np.int64)
        self._last = cell.max(axis=0) if len(cell) else np.zeros(2, np.int64)
        if np.any(self._last - self._first > 2**31):
            raise OptionError("the cloud is too wide for the batches' spacing", found=f"{spacing:g} m")
        self._width = int(self._last[0] - self._first[0]) + 1
        key = (cell[:, 1] - self._first[1]) * self._width + (cell[:, 0] - self._first[0])
        by_cell = np.argsort(key, kind="stable")
        self._key = key[by_cell]
        self._rank = by_cell  # place in the canonical order
        self._row = canonical[by_cell]  # row of the cloud
        self._xy = np.ascontiguousarray(xyz[self._row, :2])
        self.centers, self.sizes = self._place()

    def __len__(self) -> int:
        return len(self.centers)

    # ---- what is near --------------------------------------------------------------------------------------

    def _near(self, x: float, y: float, radius: float) -> npt.NDArray[np.int64]:
        """Places (in cell order) of the points in the cells that a circle touches."""
        first = np.floor(np.array([x - radius, y - radius]) / self._side).astype(np.int64) - self._first
        last = np.floor(np.array([x + radius, y + radius]) / self._side).astype(np.int64) - self._first
        x0, x1 = max(int(first[0]), 0), min(int(last[0]), self._width - 1)
        y0, y1 = max(int(first[1]), 0), min(int(last[1]), int(self._last[1] - self._first[1]))
        if x0 > x1 or y0 > y1:
            return np.zeros(0, np.int64)
        rows = np.arange(y0, y1 + 1) * self._width
        lo = np.searchsorted(self._key, rows + x0)
        hi = np.searchsorted(self._key, rows + x1, side="right")
        return np.concatenate([np.arange(a, b) for a, b in zip(lo, hi, strict=True)])

    def _distance2(self, at: npt.NDArray[np.int64], x: float, y: float) -> npt.NDArray[np.float64]:
        dx, dy = self._xy[at, 0] - x, self._xy[at, 1] - y
        return dx * dx + dy * dy

    def around(self, x: float, y: float, size: int | None = None) -> npt.NDArray[np.int64]:
        """Rows of the points nearest to a place in plan, at most `size` and none beyond ``reach``.

        In the canonical order. Of points equally far the first in that order are taken.
        """
        size = self.points if size is None else size
        at = self._near(x, y, self.reach)
        d2 = self._distance2(at, x, y)
        inside = d2 <= self.reach * self.reach
        at, d2 = at[inside], d2[inside]
        if len(at) > size:
            limit = np.partition(d2, size - 1)[size - 1]
            sure = at[d2 < limit]
            equal = at[d2 == limit]
            equal = equal[np.argsort(self._rank[equal])][: size - len(sure)]
            at = np.concatenate([sure, equal])
        return self._row[at[np.argsort(self._rank[at])]]

    def members(self, number: int) -> npt.NDArray[np.int64]:
        """Rows of the points of a circle, in the canonical order."""
        x, y = self.centers[number]
        return self.around(float(x), float(y), int(self.sizes[number]))

    # ---- where circles are ---------------------------------------------------------------------------------

    def _place(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
        """Centers and sizes."""
        found: list[tuple[float, float, int]] = []
        waiting = list(_parts(np.arange(len(self._xy)), self._xy, self.spacing))
        waiting = [(0, *part) for part in reversed(waiting)]
        while waiting:
            level, cell, at = waiting.pop()
            side = self.spacing / 2.0**level
            x, y = (cell[0] + 0.5) * side, (cell[1] + 0.5) * side
            size = self._fits(at, x, y, level)
            if size == 0:
                parts = list(_parts(at, self._xy, side / 2.0))
                waiting.extend((level + 1, *part) for part in reversed(parts))
                continue
            found.append((x, y, size))
        table = np.array(found, dtype=np.float64).reshape(-1, 3)
        return table[:, :2].copy(), table[:, 2].astype(np.int64)

    def _fits(self, at: npt.NDArray[np.int64], x: float, y: float, level: int) -> int:
        """The size of the cell's circle, or 0 where the cell must be quartered."""
        if level < DEEPEST and len(at) > max(self.points // 2, 1):
            return 0
        far2 = float(self._distance2(at, x, y).max())
        near = self._near(x, y, math.sqrt(far2))
        within = int(np.count_nonzero(self._distance2(near, x, y) <= far2))
        if within <= self.points:
            return self.points
        return 0 if level < DEEPEST else within

    def needed(self, rows: npt.NDArray[np.int64] | None) -> npt.NDArray[np.int64]:
        """Numbers of the circles that can hold any of these rows; all for None."""
        if rows is None:
            return np.arange(len(self))
        wanted = np.zeros(len(self._xy), bool)
        wanted[rows] = True
        wanted = wanted[self._row]
        keep = []
        for number, (x, y) in enumerate(self.centers):
            at = self._near(float(x), float(y), self.reach)
            at = at[wanted[at]]
            if len(at) and float(self._distance2(at, float(x), float(y)).min()) <= self.reach * self.reach:
                keep.append(number)
        return np.array(keep, np.int64)


def _parts(at: npt.NDArray[np.int64], xy: npt.NDArray[np.float64], side: float):
    """The occupied cells of some points: ((ix, iy), places), ordered by iy, then ix."""
    if not len(at):
        return
    cell = np.floor(xy[at] / side).astype(np.int64)
    order = np.lexsort((cell[:, 0], cell[:, 1]))
    cell, at = cell[order], at[order]
    starts = np.flatnonzero(np.concatenate(([True], (cell[1:] != cell[:-1]).any(axis=1))))
    for lo, hi in zip(starts, [*starts[1:], len(at)], strict=True):
        yield (int(cell[lo, 0]), int(cell[lo, 1])), at[lo:hi]
