"""Which cells of a minimum grid are ground: of all the points there are, or of a block of cells and what lies around it.

All of a progressive morphological filter that looks far away is done here, on a raster; see :mod:`.morphological`. In tiles
it is done once for each block of a grid of blocks, out of the lowest points of cells, and tiles put the blocks together.
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
from ..base.jit import njit
from .belowground import pits, pits_reach
from .cells import HOLE, CellWindow, cell_numbers, lowest_points
from .hillside import roofs_of_hillsides
from .openings import (
    JUMP,
    LINK,
    WALL,
    objects_of,
    opening_radius,
    plateau_reach,
    remove_plateaus,
    wide_radius,
)
from .planes import GroundRaster, from_parents, planes_of_blocks
from .planes import reach as planes_reach

#: Blocks, in meters, from which the surface is made: that for telling ground, and that of the heights.
NEAR, FAR = 8.0, 32.0
#: The most cells a window's radius may have.
_MOST_CELLS = 300
#: How often ground is regained; on slopes (rise over run) that are steeper, from there on, from sloping planes.
ROUNDS, STEEP = 3, 0.5


@dataclass(frozen=True)
class FilterOptions:
    """Of :func:`.morphological.filtered_ground`; lengths in meters. Wrong ones raise an :class:`OptionError`."""

    cell: float = 1.0
    slope: float = 0.15
    window: float = 75.0
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
        """Which of the points to `use` are ground, by their heights above the surface and its slope there; NaN is not."""
        return use & (np.abs(height) <= self.threshold + self.scalar * gradient)

    @property
    def reach(self) -> int:
        """How far away, in cells, lowest points can change which cells are ground, and how high.

        An opening looks twice its radius away, and how steep land is as far again; a plateau looks as far as it is wide; low
        outliers are judged before, and surfaces fitted through ground between.
        """
        surfaces = ROUNDS * planes_reach(self.levels(NEAR))
        looked = 2 * max(self.largest_radius, 2 * wide_radius(self.radius, self.cell))
        return pits_reach(self.cell) + looked + plateau_reach(self.cell) + surfaces + 2

    @property
    def reach_of_points(self) -> int:
        """How far away, in cells, points can change a point's results.

        Beyond what decides which cells are ground come the surfaces through it: that for telling ground, and the last.
        """
        return self.reach + sum(planes_reach(self.levels(block)) for block in (NEAR, FAR))

    @property
    def reach_of_cells(self) -> int:
        """How far away from points, in cells, cells of the ground matter that was found before."""
        return planes_reach(self.levels(FAR)) + 4

    @property
    def link(self) -> int:
        """How far one step looks, in cells: no step of the filter sees from a point to another across more empty land."""
        return max(pits_reach(self.cell), self.largest_radius, planes_reach(self.levels(FAR))) + 2


#: Sums of coordinates are whole numbers of this part of a meter, so that order does not matter.
_PARTS = 2.0**20
#: Which cells (h, w) hold ground points, and where these are on average (h, w, 3), as :attr:`.planes.GroundRaster.place`.
CellMeans = tuple[NDArray[np.bool_], NDArray[np.float64]]


class GroundPoints(NamedTuple):
    """Points with finite coordinates in meters (n,) each, and the cells they fall in."""

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    z: NDArray[np.float64]
    top: NDArray[np.float64]  #: as high as others of the same cell are, where these are not given
    use: NDArray[np.bool_]  #: whether they may be ground
    column: NDArray[np.int64]
    row: NDArray[np.int64]

    @classmethod
    def of(cls, x, y, z, top, use, cell: float) -> GroundPoints:
        """Of a grid of such cells."""
        return cls(x, y, z, top, use, cell_numbers(x, cell), cell_numbers(y, cell))

    def some(self, which: NDArray | slice) -> GroundPoints:
        """Part of them."""
        return GroundPoints._make(values[which] for values in self)


def ground_raster(
    points: GroundPoints, options: FilterOptions, margin: int = 1, wanted: CellWindow | None = None
) -> tuple[GroundRaster, NDArray[np.int64]]:
    """What the raster round points tells of the ground, and the numbers of points (n,) that are pits.

    On every side are `margin` empty cells, one at least: points blend the four cells round them. Where only some
    cells are `wanted`, the raster holds these and as many around as steps still look at, when that is known.
    """
    x, y, z, top, use, column, row = points
    window = CellWindow.round(column, row).grown(margin)
    shape = window.height, window.width
    cells, mine = window.height * window.width, np.flatnonzero(use)
    inside = window.numbers(column[mine], row[mine])
    low = lowest_points(x[mine], y[mine], z[mine], inside, cells).reshape(shape)
    lowest = np.append(mine, -1)[low]
    cell = options.cell
    raster = np.where(lowest >= 0, z[lowest], HOLE).astype(np.float32)
    highest = np.full(cells, -np.inf)
    np.maximum.at(highest, inside, top[mine])
    bad = pits(raster, highest.reshape(shape), cell)
    pit_points = lowest[bad]
    raster[bad] = HOLE
    objects, floor, opened, steep = objects_of(
        raster, cell, options.slope, options.radius, options.opening_radii
    )
    step = planes_reach(options.levels(NEAR))
    plateaus = plateau_reach(cell)
    wanted = wanted or window
    kept = wanted.grown(plateaus + ROUNDS * step).within(window)
    part = kept.on(window)
    cut_out: list = [np.ascontiguousarray(a[part]) for a in (lowest, raster, objects, floor, steep)]
    lowest, raster, objects, floor, steep = cut_out
    del cut_out
    opened = {radius: np.ascontiguousarray(values[part]) for radius, values in opened.items()}
    held = lowest >= 0
    low, place = lowest[held], np.zeros((*raster.shape, 3))
    for axis, (at, cells_of) in enumerate(((x, column), (y, row))):
        place[held, axis] = at[low] / cell - cells_of[low] - 0.5
    place[held, 2] = z[low]
    del lowest, bad
    ground = np.isfinite(raster) & ~objects
    told = GroundRaster(kept, raster, place, ground, floor, opened)

    for number in range(1, ROUNDS + 1):
        blocks = planes_of_blocks(told, options.levels(NEAR), STEEP * cell)
        rest, seen = np.isfinite(raster) & ~ground, np.zeros(raster.shape, bool)
        seen[wanted.grown(plateaus + (ROUNDS - number) * step).within(kept).on(kept)] = True
        asked = np.flatnonzero(rest & seen)
        near = _near(
            asked, place, rest, *blocks, *kept[:2], cell, options.threshold, options.scalar
        )
        ground.ravel()[asked[near]] = True
    below = roofs_of_hillsides(ground, raster, cell)
    remove_plateaus(ground, floor, raster, steep, cell)
    roofs = ground & (below != HOLE)
    ground[roofs], floor[roofs] = False, below[roofs]
    return told, pit_points


@njit
def _near(
    cells, place, rest, blocks, blocks_left, blocks_bottom, left, bottom, cell, threshold, scalar
):
    """Which of the cells (n,), numbered row by row, lie near the surface of the ground found so far (see :mod:`.planes`)."""
    h, w = rest.shape
    out = np.zeros(len(cells), np.bool_)
    for k in range(len(cells)):
        j, i = cells[k] // w, cells[k] % w
        height, across, along = from_parents(
            blocks, blocks_left, blocks_bottom, i + left, j + bottom, 1.0
        )
        x, y, z = place[j, i, 0], place[j, i, 1], place[j, i, 2]
        gradient = np.sqrt(across * across + along * along) / cell
        if abs(z - height - x * across - y * along) > threshold + scalar * gradient:
            continue
        sides = 0
        for b in range(max(j - LINK, 0), min(j + LINK + 1, h)):
            for a in range(max(i - LINK, 0), min(i + LINK + 1, w)):
                if rest[b, a]:
                    drop = z - place[b, a, 2] - (i - a) * across - (j - b) * along
                    if drop > max(JUMP, WALL * cell * np.sqrt(float((b - j) ** 2 + (a - i) ** 2))):
                        sides |= 1 << (2 * (b > j) + (a > i))
        # A jump above others of the rest, which is no ground yet, on all four sides: a treetop.
        out[k] = sides != 15
    return out


@njit
def add_ground(x, y, z, is_ground, column, row, cell, left, bottom, count, place):
    """Add points that are ground to their cells: number (h, w) and places (h, w, 3); in whole numbers, so order is free."""
    for p in range(len(x)):
        if is_ground[p]:
            j, i = row[p] - bottom, column[p] - left
            count[j, i] += 1
            place[j, i, 0] += np.rint((x[p] / cell - column[p] - 0.5) * _PARTS)
            place[j, i, 1] += np.rint((y[p] / cell - row[p] - 0.5) * _PARTS)
            place[j, i, 2] += np.rint(z[p] * _PARTS)


def means_of(count: NDArray[np.int64], place: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Make such sums means: from the cell's center, in cells, and its height; which cells (h, w) hold ground."""
    place /= (_PARTS * np.maximum(count, 1))[..., None]
    return count > 0
