"""The simple morphological filter [P13]: ground and objects of a minimum grid.

Every step that looks far away is done here, on a raster; see :mod:`.heights`. In tiles it is done
once for each block of a grid of blocks, from the lowest points of cells, and tiles join the blocks.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
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
from .openings import FILL_RINGS, objects_of
from .surface import GroundRaster, surface
from .surface import reach as planes_reach
from .wide_roofs import RULES as WIDE_ROOFS
from .wide_roofs import level_below_roofs

#: Side in meters of the coarsest blocks of the provisional surface, which tells ground points. The
#: mean error of the ISPRS samples is 0.17 points higher with 8 m (docs/results/ablation.md).
NEAR = 16.0
#: Side of those of the surface that heights are measured from: it spans holes under large roofs.
#: Not tuned.
FAR = 32.0
#: Largest radius of the filter's window, and largest width of a requested opening, in cells: beyond
#: it memory and halo of a tile become too large.
_MOST_CELLS = 300
#: Cells added to the reach of one step: more than the one by which points blend the cells around
#: them. If it is too small, tiles no longer get the bits of the whole cloud.
RIM = 2
#: Cells added to the reach of surfaces, likewise; not tuned.
WIDE_RIM = 4
#: How often ground that openings took from ridges and dams is regained from the surface through the
#: rest. Without it the mean error of the ISPRS samples is 1.0 points higher, with one round 0.3
#: (docs/results/ablation.md).
ROUNDS = 3
#: How often, before each such round, a cell becomes ground if enough of the cells around it are
#: ground that hardly rises or falls to it: the broken edges of terraces, the shoulders of banks.
#: Without it the mean error of the ISPRS samples is 0.2 points higher, and of clips with holes too.
SPREADS = 2
#: Distance of these cells along either axis, in meters. With 1 m and 3 m the mean error of the
#: ISPRS samples is 0.13 and 0.06 points higher.
SPREAD_REACH = 2.0
#: They rise or fall at most this much per meter. With 0.15 and 0.3 that error is 0.05 and 0.19
#: points higher.
SPREAD_SLOPE = 0.2
#: Share of the measured cells around that must be such ground. With 0.2 and 0.3 that error is 0.02
#: points lower and 0.04 higher, that of the surveys 0.01 higher and lower.
SPREAD_SHARE = 0.25


@dataclass(frozen=True)
class FilterOptions:
    """Options of :func:`.heights.filtered_ground`, in meters; OptionError for wrong ones."""

    cell: float = 1.0
    slope: float = 0.1
    window: float = 18.0  #: radius of the largest window
    threshold: float = 0.4
    scalar: float = 1.25
    openings: Sequence[float] = ()  #: widths of the requested openings
    slope_too: bool = False

    def __post_init__(self) -> None:
        """Refuse wrong sizes."""
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
        """Radius of the largest window, in cells."""
        return max(1, round(self.window / self.cell))

    @property
    def requested_radii(self) -> list[int]:
        """Radii of the requested openings, in cells; the middle cell is counted."""
        return [max(1, round((size / self.cell - 1) / 2)) for size in self.openings]

    @property
    def near_levels(self) -> int:
        """Levels of the provisional surface."""
        return self.levels(NEAR)

    def levels(self, block: float) -> int:
        """Return how often cells are joined, 2 x 2, until they are blocks of about that side."""
        return max(1, round(math.log2(block / self.cell)))

    def is_ground(
        self,
        use: NDArray[np.bool_],
        height: NDArray[np.float64],
        gradient: NDArray[np.float64],
    ) -> NDArray[np.bool_]:
        """Return which points to `use` are ground by their height and slope; NaN is not."""
        return use & (np.abs(height) <= self.threshold + self.scalar * gradient)

    @property
    def spread_cells(self) -> int:
        """Distance in cells to which ground spreads in one step."""
        return max(1, round(SPREAD_REACH / self.cell))

    @property
    def round_reach(self) -> int:
        """Distance in cells within which ground changes what one round regains."""
        return planes_reach(self.near_levels) + SPREADS * self.spread_cells

    @property
    def reach(self) -> int:
        """Distance in cells within which lowest points can change which cells are ground.

        And how high these are.

        An opening looks twice its radius away; low outliers are judged before, and surfaces fitted
        through ground after.
        """
        wide = WIDE_ROOFS.reach(self.cell, self.window)
        return max(wide, self.reach_of_openings) + ROUNDS * self.round_reach + RIM

    @property
    def reach_of_raster(self) -> int:
        """Distance in cells within which all lowest points matter, beyond it the coarse cells'."""
        return ROUNDS * self.round_reach + self.reach_of_openings + RIM

    @property
    def reach_of_openings(self) -> int:
        """Distance in cells within which lowest points change openings."""
        openings = 2 * max([self.radius, *self.requested_radii]) + 2 * FILL_RINGS
        return outlier_reach(self.cell) + openings

    @property
    def reach_of_points(self) -> int:
        """Distance in cells within which points can change a point's results.

        Beyond what decides which cells are ground come the surfaces through it: the provisional
        one, and that of heights.
        """
        return self.reach + self._reach_of_surfaces

    @property
    def reach_of_given(self) -> int:
        """Distance in cells within which points can change a height above given ground.

        Or above an opening.
        """
        if not self.openings:
            return self._reach_of_surfaces + WIDE_RIM
        openings = 2 * max(self.requested_radii) + 2 * FILL_RINGS + outlier_reach(self.cell)
        return max(self._reach_of_surfaces, openings) + WIDE_RIM

    @property
    def _reach_of_surfaces(self) -> int:
        return planes_reach(self.near_levels) + planes_reach(self.levels(FAR))

    @property
    def reach_of_cells(self) -> int:
        """Distance in cells within which cells of known ground matter to points."""
        return planes_reach(self.levels(FAR)) + WIDE_RIM

    @property
    def link(self) -> int:
        """Distance in cells across which one step looks.

        No step of the filter sees from a point to another across more empty land.
        """
        openings = max([self.radius, *self.requested_radii]) + 2 * FILL_RINGS
        wide = WIDE_ROOFS.cells_per_side(self.cell) * (
            WIDE_ROOFS.cells(WIDE_ROOFS.radius_m, self.cell) + 1
        )
        return max(outlier_reach(self.cell), openings, planes_reach(self.levels(FAR)), wide) + RIM


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


