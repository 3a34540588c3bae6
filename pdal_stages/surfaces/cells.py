"""Cells of a survey: the lowest ground points, and the highest points, wherever it is cut.

Coordinates are whole thousandths of their unit, so that files with other offsets, and tiles, have
the same ones. What is kept of a cell does not depend on the order of points.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..base import checks
from ..base.asprs import NOISE, TERRAIN, WIRES_AND_TOWERS
from ..base.grid import GridWindow, begins_run, cell_numbers
from ..base.json_types import JsonObject
from ..tiling.inputs import LonePoints
from ..tiling.options import LARGEST_TILE, TILE_POINT, Density, TileGrid
from ..tiling.tile_records import Part
from .triangulation import NEAR, SPLIT

Integers = NDArray[np.int64]
#: Steps of coordinates in their unit: what surveys store is seldom finer.
STEPS = 1000
#: Height of a cell without points, in steps: below all heights, and no sum overflows.
EMPTY = np.iinfo(np.int64).min // 4
#: Ground points that are kept along a side of a cell, and the largest side of which one is kept,
#: meters: the RMSE at held-out ground of four clouds rose by at most 0.026 m over that of all
#: points, with one of each meter by 0.043 (benchmarks/terrain_points.py).
PER_SIDE, LARGEST_SIDE = 2, 0.5
#: Most cells along a tile: in those without points time and memory are spent, too (not tuned).
MOST_ALONG = 2048
#: Bytes of a cell of the rasters, and of a ground point that is triangulated, of measured peaks.
_CELL_BYTES, _GROUND_BYTES = 150, 1200


@dataclass(frozen=True)
class SurfaceOptions:
    """Options of terrain, surface and canopy."""

    resolution: float = 1.0  #: side of a cell, in the unit of the coordinates
    fill: float = 10.0  #: meters over which cells without points are interpolated
    max_radius: float = 100.0  #: meters: largest circle of a triangle of the terrain

    def __post_init__(self) -> None:
        """Check the options."""
        size = checks.number("--resolution", self.resolution, 0.01, 10_000)
        object.__setattr__(self, "resolution", size)
        checks.number("--fill", self.fill, 0, 1000, unit="meters")
        checks.number("--max-radius", self.max_radius, 1, LARGEST_TILE, unit="meters")

    @property
    def step(self) -> float:
        """Return the side of a cell in steps."""
        return self.resolution * STEPS

    def ground_step(self, unit: float) -> float:
        """Return the side, in steps, of a cell of which the lowest ground point is kept.

        `unit` is that of the coordinates, in meters.
        """
        return min(self.resolution / PER_SIDE, LARGEST_SIDE / unit) * STEPS


def steps(coordinate: NDArray) -> Integers:
    """Return coordinates as whole steps, (n,) int64."""
    return np.rint(np.asarray(coordinate) * STEPS).astype(np.int64)


def usable(part: Mapping[str, NDArray], lone: LonePoints) -> NDArray[np.bool_]:
    """Return which points (n,) count: not noise, not withheld, not alone."""
    kept = ~np.isin(part["Classification"], NOISE) & (part["Withheld"] == 0)
    return kept & ~lone.among(part["X"], part["Y"])


def reduce_points(
    parts: Sequence[Part], lone: LonePoints, options: SurfaceOptions, unit: float
) -> tuple[dict[str, NDArray], JsonObject]:
    """Reduce the usable points of a tile (files and their dimensions) to cells.

    `unit` is that of the coordinates, in meters.

    Returns
    -------
    arrays : dict
        ``ground`` (k, 3) int64: points in steps; ``window`` (4,): a :class:`GridWindow`; ``top``
        and ``solid`` (rows, columns) int64: twice the greatest height in steps, plus 1 where that
        is not ground; of ``solid`` without wires and towers; or :data:`EMPTY`.
    figures : dict
        ``window``, and ``ground``: the number of ground points.
    """
    columns = []
    for _, part in parts:
        codes, kept = part["Classification"], usable(part, lone)
        xyz = np.column_stack([steps(part[name][kept]) for name in "XYZ"])
        columns.append((xyz.reshape(-1, 3), codes[kept]))
    xyz = np.concatenate([np.empty((0, 3), np.int64), *(points for points, _ in columns)])
    codes = np.concatenate([np.empty(0, np.uint8), *(codes for _, codes in columns)])
    if not len(xyz):
        nothing = np.empty((0, 0), np.int64)
        arrays = {"ground": xyz, "window": np.zeros(4, np.int64), "top": nothing, "solid": nothing}
        return arrays, {"window": [0, 0, 0, 0], "ground": 0}
    is_ground = np.isin(codes, TERRAIN)
    ground = lowest(xyz[is_ground], options.ground_step(unit))
    column, row = (cell_numbers(xyz[:, k].astype(float), options.step) for k in (0, 1))
    window = GridWindow.enclosing(column, row)
    cell, value = window.flat_index(column, row), 2 * xyz[:, 2] + ~is_ground
    top, solid = (np.full(window.width * window.height, EMPTY) for _ in range(2))
    np.maximum.at(top, cell, value)
    low = ~np.isin(codes, WIRES_AND_TOWERS)
    np.maximum.at(solid, cell[low], value[low])
    rasters = {"top": top.reshape(window.shape), "solid": solid.reshape(window.shape)}
    figures = {"window": list(window), "ground": len(ground)}
    return {"ground": ground, "window": np.array(window), **rasters}, figures


def lowest(xyz: Integers, side: float) -> Integers:
    """Return the lowest of points (n, 3) in each cell of a side, row by row, then by x and y."""
    column, row = (cell_numbers(xyz[:, k].astype(float), side) for k in (0, 1))
    if not len(xyz):
        return xyz
    window = GridWindow.enclosing(column, row)
    if window.width * window.height <= 8 * len(xyz):  # most points go without sorting
        floor, cell = np.full(window.width * window.height, -EMPTY), window.flat_index(column, row)
        np.minimum.at(floor, cell, xyz[:, 2])
        kept = xyz[:, 2] == floor[cell]
        xyz, column, row = xyz[kept], column[kept], row[kept]
    order = np.lexsort((*xyz.T[[1, 0, 2]], column, row))
    xyz, column, row = xyz[order], column[order], row[order]
    first = begins_run(column) | begins_run(row)
    xyz, row = xyz[first], row[first]
    return xyz[np.lexsort((xyz[:, 1], xyz[:, 0], row))]


@dataclass(frozen=True)
class CellDensity(Density):
    """The density of a survey that becomes cells: these need memory where points are few."""

    options: SurfaceOptions = SurfaceOptions()
    unit: float = 1.0  #: meters per unit of the coordinates

    def is_fair(self, side: float) -> bool:
        """Return whether tiles of this side have not too many points or cells."""
        return super().is_fair(side) and side <= MOST_ALONG * self.options.resolution

    def grid_around(self) -> TileGrid | None:
        """Return the grid of the smallest tiles of which one holds all inputs and is fair."""
        x0, y0, x1, y1 = self.box
        fair = max(x1 - x0, y1 - y0) <= MOST_ALONG * self.options.resolution
        return super().grid_around() if fair else None

    @property
    def alone(self) -> int:
        """Return the points that need as much memory as the only tile of a small survey."""
        x0, y0, x1, y1 = self.box
        return self._points((x1 - x0) * (y1 - y0), self.points)

    def read_by(self, side: float, halo_units: float) -> int:
        """Return the points that need as much memory as a tile of this side."""
        reach = 2 * self.options.max_radius / self.unit
        wide = side + 2 * NEAR * reach
        if wide - self.options.resolution < SPLIT * reach:
            wide = side + 2 * reach
        points = self._points(wide**2, min(self.points, self.each * wide**2))
        return max(super().read_by(side, 0.0), points)

    def _points(self, area: float, points: float) -> int:
        """Return the points that need as much memory as the cells of an area with points."""
        cells = area / self.options.resolution**2
        ground = min(points, area * (STEPS / self.options.ground_step(self.unit)) ** 2)
        return int((cells * _CELL_BYTES + ground * _GROUND_BYTES) / TILE_POINT)
