"""Roofs wider than the ground filter's window: what stands out of the land and ends in steps.

On a minimum grid of coarse cells, an opening takes what the window knows anyway, a closing fills
pits and moats, and a wide opening takes what stands out of its surroundings: hilltops, ridges,
roofs. Most of a roof's outline is a step; a hill's is not, and where the cloud ends is no step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..base.grid import GridWindow, cell_numbers
from .cells import HOLE
from .components import linked_cells
from .openings import FILL_RINGS, fill_holes, highest_around, openings_of


@dataclass(frozen=True)
class WideRoofRules:
    """Thresholds of wide roofs. What they are worth is in docs/results/ablation.md."""

    side_m: float = 2.0  #: side of the coarse cells in meters; 4 m gives the same within 0.02
    radius_m: float = 110.0  #: half the width of the widest roof, in meters
    max_extent_m: float = 250.0  #: extent of the longest roof along either axis, in meters
    #: Half the width in meters of pits and moats that are filled: land within a moat is no roof.
    gap_m: float = 8.0
    min_height_m: float = 2.0  #: least height above the land around, in meters
    #: Height in meters of a step. With 2 m half of the wide roofs of a thin cloud are lost.
    min_step_m: float = 1.5
    #: Least share of a roof's outline that is a step: trees or annexes may stand beside the rest.
    min_step_share: float = 0.6

    def cells(self, length: float, cell: float) -> int:
        """Return a length in coarse cells."""
        return max(1, round(length / (self.cells_per_side(cell) * cell)))

    def cells_per_side(self, cell: float) -> int:
        """Return how many cells of the ground filter lie along the side of a coarse one."""
        return max(1, round(self.side_m / cell))

    def reach(self, cell: float, window: float) -> int:
        """Return how far away, in cells of the filter, points change what is a wide roof."""
        far = 2 * self.radius_m + self.max_extent_m + 2 * window + 2 * self.gap_m
        return (self.cells(far, cell) + FILL_RINGS + 6) * self.cells_per_side(cell)

    def gap(self, cell: float) -> int:
        """Return across how many cells of the filter without points windows see others."""
        coarse = self.cells(self.radius_m, cell) + 2 * FILL_RINGS + 1
        return coarse * self.cells_per_side(cell)


RULES = WideRoofRules()


def lowest_of_coarse_cells(xyz: NDArray[np.float64], cell: float) -> NDArray[np.float64]:
    """Return the lowest points (m, 3) of coarse cells, each in the middle of its cell.

    They stand for all points (n, 3) so far away that only wide roofs depend on them.
    """
    if not len(xyz):
        return xyz
    joined = RULES.cells_per_side(cell)
    column, row = (cell_numbers(axis, cell) // joined for axis in xyz.T[:2])
    window = GridWindow.enclosing(column, row)
    lowest = np.full(window.shape, np.inf)
    np.minimum.at(lowest.ravel(), window.flat_index(column, row), xyz[:, 2])
    j, i = np.nonzero(np.isfinite(lowest))
    middle = np.column_stack([i + window.left, j + window.bottom]) + 0.5
    return np.column_stack([middle * (joined * cell), lowest[j, i]])


def level_below_roofs(
    column: NDArray[np.int64],
    row: NDArray[np.int64],
    z: NDArray[np.float64],
    wanted: GridWindow,
    cell: float,
    window: float,
) -> NDArray[np.float32]:
    """Return the level of the land below wide roofs and beside them, and HOLE elsewhere.

    Parameters
    ----------
    column, row : (n,) int64
        Cells of points that may be ground.
    z : (n,) float64
        Their heights in meters.
    wanted : GridWindow
        The cells (h, w) of the result.
    cell, window : float
        Side of a cell, and radius of the filter's largest window, in meters.
    """
    if not len(z):
        return np.full(wanted.shape, HOLE)
    joined = RULES.cells_per_side(cell)
    columns = (np.arange(wanted.width) + wanted.left) // joined
    rows = (np.arange(wanted.height) + wanted.bottom) // joined
    column, row = column // joined, row // joined
    raster_window = GridWindow.enclosing(np.append(column, columns), np.append(row, rows))
    raster_window = raster_window.padded(FILL_RINGS + 1)
    lowest = np.full(raster_window.shape, HOLE)
    np.minimum.at(lowest.ravel(), raster_window.flat_index(column, row), z)
    level = _coarse_levels(lowest, cell, window)
    return level[np.ix_(rows - raster_window.bottom, columns - raster_window.left)]


def _coarse_levels(lowest: NDArray[np.float32], cell: float, window: float) -> NDArray[np.float32]:
    """Return the land's level below and beside wide roofs of a coarse minimum grid (h, w)."""

    def cells(length: float) -> int:
        return RULES.cells(length, cell)

    filled = fill_holes(lowest)
    known = filled != HOLE
    plain = _opened(filled, known, cells(window))
    plain = -_opened(-plain, known, cells(RULES.gap_m))  # closed
    level = _opened(plain, known, cells(RULES.radius_m))
    above = plain - level > RULES.min_height_m
    outline = above & highest_around(~above, 1, 0)
    below = -highest_around(np.where(known & ~above, -plain, -HOLE), 1, 0)
    stepped = outline & (below <= plain - RULES.min_step_m)
    flat = np.where(above, np.float32(0), HOLE)
    number, sizes, longest = linked_cells(flat, 1.5, np.ones_like)  # corners touch
    rims = np.bincount(number[outline], minlength=len(sizes))
    steps = np.bincount(number[stepped], minlength=len(sizes))
    roofs = (steps >= RULES.min_step_share * rims) & (longest < cells(RULES.max_extent_m))
    above[above] = roofs[number[above]]
    return -highest_around(np.where(above, -level, -HOLE), 1, 0)


def _opened(raster: NDArray, known: NDArray[np.bool_], radius: int) -> NDArray[np.float32]:
    """Return the opening (h, w) of the known cells of a raster by an octagon, 0 elsewhere."""
    ((_, opened),) = openings_of(np.where(known, raster, HOLE), [radius])
    return np.where(known, opened, np.float32(0))
