"""Blocks of the ground's raster, which tiles join.

They are computed once, from the lowest points far around and all points inside.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..base.grid import GridWindow, cell_keys, cell_numbers, group_by_key
from .cells import HIGHEST, HOLE, lowest_points
from .openings import FILL_RINGS
from .smrf import (
    RIM,
    WIDE_RIM,
    CellMeans,
    FilterOptions,
    GroundPoints,
    ground_means,
    ground_raster,
)
from .surface import GroundRaster, cells_around, heights_above, surface
from .surface import reach as planes_reach
from .wide_roofs import RULES as WIDE_ROOFS
from .wide_roofs import lowest_of_coarse_cells

#: Side of a block in cells: larger ones take more memory, smaller ones more time; not tuned.
BLOCK_SIDE = 1024
#: Side of the squares of a block that are read by themselves, in cells; not tuned.
SQUARE_SIDE = 256


def reach_of_block(options: FilterOptions) -> int:
    """Return how far around a block, in cells, lowest points matter."""
    return options.reach + _reach_of_ground(options)


def _reach_of_ground(options: FilterOptions) -> int:
    """Return how far around a block, in cells, it must be known which cells are ground.

    The provisional surface of its points is fitted through these.
    """
    return planes_reach(options.near_levels) + WIDE_RIM


@dataclass(frozen=True)
class GroundCells:
    """Cells of a :class:`.surface.GroundRaster` that are not empty, in blocks."""

    #: Each has its cells in squares of `SQUARE_SIDE` cells by their names, as records, see
    #: `_record`. Saved ones are read when they are asked for, and not kept.
    blocks: Sequence[Mapping[str, NDArray[np.void]]]

    def raster(self, window: GridWindow, radii: list[int]) -> tuple[GroundRaster, CellMeans]:
        """Return the raster of a window, and the means of its ground points."""
        shape, record = (window.height, window.width), _record(len(radii))
        out = {name: np.zeros((*shape, *record[name].shape), record[name].base) for name in _FILLED}
        out["lowest"][:] = out["floor"][:] = HOLE
        opened = {radius: np.full(shape, -np.inf, np.float32) for radius in radii}
        squares = _squares_of(window)
        for block in self.blocks:
            for name in squares.intersection(block):
                cells = block[name]
                cells = cells[window.contains(cells["column"], cells["row"])]
                at = cells["row"] - window.bottom, cells["column"] - window.left
                for field, values in out.items():
                    values[at] = cells[field]
                for k, values in enumerate(opened.values()):
                    values[at] = cells["opened"][:, k]
        means = out.pop("held"), out.pop("means")
        return GroundRaster(window, **out, opened=opened), means


#: Fields of a record that fill rasters of their own.
_FILLED = ("lowest", "place", "ground", "floor", "held", "means")


def _in_squares(cells: NDArray[np.void]) -> dict[str, NDArray[np.void]]:
    """Return records (n,) of cells by the name of the square that holds them."""
    column, row = (cells[name].astype(np.int64) // SQUARE_SIDE for name in ("column", "row"))
    squares = group_by_key(cell_keys(column, row))
    return {f"{column[s[0]]}_{row[s[0]]}": cells[s] for s in squares}


def _squares_of(window: GridWindow) -> set[str]:
    """Return the names of the squares that hold cells of a window."""
    columns, rows = (
        range(first // SQUARE_SIDE, (first + count - 1) // SQUARE_SIDE + 1)
        for first, count in ((window.left, window.width), (window.bottom, window.height))
    )
    return {f"{i}_{j}" for i in columns for j in rows}


def _record(openings: int) -> np.dtype:
    """Return the type of a cell's record.

    The fields of a :class:`.surface.GroundRaster`, whether the cell holds ground points, and their
    mean place.
    """
    return np.dtype(
        [
            *((name, np.int32) for name in ("column", "row")),
            *((name, np.float32) for name in ("lowest", "floor")),
            *((name, np.bool_) for name in ("ground", "held")),
            *((name, np.float64, 3) for name in ("place", "means")),
            ("opened", np.float32, openings),
        ]
    )


def reduced_points(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    z: NDArray[np.float64],
    use: NDArray[np.bool_],
    options: FilterOptions,
) -> tuple[NDArray[np.float64], dict[tuple[int, int], NDArray[np.float64]]]:
    """Return what blocks need of points that may be ground, in meters.

    That is the lowest of each cell (n, 3), and all (m, 3) by the block that holds them.
    """
    rows = np.flatnonzero(use & (np.abs(z) < HIGHEST))
    xyz = np.column_stack([axis[rows] for axis in (x, y, z)])
    x, y, z = xyz.T
    column, row = cell_numbers(x, options.cell), cell_numbers(y, options.cell)
    cells, number = np.unique(cell_keys(column, row), return_inverse=True)
    low = lowest_points(x, y, z, number, len(cells))
    column, row = column // BLOCK_SIDE, row // BLOCK_SIDE
    blocks = group_by_key(cell_keys(column, row))
    return xyz[low], {(int(column[b[0]]), int(row[b[0]])): xyz[b] for b in blocks}


def cells_of_block(
    outer: NDArray[np.float64],
    block: tuple[int, int],
    options: FilterOptions,
    points: Iterable[NDArray[np.float64]] = (),
) -> dict[str, NDArray[np.void]]:
    """Compute the cells of one block of a :class:`GroundCells`, by column and row of the blocks.

    `outer` are the lowest points (n, 3) of :func:`reduced_points`: all within
    :func:`reach_of_block` cells of the block, and few more. `points` are all that may be ground in
    the block, in parts (n, 3).
    """
    core = GridWindow(block[0] * BLOCK_SIDE, block[1] * BLOCK_SIDE, BLOCK_SIDE, BLOCK_SIDE)
    # Openings reach into cells without points.
    spill = max([*options.requested_radii, 0]) + FILL_RINGS + RIM
    margin = max(spill, _reach_of_ground(options))
    low = _in_cells(_thinned_far_away(outer, core.padded(margin), options), options)
    if not core.padded(margin).contains(low.column, low.row).any():
        return {}
    raster = ground_raster(low, options, margin=spill, wanted=core.padded(margin))
    inside = low.take(core.contains(low.column, low.row))
    needed = cells_around(raster.window, inside.column, inside.row)
    planes = surface(raster, options.near_levels, needed)
    # With a ring around: points blend the four cells around them.
    kept = core.padded(1).intersect(raster.window)
    raster, planes = raster.cut(kept), planes[kept.slices_in(raster.window)].copy()
    means = ground_means(_judged(points, planes, kept, options), options.cell, kept)
    return _in_squares(_records(raster, core, means, options.requested_radii))


def _thinned_far_away(
    lowest: NDArray[np.float64], wanted: GridWindow, options: FilterOptions
) -> NDArray[np.float64]:
    """Return the lowest points (n, 3) near wanted cells, and far away those of coarse cells alone.

    This halves the memory of a block.
    """
    coarse = WIDE_ROOFS.cells_per_side(options.cell)
    near = wanted.padded(options.reach_of_raster)
    left, bottom = near.left // coarse * coarse, near.bottom // coarse * coarse
    right, top = near.left + near.width, near.bottom + near.height
    inside = np.ones(len(lowest), bool)
    for axis, first, end in ((0, left, right), (1, bottom, top)):
        number = cell_numbers(lowest[:, axis], options.cell)
        inside &= (number >= first) & (number < -(-end // coarse) * coarse)
    far = lowest_of_coarse_cells(lowest[~inside], options.cell)
    return np.concatenate([lowest[inside], far])


def _in_cells(xyz: NDArray[np.float64], options: FilterOptions) -> GroundPoints:
    """Return points (n, 3), all of which may be ground, with their cells."""
    x, y, z = np.ascontiguousarray(xyz.T)
    return GroundPoints.in_cells(x, y, z, np.ones(len(x), bool), options.cell)


def _judged(
    parts: Iterable[NDArray[np.float64]],
    planes: NDArray[np.float64],
    window: GridWindow,
    options: FilterOptions,
) -> Iterator[tuple[GroundPoints, NDArray[np.bool_]]]:
    """Yield parts of points (n, 3), and which are ground by the planes (h, w, 3) of a window."""
    for xyz in parts:
        points = _in_cells(xyz, options)
        height, gradient = np.empty((2, len(xyz)))
        heights_above(*points[:3], options.cell, window[:2], planes, height, gradient)
        yield points, options.is_ground(points.use, height, gradient)


def _records(
    raster: GroundRaster, core: GridWindow, means: CellMeans, radii: list[int]
) -> NDArray[np.void]:
    """Return the records (n,) of the cells of a raster that lie in the core and are not empty."""
    held, places = means
    opened = np.empty((*raster.shape, len(radii)), np.float32)
    for k, radius in enumerate(radii):
        opened[..., k] = raster.opened[radius]
    filled = np.zeros(raster.shape, bool)
    filled[core.intersect(raster.window).slices_in(raster.window)] = True
    filled &= np.isfinite(raster.lowest) | held | np.isfinite(opened).any(axis=-1)
    j, i = np.nonzero(filled)
    cells = np.empty(len(j), _record(len(radii)))
    for name in ("lowest", "floor", "ground", "place"):
        cells[name] = getattr(raster, name)[filled]
    for name, values in (("held", held), ("means", places), ("opened", opened)):
        cells[name] = values[filled]
    cells["column"], cells["row"] = i + raster.window.left, j + raster.window.bottom
    return cells
