"""Blocks of the ground's raster: made once of the lowest points far around and of all points inside; tiles put them
together."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import begins_run
from .cells import HIGHEST, cell_numbers
from .decks import decks_of_levels, levels_near_decks
from .groundcells import (
    BLOCK_SIDE,
    NEAR,
    CellMeans,
    CellWindow,
    FilterOptions,
    GroundCells,
    GroundRaster,
    add_ground,
    ground_raster,
    means_of,
)
from .patches import connected
from .planes import around, heights_above, surface
from .planes import reach as planes_reach

#: Cells beyond its reach that points may lie in without being left out.
_FEW = 4


def reach_of_block(options: FilterOptions) -> int:
    """How far around a block, in cells, lowest points matter."""
    return options.reach + _beside(options)


def _beside(options: FilterOptions) -> int:
    """How far around a block, in cells, it must be known which cells are ground: points are told from a surface."""
    return planes_reach(options.levels(NEAR)) + 4


def by_block(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    z: NDArray[np.float64],
    use: NDArray[np.bool_],
    cell: float,
    side: int = BLOCK_SIDE,
) -> dict[tuple[int, int], NDArray[np.float64]]:
    """Those of points that may be ground (m, 3) by the block of `side` cells that holds them; meters."""
    mine = use & (np.abs(z) < HIGHEST)
    xyz = np.column_stack([x[mine], y[mine], z[mine]])
    if not len(xyz):
        return {}
    column, row = (cell_numbers(xyz[:, axis], cell) // side for axis in (0, 1))
    if (column == column[0]).all() and (row == row[0]).all():
        return {(int(column[0]), int(row[0])): xyz}
    order = np.lexsort((column, row))
    starts = np.flatnonzero(begins_run(column[order]) | begins_run(row[order]))
    blocks = zip(column[order[starts]].tolist(), row[order[starts]].tolist(), strict=True)
    return {block: xyz[part] for block, part in zip(blocks, np.split(order, starts[1:]), strict=True)}


def cells_of_block(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    z: NDArray[np.float64],
    block: tuple[int, int],
    options: FilterOptions,
    points: Iterable[NDArray[np.float64]] = (),
    side: int = BLOCK_SIDE,
) -> GroundCells:
    """The cells of a block, column and row of a grid of blocks of `side` cells.

    x, y, z are the lowest points of cells, in meters: all within :func:`reach_of_block` cells of the block, and as many more
    as you like. `points` are all that may be ground in the block, in parts (n, 3).
    """
    column, row = cell_numbers(x, options.cell), cell_numbers(y, options.cell)
    west, south = (side * number for number in block)
    east, north = west + side - 1, south + side - 1

    def within(column, row, away):
        inside = (column >= west - away) & (column <= east + away)
        return inside & (row >= south - away) & (row <= north + away)

    def beyond(away):
        """Whether any lies so far away that it is worth a copy of the others."""
        left, right, low, high = column.min(), column.max(), row.min(), row.max()
        return left < west - away or right > east + away or low < south - away or high > north + away

    # Openings reach into cells without points.
    spill = max([*options.opening_radii, 0]) + 2
    margin = max(spill, _beside(options))
    if len(x) and beyond(reach_of_block(options) + _FEW):
        near = within(column, row, reach_of_block(options))
        x, y, z, column, row = x[near], y[near], z[near], column[near], row[near]
    levels, deck = np.empty((0, 5)), np.zeros(len(x), np.uint8)
    own_levels = levels
    if options.decks and len(x):
        far = options.reach_of_decks + margin
        seen = within(column, row, far) if beyond(far + _FEW) else slice(None)
        use = np.ones(len(x[seen]), bool)
        # In one piece: squares of it would each be looked at with as much around as the block has.
        largest = (side + 2 * (far + _FEW)) ** 2
        levels, lowest = levels_near_decks(x[seen], y[seen], z[seen], use, largest)
        deck[seen] = decks_of_levels(x[seen], y[seen], z[seen], use, levels)
        own_levels = levels[within(column[seen][lowest], row[seen][lowest], 0)]
    ground = _GroundPoints(west, south, side, levels, options)
    rasters = []
    own = CellWindow(west, south, side, side)
    for part, _own in connected(column, row, within(column, row, margin), options.link):
        given = x, y, z, np.ones(len(x), bool), deck, column, row
        if len(part) < len(x):
            given = tuple(values[part] for values in given)  # type: ignore[assignment]
        raster, _ = ground_raster(*given, options=options, margin=spill, wanted=own.grown(margin))
        inside = part[within(column[part], row[part], 0)]
        ground.look_at(raster, column[inside], row[inside])
        rasters.append(raster.cut(own))
        del raster
    for some in points:
        ground.add(some)
    found = [_cells_of(raster, west, south, *ground.means_of(n), options) for n, raster in enumerate(rasters)]
    return replace(GroundCells.joined(found, len(options.openings)), decks=own_levels)


class _GroundPoints:
    """Tells which of a block's points are ground, and sums them up by cell.

    `levels`: see :func:`.decks.levels_near_decks`.
    """

    def __init__(
        self, west: int, south: int, side: int, levels: NDArray[np.float64], options: FilterOptions
    ) -> None:
        self._west, self._south, self._levels, self._options = west, south, levels, options
        # With a ring around: points blend the four cells round them.
        self._planes = np.full((side + 2, side + 2, 3), np.nan)
        self._part = np.full((side, side), -1, np.int32)
        self._parts = 0
        self._sums = np.zeros((side, side, 4), np.int64)

    def look_at(self, raster: GroundRaster, column: NDArray[np.int64], row: NDArray[np.int64]) -> None:
        """The next part of the block, whose cells in it are these."""
        self._part[row - self._south, column - self._west] = self._parts
        self._parts += 1
        if not column.size:
            return
        needed = around(column, row, raster.left, raster.bottom, raster.shape)
        planes = surface(
            raster.ground, raster.place, raster.floor, raster.lowest, raster.left, raster.bottom,
            self._options.levels(NEAR), needed,
        )  # fmt: skip
        j, i = np.nonzero(needed)
        self._planes[j + raster.bottom - self._south + 1, i + raster.left - self._west + 1] = planes[j, i]

    def add(self, points: NDArray[np.float64]) -> None:
        """Points of the block (n, 3) that may be ground."""
        x, y, z = np.ascontiguousarray(points.T)
        options, cell = self._options, self._options.cell
        height, gradient = np.empty((2, len(x)))
        heights_above(x, y, z, cell, self._west - 1, self._south - 1, self._planes, height, gradient)
        use = np.ones(len(x), bool)
        deck = decks_of_levels(x, y, z, use, self._levels)
        is_ground = options.is_ground(use, deck, height, gradient)
        column, row = cell_numbers(x, cell), cell_numbers(y, cell)
        add_ground(x, y, z, is_ground, column, row, cell, self._west, self._south, self._sums)

    def means_of(self, number: int) -> CellMeans:
        """Of the cells of a part of the block, on a raster of all of it."""
        held, means = np.zeros(self._part.shape, bool), np.zeros((*self._part.shape, 3))
        means_of(self._sums, held, means)
        return held & (self._part == number), means


def _cells_of(
    raster: GroundRaster,
    west: int,
    south: int,
    held: NDArray[np.bool_],
    means: NDArray[np.float64],
    options: FilterOptions,
) -> GroundCells:
    """Of a raster inside a block, and what ground points say on the raster of all of it, from a column and row on."""
    h, w = raster.shape
    inside = (
        slice(raster.bottom - south, raster.bottom - south + h),
        slice(raster.left - west, raster.left - west + w),
    )
    held, means = held[inside], means[inside]
    opened = [raster.opened[radius] for radius in options.opening_radii]
    there = np.isfinite(raster.lowest) | held
    for values in opened:
        there |= np.isfinite(values)
    j, i = np.nonzero(there)
    ground = raster.ground[there]
    return GroundCells(
        i + raster.left,
        j + raster.bottom,
        raster.lowest[there],
        raster.floor[there],
        ground,
        raster.place[there][ground],
        np.array([values[there] for values in opened], np.float32).reshape(len(opened), len(j)),
        held[there],
        means[held],
        np.empty((0, 5)),
    )
