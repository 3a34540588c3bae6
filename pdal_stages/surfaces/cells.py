"""Cells of a survey: the lowest ground points, and the highest points, wherever it is cut.

Coordinates are whole thousandths of their unit, so that files with other offsets, and tiles, have
the same ones. What is kept of a cell does not depend on the order of points.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base import checks
from ..base.asprs import NOISE, TERRAIN, WIRES_AND_TOWERS
from ..base.grid import GridWindow, begins_run, cell_numbers
from ..tiling.inputs import LonePoints
from ..tiling.options import LARGEST_TILE, TILE_POINT, Density, TileGrid
from ..tiling.tile_records import Part, ReducedTile
from .triangulation import NEAR, SPLIT

Integers = NDArray[np.int64]
#: Steps of coordinates in their unit: what surveys store is seldom finer.
STEPS = 1000
#: Height of a cell without points, in steps: below all heights, and no sum overflows.
EMPTY = np.iinfo(np.int64).min // 4
#: Ground points that are kept along a side of a cell.
PER_SIDE = 2
#: Largest side of which one is kept, meters: the RMSE at held-out ground of four clouds rose by at
#: most 0.026 m over that of all points, with one of each meter by 0.043
#: (benchmarks/terrain_points.py).
LARGEST_SIDE = 0.5
#: Most cells along a tile: in those without points time and memory are spent, too (not tuned).
MOST_ALONG = 2048
#: Bytes of a cell of the rasters, of measured peaks ...
_CELL_BYTES = 150
#: ... and of a ground point that is triangulated.
_GROUND_BYTES = 1200


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


def cells_at(points: Integers, side: float) -> Integers:
    """Return columns and rows (2, n) of the cells of points (n, 2 or more), all in steps."""
    return cell_numbers(points[:, :2].T.astype(float), side)


class CellRule(NamedTuple):
    """A rule by which the values of a cell become one; a cell without any holds `empty`."""

    merge: np.ufunc
    empty: int

    def rasterize(self, name: str, cells: Integers, value: Integers) -> dict[str, NDArray]:
        """Return a raster (rows, columns) int64 by its name, and its ``*_window``.

        `cells` (2, n) are columns and rows of values (n,).
        """
        window = GridWindow.enclosing(*cells)
        raster = np.full(window.width * window.height, self.empty)
        self.merge.at(raster, window.flat_index(*cells), value)
        return {name: raster.reshape(window.shape), f"{name}_window": np.array(window)}

    def join(
        self, name: str, parts: Iterable[Mapping[str, NDArray]], window: GridWindow
    ) -> Integers:
        """Return a raster of a window, of those (:meth:`rasterize`) of several parts."""
        out = np.full(window.shape, self.empty)
        for arrays in parts:
            part = GridWindow(*arrays[f"{name}_window"].tolist())
            both = window.intersect(part)
            place = out[both.slices_in(window)]
            self.merge(place, arrays[name][both.slices_in(part)], out=place)
        return out


HIGHEST = CellRule(np.maximum, EMPTY)


def usable(part: Mapping[str, NDArray], lone: LonePoints) -> NDArray[np.bool_]:
    """Return which points (n,) count: not noise, not withheld, not alone."""
    kept = ~np.isin(part["Classification"], NOISE) & (part["Withheld"] == 0)
    return kept & ~lone.among(part["X"], part["Y"])


@dataclass
class TileFigures(ReducedTile):
    """Figures of a tile that was reduced to cells."""

    window: Sequence[int]  #: of the cells with points, as :class:`GridWindow` has it
    ground: int  #: number of ground points


def reduce_points(
    parts: Sequence[Part], lone: LonePoints, options: SurfaceOptions, unit: float
) -> tuple[dict[str, NDArray], TileFigures]:
    """Reduce the usable points of a tile (files and their dimensions) to cells.

    `unit` is that of the coordinates, in meters.

    Returns
    -------
    arrays : dict
        ``ground`` (k, 3) int64: points in steps; ``top`` and ``solid``, rasters as of
        :meth:`CellRule.rasterize`: twice the greatest height in steps, plus 1 where that is not
        ground; of ``solid`` without wires and towers.
    figures : TileFigures
    """
    columns = [np.empty((0, 4), np.int64)]
    for _, part in parts:
        axes = [steps(part[name]) for name in "XYZ"]
        columns.append(np.column_stack([*axes, part["Classification"]])[usable(part, lone)])
    points = np.concatenate(columns)
    xyz, codes = points[:, :3], points[:, 3]
    is_ground = np.isin(codes, TERRAIN)
    ground = lowest(xyz[is_ground], options.ground_step(unit))
    cells, value = cells_at(xyz, options.step), 2 * xyz[:, 2] + ~is_ground
    low = ~np.isin(codes, WIRES_AND_TOWERS)
    arrays = HIGHEST.rasterize("top", cells, value)
    arrays |= HIGHEST.rasterize("solid", cells[:, low], value[low])
    figures = TileFigures(arrays["top_window"].tolist(), len(ground))
    return {"ground": ground, **arrays}, figures


def lowest(xyz: Integers, side: float) -> Integers:
    """Return the lowest of points (n, 3) in each cell of a side, row by row, then by x and y."""
    column, row = cells_at(xyz, side)
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

    @classmethod
    def with_cells(cls, options: SurfaceOptions, density: Density, unit: float) -> CellDensity:
        """Return a density of points with that of cells."""
        return cls(**vars(density), options=options, unit=unit)

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