def ground_raster(
    points: GroundPoints,
    options: FilterOptions,
    margin: int = FILL_RINGS + 1,
    wanted: GridWindow | None = None,
) -> GroundRaster:
    """Classify the cells of the minimum grid around points into ground and objects.

    The steps are those of SMRF [P13]: minimum grid, low outliers, opening with growing windows;
    roofs wider than these are added (:mod:`.wide_roofs`), and ground that the openings took from
    ridges is regained.

    Parameters
    ----------
    points : GroundPoints
    margin : int
        Empty cells on every side, one at least: points blend the four cells around them.
    wanted : GridWindow, optional
        The requested cells; the raster holds these and as many around as later steps need.
    """
    window, cell = GridWindow.enclosing(points.column, points.row).padded(margin), options.cell
    wanted = wanted or window
    kept = wanted.padded(ROUNDS * options.round_reach).intersect(window)
    window = wanted.padded(options.reach_of_raster).intersect(window)
    inside = window.contains(points.column, points.row)
    far = np.flatnonzero(points.use & ~inside)
    points = points._replace(use=points.use & inside)
    lowest, heights = minimum_grid(points, window, cell)
    objects, floor, opened = objects_of(
        heights, cell, options.slope, options.radius, options.requested_radii
    )
    seen = np.append(lowest[lowest >= 0], far)
    cells = points.column[seen], points.row[seen]
    land = level_below_roofs(*cells, points.z[seen], window, cell, options.window)
    roofs = np.isfinite(heights) & ~objects
    roofs[roofs] = heights[roofs] - land[roofs] > WIDE_ROOFS.min_height_m
    objects |= roofs
    floor[roofs] = land[roofs]
    part = kept.slices_in(window)
    lowest, heights = np.ascontiguousarray(lowest[part]), np.ascontiguousarray(heights[part])
    objects, floor = np.ascontiguousarray(objects[part]), np.ascontiguousarray(floor[part])
    opened = {radius: np.ascontiguousarray(values[part]) for radius, values in opened.items()}
    held = lowest >= 0
    low, place = lowest[held], np.zeros((*heights.shape, 3))
    place[held, 0] = points.x[low] / cell - points.column[low] - 0.5
    place[held, 1] = points.y[low] / cell - points.row[low] - 0.5
    place[held, 2] = points.z[low]
    ground = np.isfinite(heights) & ~objects
    raster = GroundRaster(kept, heights, place, ground, floor, opened)
    _regain_ground(raster, wanted, options)
    return raster


