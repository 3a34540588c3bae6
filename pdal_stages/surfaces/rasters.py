"""Terrain, surface and canopy of a tile, from the cells of the tiles around it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ..base.errors import optional_import
from ..base.grid import GridWindow
from ..tiling.jobs import load_arrays, save_arrays
from ..tiling.options import Box, TileGrid, touching
from ..tiling.records import JobRecord
from ..tiling.tile_records import Tile, cells_in_tile
from .cells import EMPTY, HIGHEST, STEPS, Integers, SurfaceOptions, lowest
from .triangulation import heights_at

#: The rasters, and what they hold.
RASTERS = {
    "terrain": "Height of the ground",
    "surface": "Height of the highest point",
    "canopy": "Height above the ground of the highest point that is no wire or tower",
}
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class TileCells:
    """The rasters to which the tiles of a survey were reduced, by :func:`.cells.reduce_points`."""

    options: SurfaceOptions
    grid: TileGrid
    unit: float  #: meters per unit of the coordinates
    window: GridWindow  #: the cells of the survey
    files: Mapping[Tile, str]  #: the arrays of the tiles around one

    @property
    def reach(self) -> float:
        """Return how far around a tile ground points matter, in the unit of the coordinates."""
        return 2 * self.options.max_radius / self.unit

    @property
    def bounds(self) -> Box:
        """Return the box of all points, in steps."""
        x0, y0, wide, tall = (number * self.options.step for number in self.window)
        return x0, y0, x0 + wide, y0 + tall

    def near(self, box: Box) -> list[Tile]:
        """Return the tiles that share a point with a box, in steps."""
        west, south, east, north = (side / STEPS for side in box)
        boxes = [self.grid.box(tile, self.options.resolution) for tile in self.files]
        return [[*self.files][n] for n in touching(boxes, (west, south, east, north))]

    def ground(self, loaded: dict[Tile, Integers], box: Box) -> Integers:
        """Return the ground points (n, 3) in a box, in steps, as triangles need them.

        `loaded` keeps those of whole tiles for further calls.
        """
        side = self.options.ground_step(self.unit)
        parts = [np.empty((0, 3), np.int64)]
        for tile in self.near(box):
            if tile not in loaded:
                loaded[tile] = load_arrays(self.files[tile], ("ground",))["ground"]
            parts.append(_inside(loaded[tile], box, side))  # a cell that two tiles share is whole
        return _inside(lowest(np.concatenate(parts), side), box, 0.0)

    def highest(self, window: GridWindow) -> tuple[Integers, Integers]:
        """Return the arrays ``top`` and ``solid`` of a window of cells."""
        step = self.options.step
        low = window.left * step, window.bottom * step
        box = *low, low[0] + window.width * step, low[1] + window.height * step
        files = [self.files[tile] for tile in self.near(box)]

        def join(name: str) -> Integers:
            parts = (load_arrays(file, (name, f"{name}_window")) for file in files)
            return HIGHEST.join(name, parts, window)

        return join("top"), join("solid")


@dataclass
class RasterFigures(JobRecord):
    """Cells of a tile's rasters that have a height."""

    terrain: int
    surface: int
    canopy: int


def compute_tile(cells: TileCells, tile: Tile, target: str) -> RasterFigures:
    """Compute the rasters of a tile, save them, and return how many cells of each are known.

    The arrays are named as in :data:`RASTERS`, (rows, columns) float32 from the south with NaN for
    no height; ``window`` tells which cells they are.
    """
    options = cells.options
    window = cells_in_tile(cells.grid, tile, options.resolution).intersect(cells.window)
    arrays = {name: np.empty((0, 0)) for name in RASTERS}
    if window.width and window.height:
        terrain = _terrain(cells, window)
        reach = options.fill / cells.unit / options.resolution
        wide = window.padded(2 * math.ceil(reach) + 2)
        inner = window.slices_in(wide)
        highest, below_wires = cells.highest(wide)
        top = solid = fill(highest, terrain, inner, reach)
        if not np.array_equal(highest, below_wires):
            solid = fill(below_wires, terrain, inner, reach)
        canopy = np.maximum(solid - terrain, 0.0)  # NaN stays
        arrays = {"terrain": terrain, "surface": top, "canopy": canopy}
    rounded = {name: np.round(values, 3).astype(np.float32) for name, values in arrays.items()}
    save_arrays(target, {**rounded, "window": np.array(window)})
    return RasterFigures(**{n: int(np.isfinite(values).sum()) for n, values in rounded.items()})


def _terrain(cells: TileCells, window: GridWindow) -> Floats:
    """Return the heights of the terrain in a window of cells, NaN for none."""
    step = cells.options.step
    x = (window.left + np.arange(window.width, dtype=float) + 0.5) * step
    y = (window.bottom + np.arange(window.height, dtype=float) + 0.5) * step
    return heights_at((x, y), cells.reach * STEPS, cells.bounds, partial(cells.ground, {})) / STEPS


def _inside(points: Integers, box: Box, margin: float) -> Integers:
    """Return the points (n, 3) in a box with its edges, grown by a margin."""
    low, high = np.array(box[:2]) - margin, np.array(box[2:]) + margin
    return points[((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1)]


def fill(
    coded: Integers, terrain: Floats, inner: tuple[slice, slice], reach: float
) -> NDArray[np.float64]:
    """Return heights of cells, also of those without points between others; NaN for none.

    Parameters
    ----------
    coded : (rows, columns) int64
        Heights as of :func:`.cells.reduce_points`, with at least two `reach` around.
    terrain : (rows, columns) float64
        Of the inner cells: an empty one takes it where all neighbors with points are ground, and no
        height is below it.
    inner : pair of slice
        Which cells are returned.
    reach : float
        How far others are interpolated, in cells.
    """
    known = coded != EMPTY
    height = np.where(known, (coded >> 1) / STEPS, 0.0)
    beside_any, beside_other = (
        ndimage.maximum_filter(mask, 3, mode="constant")[inner]
        for mask in (known, known & (coded & 1 == 1))
    )
    out = np.where(known, height, np.nan)[inner]
    empty = np.isnan(out)
    level = empty & beside_any & ~beside_other & np.isfinite(terrain)
    out[level] = terrain[level]
    # Morphological closing with a disk: cells between others, not those beyond the last.
    between = (_distance_to(_distance_to(known) > reach) > reach)[inner] & empty & ~level
    if between.any():
        gdal_fill = optional_import("rasterio.fill", "raster", "a surface model")
        all_heights = gdal_fill.fillnodata(height.astype(np.float32), known, reach)
        out[between] = all_heights[inner][between]
    return np.where(np.isnan(out), np.nan, np.fmax(out, terrain))


def _distance_to(cells: NDArray[np.bool_]) -> Floats:
    """Return the distance of every cell to the nearest of some cells, infinite without any."""
    if not cells.any():
        return np.full(cells.shape, np.inf)
    return ndimage.distance_transform_edt(~cells)
