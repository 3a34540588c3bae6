"""Blocks of the ground's raster: made once of the lowest points far around and of all points
inside; tiles put them together."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.grid import GridWindow, cell_keys, cell_numbers, group_by_key
from .cells import HIGHEST, HOLE, lowest_of_cells
from .openings import FILL_RINGS
from .smrf import (
    NEAR,
    CellMeans,
    FilterOptions,
    GroundPoints,
    add_ground,
    ground_raster,
    means_of,
)
from .surface import GroundRaster, around, heights_above, surface
from .surface import reach as planes_reach

#: Side of a block in cells.
BLOCK_SIDE = 1024


def reach_of_block(options: FilterOptions) -> int:
    """How far around a block, in cells, lowest points matter."""
    return options.reach + _beside(options)


def _beside(options: FilterOptions) -> int:
    """How far around a block, in cells, it must be known which cells are ground: points are told
    from a surface."""
    return planes_reach(options.levels(NEAR)) + 4


class GroundCells(NamedTuple):
    """Cells of a :class:`.surface.GroundRaster`, one by one: all with a height, an opening, or
    ground points."""

    cells: NDArray[np.void]  #: (n,) records, see `_record`

    def in_parts(self, side: int) -> dict[str, NDArray]:
        """All by name, for files: those of squares of so many columns and rows by themselves."""
        column, row = (self.cells[name].astype(np.int64) // side for name in ("column", "row"))
        parts = group_by_key(cell_keys(column, row))
        return {f"{column[p[0]]}_{row[p[0]]}": self.cells[p] for p in parts}

    @staticmethod
    def names_within(side: int, west: int, south: int, east: int, north: int) -> set[str]:
        """Names of the arrays of :meth:`in_parts` that are needed for the cells of these columns
        and rows."""
        columns, rows = (
            range(low // side, high // side + 1) for low, high in ((west, east), (south, north))
        )
        return {f"{i}_{j}" for i in columns for j in rows}

    @staticmethod
    def of_blocks(blocks: Iterable[Mapping[str, NDArray]], openings: int) -> GroundCells:
        """The cells that arrays of :meth:`in_parts` hold, of filters with so many openings."""
        parts = (part for block in blocks for part in block.values())
        return GroundCells(np.concatenate([np.empty(0, _record(openings)), *parts]))

    def on(self, window: GridWindow, radii: list[int]) -> tuple[GroundRaster, CellMeans]:
        """The cells of a window on its raster, and what their ground points say."""
        shape = window.height, window.width
        cells = self.cells[window.contains(self.cells["column"], self.cells["row"])]
        at = cells["row"] - window.bottom, cells["column"] - window.left

        def filled(name: str, value: Any, *more: int) -> NDArray:
            out = np.full((*shape, *more), value, cells[name].dtype)
            out[at] = cells[name]
            return out

        opened = filled("opened", -np.inf, len(radii))
        raster = GroundRaster(
            window,
            filled("lowest", HOLE),
            filled("place", 0.0, 3),
            filled("ground", False),
            filled("floor", HOLE),
            {radius: np.ascontiguousarray(opened[..., k]) for k, radius in enumerate(radii)},
        )
        return raster, (filled("held", False), filled("means", 0.0, 3))


def _record(openings: int) -> np.dtype:
    """Of a cell: as in a :class:`.surface.GroundRaster`; whether it holds ground points, and their
    mean place."""
    return np.dtype(
        [
            *((name, np.int32) for name in ("column", "row")),
            *((name, np.float32) for name in ("lowest", "floor")),
            *((name, np.bool_) for name in ("ground", "held")),
            *((name, np.float64, 3) for name in ("place", "means")),
            ("opened", np.float32, openings),
        ]
    )


def by_block(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    z: NDArray[np.float64],
    use: NDArray[np.bool_],
    cell: float,
) -> dict[tuple[int, int], NDArray[np.float64]]:
    """Those of points that may be ground (m, 3) by the block of `BLOCK_SIDE` cells that holds them;
    meters."""
    mine = np.flatnonzero(use & (np.abs(z) < HIGHEST))
    column, row = (cell_numbers(axis[mine], cell) // BLOCK_SIDE for axis in (x, y))
    parts = group_by_key(cell_keys(column, row))
    return {
        (int(column[p[0]]), int(row[p[0]])): np.column_stack([axis[mine[p]] for axis in (x, y, z)])
        for p in parts
    }


def around_blocks(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    z: NDArray[np.float64],
    use: NDArray[np.bool_],
    options: FilterOptions,
) -> NDArray[np.float64]:
    """Return the points (n, 3) that must be known around blocks: the lowest of each cell."""
    low = lowest_of_cells(x, y, z, use, options.cell)
    return np.column_stack([axis[low] for axis in (x, y, z)])


def cells_of_block(
    outer: NDArray[np.float64],
    block: tuple[int, int],
    options: FilterOptions,
    points: Iterable[NDArray[np.float64]] = (),
) -> GroundCells:
    """The cells of a block, column and row of a grid of blocks of `BLOCK_SIDE` cells.

    `outer` is (n, 3) of :func:`around_blocks`: all within :func:`reach_of_block` cells of the
    block, and few more. `points` are all that may be ground in the block, in parts (n, 3).
    """
    own = GridWindow(block[0] * BLOCK_SIDE, block[1] * BLOCK_SIDE, BLOCK_SIDE, BLOCK_SIDE)
    cell, openings = options.cell, options.opening_radii
    # Openings reach into cells without points.
    spill = max([*openings, 0]) + FILL_RINGS + 2
    margin = max(spill, _beside(options))

    def usable(xyz: NDArray[np.float64]) -> GroundPoints:
        x, y, z = np.ascontiguousarray(xyz.T)
        return GroundPoints.of(x, y, z, np.ones(len(x), bool), cell)

    low = usable(outer)
    if not own.padded(margin).contains(low.column, low.row).any():
        return GroundCells.of_blocks([], len(openings))
    raster, _ = ground_raster(low, options, margin=spill, wanted=own.padded(margin))
    inside = low.some(own.contains(low.column, low.row))
    needed = around(raster.window, inside.column, inside.row)
    planes = surface(raster, options.levels(NEAR), needed)
    # With a ring around: points blend the four cells round them.
    kept = own.padded(1).intersect(raster.window)
    raster, planes = raster.cut(kept), planes[kept.slices_in(raster.window)].copy()
    left, bottom, _, _ = kept
    count, means = np.zeros(raster.shape, np.int64), np.zeros((*raster.shape, 3))
    for xyz in points:
        some = usable(xyz)
        height, gradient = np.empty((2, len(xyz)))
        heights_above(*some[:3], cell, left, bottom, planes, height, gradient)
        is_ground = options.is_ground(some.use, height, gradient)
        add_ground(*some[:3], is_ground, some.column, some.row, cell, left, bottom, count, means)
    held = means_of(count, means)
    opened = np.empty((*raster.shape, len(openings)), np.float32)
    for k, radius in enumerate(openings):
        opened[..., k] = raster.opened[radius]
    there = np.zeros(raster.shape, bool)
    there[own.intersect(kept).slices_in(kept)] = True
    there &= np.isfinite(raster.lowest) | held | np.isfinite(opened).any(axis=-1)
    j, i = np.nonzero(there)
    cells = np.empty(len(j), _record(len(openings)))
    for name, values in (
        ("lowest", raster.lowest), ("floor", raster.floor), ("ground", raster.ground),
        ("held", held), ("place", raster.place), ("means", means), ("opened", opened),
    ):  # fmt: skip
        cells[name] = values[there]
    cells["column"], cells["row"] = i + left, j + bottom
    return GroundCells(cells)