def _regain_ground(raster: GroundRaster, wanted: GridWindow, options: FilterOptions) -> None:
    """Turn cells among level ground, and near the provisional surface, into ground again.

    There are several rounds, each of which sees less around the `wanted` cells.
    """
    step, kept = options.round_reach, raster.window
    rise = SPREAD_SLOPE * options.cell
    measured = np.isfinite(raster.lowest)
    for number in range(1, ROUNDS + 1):
        for _ in range(SPREADS):
            cells = np.flatnonzero(measured & ~raster.ground)
            level = _among_ground(
                cells, raster.lowest, raster.ground, options.spread_cells, rise, SPREAD_SHARE
            )
            raster.ground.ravel()[cells[level]] = True
        seen = np.zeros(raster.shape, bool)
        seen[wanted.padded((ROUNDS - number) * step).intersect(kept).slices_in(kept)] = True
        seen &= measured & ~raster.ground
        cells, planes = np.flatnonzero(seen), surface(raster, options.near_levels, seen)
        height, across, along = planes.reshape(-1, 3)[cells].T
        x, y, z = raster.place.reshape(-1, 3)[cells].T
        gradient = np.sqrt(across * across + along * along) / options.cell
        off = z - height - x * across - y * along
        near = options.is_ground(measured.ravel()[cells], off, gradient)
        raster.ground.ravel()[cells[near]] = True


@njit
def _among_ground(cells, lowest, ground, reach, rise, least):
    """Find the cells (n,), numbered row by row, with a share of ground around that leads to them.

    Ground up to `reach` cells away counts if it lies at most `rise` meters per cell higher or
    lower. Holes do not count.
    """
    h, w = lowest.shape
    out = np.zeros(len(cells), np.bool_)
    for k in range(len(cells)):
        j, i = cells[k] // w, cells[k] % w
        measured = level = 0
        for b in range(max(j - reach, 0), min(j + reach + 1, h)):
            for a in range(max(i - reach, 0), min(i + reach + 1, w)):
                if lowest[b, a] == HOLE or (a == i and b == j):
                    continue
                measured += 1
                away = np.sqrt(float((b - j) ** 2 + (a - i) ** 2))
                level += ground[b, a] and abs(lowest[b, a] - lowest[j, i]) <= rise * away
        out[k] = measured > 0 and level >= least * measured
    return out


def minimum_grid(
    points: GroundPoints, window: GridWindow, cell: float
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Make the minimum grid of a window, without low outliers.

    Returns
    -------
    lowest : (h, w) int64
        Index of the lowest point of each cell, -1 where there is none.
    raster : (h, w) float32
        Its height in meters; HOLE where there is none, or a low outlier.
    """
    shape, cells = (window.height, window.width), window.height * window.width
    usable = np.flatnonzero(points.use)
    inside = window.flat_index(points.column[usable], points.row[usable])
    x, y, z = (axis[usable] for axis in points[:3])
    low = lowest_points(x, y, z, inside, cells).reshape(shape)
    lowest = np.append(usable, -1)[low]
    raster = np.where(lowest >= 0, points.z[lowest], HOLE).astype(np.float32)
    raster[find_low_outliers(raster, cell)] = HOLE
    return lowest, raster


@njit
def _add_ground(points, is_ground, cell, corner, count, place):
    """Add points that are ground to their cells: number (h, w) and places (h, w, 3).

    Places are whole numbers, so that order does not matter.

    `points` are :class:`GroundPoints`; `corner` is the first column and row of the raster.
    """
    left, bottom = corner
    for p in range(len(points.x)):
        if is_ground[p]:
            column, row = points.column[p], points.row[p]
            j, i = row - bottom, column - left
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
    count, place = np.zeros(window.shape, np.int64), np.zeros((*window.shape, 3))
    for points, is_ground in parts:
        _add_ground(points, is_ground, cell, window[:2], count, place)
    held = count > 0
    place[held] /= (_PARTS * count[held])[:, None]
    return held, place
