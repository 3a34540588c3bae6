"""Which cells of a minimum grid are ground: of all the points there are, or of a block of cells and
what lies around it.

All of a progressive morphological filter that looks far away is done here, on a raster; see
:mod:`.heights`. In tiles it is done once for each block of a grid of blocks, out of the lowest
points of cells, and tiles put the blocks together.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base import checks
from ..base.errors import OptionError
from ..base.grid import GridWindow, cell_numbers
from ..base.jit import njit
from .cells import HOLE, lowest_points
from .low_outliers import find_low_outliers, outlier_reach
from .openings import FILL_RINGS, objects_of, opening_radius
from .surface import GroundRaster, from_parents, planes_of_blocks
from .surface import reach as planes_reach

#: Side in meters of the coarsest blocks of the surface from which points are told to be ground or
#: not.
NEAR = 16.0
#: The same of the surface that heights are measured from: it spans the holes under large buildings.
FAR = 32.0
#: Largest radius of a window in cells: beyond it memory and halo of a tile become too large.
_MOST_CELLS = 300
#: How often ground that openings took from ridges and dams is regained from the surface through the
#: rest. Without it the mean error of the ISPRS samples is 0.5 points higher
#: (`benchmarks/ablation.py`).
ROUNDS = 3


@dataclass(frozen=True)
class FilterOptions:
    """Of :func:`.heights.filtered_ground`; lengths in meters. Wrong ones raise an
    :class:`OptionError`."""

    cell: float = 1.0
    slope: float = 0.1
    window: float = 18.0
    threshold: float = 0.5
    scalar: float = 1.25
    openings: Sequence[float] = ()

    def __post_init__(self) -> None:
        for name, value in (
            ("cell", self.cell),
            ("window", self.window),
            *(("openings", size) for size in self.openings),
        ):
            checks.number(f"'{name}'", value, 0, above=True)
            if name != "cell" and value > _MOST_CELLS * self.cell:
                raise OptionError(
                    f"'{name}' must not be more than {_MOST_CELLS} cells",
                    found=f"{value:g} m in cells of {self.cell:g} m",
                    cure="Use larger cells or a smaller window",
                )
        for name in ("slope", "threshold", "scalar"):
            checks.number(f"'{name}'", getattr(self, name), 0)

    @property
    def radius(self) -> int:
        """Of the largest window, in cells."""
        return max(1, round(self.window / self.cell))

    @property
    def opening_radii(self) -> list[int]:
        """Of the openings that are wanted, in cells."""
        return [opening_radius(size, self.cell) for size in self.openings]

    @property
    def largest_radius(self) -> int:
        """Of windows and openings, in cells."""
        return max([self.radius, *self.opening_radii])

    def levels(self, block: float) -> int:
        """How often cells are put together until they are blocks of so many meters."""
        return max(1, round(math.log2(block / self.cell)))

    def is_ground(
        self,
        use: NDArray[np.bool_],
        height: NDArray[np.float64],
        gradient: NDArray[np.float64],
    ) -> NDArray[np.bool_]:
        """Which of the points to `use` are ground, by their heights above the surface and its slope
        there; NaN is not."""
        return use & (np.abs(height) <= self.threshold + self.scalar * gradient)

    @property
    def reach(self) -> int:
        """Distance in cells within which lowest points can change which cells are ground, and how
        high.

        An opening looks twice its radius away; low outliers are judged before, and surfaces fitted
        through ground after.
        """
        surfaces = ROUNDS * planes_reach(self.levels(NEAR))
        openings = 2 * self.largest_radius + 2 * FILL_RINGS
        return outlier_reach(self.cell) + openings + surfaces + 2

    @property
    def reach_of_points(self) -> int:
        """How far away, in cells, points can change a point's results.

        Beyond what decides which cells are ground come the surfaces through it: that for telling
        ground, and the last.
        """
        return self.reach + sum(planes_reach(self.levels(block)) for block in (NEAR, FAR))

    @property
    def reach_of_cells(self) -> int:
        """How far away from points, in cells, cells of the ground matter that was found before."""
        return planes_reach(self.levels(FAR)) + 4

    @property
    def link(self) -> int:
        """How far one step looks, in cells: no step of the filter sees from a point to another
        across more empty land."""
        openings = self.largest_radius + 2 * FILL_RINGS
        return max(outlier_reach(self.cell), openings, planes_reach(self.levels(FAR))) + 2


#: Sums of coordinates are whole numbers of this part of a meter, so that order does not matter.
_PARTS = 2.0**20
#: Which cells (h, w) hold ground points, and where these are on average (h, w, 3), as
#: :attr:`.surface.GroundRaster.place`.
CellMeans = tuple[NDArray[np.bool_], NDArray[np.float64]]


class GroundPoints(NamedTuple):
    """Points with finite coordinates in meters (n,) each, and the cells they fall in."""

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    z: NDArray[np.float64]
    use: NDArray[np.bool_]  #: whether they may be ground
    column: NDArray[np.int64]
    row: NDArray[np.int64]

    @classmethod
    def of(cls, x, y, z, use, cell: float) -> GroundPoints:
        """Of a grid of such cells."""
        return cls(x, y, z, use, cell_numbers(x, cell), cell_numbers(y, cell))

    def some(self, which: NDArray | slice) -> GroundPoints:
        """Part of them."""
        return GroundPoints._make(values[which] for values in self)


def ground_raster(
    points: GroundPoints,
    options: FilterOptions,
    margin: int = FILL_RINGS + 1,
    wanted: GridWindow | None = None,
) -> tuple[GroundRaster, NDArray[np.int64]]:
    """Classify the cells of the minimum grid round points into ground and objects.

    The steps are those of SMRF [P13]: minimum grid, low outliers, openings with growing windows;
    ground that the openings took from ridges is then regained where it lies near the surface
    through the rest.

    Parameters
    ----------
    points : GroundPoints
    margin : int
        Empty cells on every side, one at least: points blend the four cells round them.
    wanted : GridWindow, optional
        The cells that are looked at; the raster holds these and as many around as later steps need.

    Returns
    -------
    raster : GroundRaster
    low_outliers : (m,) int64
        Numbers of the points that are low outliers.
    """
    x, y, z, _, column, row = points
    window = GridWindow.enclosing(column, row).padded(margin)
    lowest, raster, low_outliers = minimum_grid(points, window, options.cell)
    objects, floor, opened = objects_of(
        raster, options.cell, options.slope, options.radius, options.opening_radii
    )
    step = planes_reach(options.levels(NEAR))
    wanted = wanted or window
    kept = wanted.padded(ROUNDS * step).intersect(window)
    part = kept.slices_in(window)
    lowest, raster = np.ascontiguousarray(lowest[part]), np.ascontiguousarray(raster[part])
    objects, floor = np.ascontiguousarray(objects[part]), np.ascontiguousarray(floor[part])
    opened = {radius: np.ascontiguousarray(values[part]) for radius, values in opened.items()}
    held = lowest >= 0
    low, place = lowest[held], np.zeros((*raster.shape, 3))
    for axis, (at, cells_of) in enumerate(((x, column), (y, row))):
        place[held, axis] = at[low] / options.cell - cells_of[low] - 0.5
    place[held, 2] = z[low]
    ground = np.isfinite(raster) & ~objects
    made = GroundRaster(kept, raster, place, ground, floor, opened)
    for number in range(1, ROUNDS + 1):
        seen = np.zeros(raster.shape, bool)
        seen[wanted.padded((ROUNDS - number) * step).intersect(kept).slices_in(kept)] = True
        seen &= np.isfinite(raster) & ~ground
        blocks, cells = planes_of_blocks(made, options.levels(NEAR), seen), np.flatnonzero(seen)
        near = _near(
            cells, place, *blocks, *kept[:2], options.cell, options.threshold, options.scalar
        )
        ground.ravel()[cells[near]] = True
    return made, low_outliers


def minimum_grid(
    points: GroundPoints, window: GridWindow, cell: float
) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.int64]]:
    """Make the minimum grid of a window, without low outliers.

    Returns
    -------
    lowest : (h, w) int64
        Number of the lowest point of each cell, -1 where there is none.
    raster : (h, w) float32
        Its height in meters; HOLE where there is none, or a low outlier.
    low_outliers : (m,) int64
        Numbers of the points that are low outliers.
    """
    shape, cells = (window.height, window.width), window.height * window.width
    usable = np.flatnonzero(points.use)
    inside = window.flat_index(points.column[usable], points.row[usable])
    x, y, z = (axis[usable] for axis in points[:3])
    low = lowest_points(x, y, z, inside, cells).reshape(shape)
    lowest = np.append(usable, -1)[low]
    raster = np.where(lowest >= 0, points.z[lowest], HOLE).astype(np.float32)
    outliers = find_low_outliers(raster, cell)
    raster[outliers] = HOLE
    return lowest, raster, lowest[outliers]


@njit
def _near(cells, place, blocks, blocks_left, blocks_bottom, left, bottom, cell, threshold, scalar):
    """Find the cells (n,), numbered row by row, that lie near the surface through the ground (see
    :mod:`.surface`)."""
    w = place.shape[1]
    out = np.zeros(len(cells), np.bool_)
    for k in range(len(cells)):
        j, i = cells[k] // w, cells[k] % w
        height, across, along = from_parents(
            blocks, blocks_left, blocks_bottom, i + left, j + bottom, 1.0
        )
        x, y, z = place[j, i, 0], place[j, i, 1], place[j, i, 2]
        gradient = np.sqrt(across * across + along * along) / cell
        out[k] = abs(z - height - x * across - y * along) <= threshold + scalar * gradient
    return out


@njit
def add_ground(x, y, z, is_ground, column, row, cell, left, bottom, count, place):
    """Add points that are ground to their cells: number (h, w) and places (h, w, 3); in whole
    numbers, so order is free."""
    for p in range(len(x)):
        if is_ground[p]:
            j, i = row[p] - bottom, column[p] - left
            count[j, i] += 1
            place[j, i, 0] += np.rint((x[p] / cell - column[p] - 0.5) * _PARTS)
            place[j, i, 1] += np.rint((y[p] / cell - row[p] - 0.5) * _PARTS)
            place[j, i, 2] += np.rint(z[p] * _PARTS)


def means_of(count: NDArray[np.int64], place: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Make such sums means: from the cell's center, in cells, and its height; which cells (h, w)
    hold ground."""
    held = count > 0
    place[held] /= (_PARTS * count[held])[:, None]
    return held
