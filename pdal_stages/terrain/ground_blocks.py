"""Blocks of the ground's raster, which tiles join.

They are computed once, from the lowest points far around and all points inside.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.grid import GridWindow, cell_keys, cell_numbers, group_by_key
from . import wide_roofs
from .cells import HIGHEST, HOLE, lowest_points
from .filter_options import FilterOptions, Keep
from .minimum_grid import CellMeans, GroundPoints, ground_means
from .openings import FILL_RINGS
from .smrf import (
    GROUND_POINTS,
    MINIMUM_GRID,
    PROVISIONAL,
    cell_steps,
    ground_filter,
    holes,
    reach_of_cells,
)
from .steps import Chain
from .surface import GroundRaster, heights_above
from .wide_roofs import lowest_of_coarse_cells

#: Side of a block in cells: larger ones take more memory, smaller ones more time; not tuned.
BLOCK_SIDE = 1024
#: Side of the squares of a block that are read by themselves, in cells; not tuned.
SQUARE_SIDE = 256


def reach_of_block(options: FilterOptions) -> int:
    """Return how far around a block, in cells, lowest points matter."""
    return ground_filter(options).reach(last=GROUND_POINTS)


def _steps_of_block(options: FilterOptions) -> Chain:
    """Return the steps up to the surface that tells which points of a block are ground."""
    steps = ground_filter(options).steps
    names = [step.name for step in steps]
    return Chain(steps[: names.index(PROVISIONAL) + 1])


class KnownCells(NamedTuple):
    """The cells of a window, as an earlier round made them."""

    raster: GroundRaster
    means: CellMeans  #: of their ground points
    kept: list[NDArray[np.float32]]  #: (h, w) what each step made, where that was kept


@dataclass(frozen=True)
class GroundCells:
    """Cells of a :class:`.surface.GroundRaster` that are not empty, in blocks."""

    #: Each has its cells in squares of `SQUARE_SIDE` cells by their names, as records, see
    #: `_record`. Saved ones are read when they are asked for, and not kept.
    blocks: Sequence[Mapping[str, NDArray[np.void]]]

    def raster(self, window: GridWindow, options: FilterOptions, kept: int = 0) -> KnownCells:
        """Return what is known of the cells of a window; `kept` rasters of steps with it."""
        radii, shape = options.requested_radii, window.shape
        record = _record(len(radii), kept)
        out = {name: np.zeros((*shape, *record[name].shape), record[name].base) for name in _FILLED}
        out["lowest"][:] = out["floor"][:] = HOLE
        opened = {radius: np.full(shape, -np.inf, np.float32) for radius in radii}
        steps = [np.full(shape, np.nan, np.float32) for _ in range(kept)]
        squares = _squares_of(window)
        for block in self.blocks:
            for name in squares.intersection(block):
                cells = block[name]
                cells = cells[window.contains(cells["column"], cells["row"])]
                at = cells["row"] - window.bottom, cells["column"] - window.left
                for field, values in out.items():
                    values[at] = cells[field]
                for field, rasters in (("opened", opened.values()), ("kept", steps)):
                    for k, values in enumerate(rasters):
                        values[at] = cells[field][:, k]
        lowest, place, ground, floor, held, means = (out[name] for name in _FILLED)
        raster = GroundRaster(window, lowest, place, ground, floor, opened)
        return KnownCells(raster, (held, means), steps)


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


def _record(openings: int, kept: int) -> np.dtype:
    """Return the type of a cell's record.

    The fields of a :class:`.surface.GroundRaster`, whether the cell holds ground points, their mean
    place, and what steps made where that is kept.
    """
    return np.dtype(
        [
            *((name, np.int32) for name in ("column", "row")),
            *((name, np.float32) for name in ("lowest", "floor")),
            *((name, np.bool_) for name in ("ground", "held")),
            *((name, np.float64, 3) for name in ("place", "means")),
            ("opened", np.float32, openings),
            ("kept", np.float32, kept),
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
    column, row = (cell_numbers(axis, options.cell) for axis in xyz.T[:2])
    low = _lowest_of_cells(xyz.T, column, row)
    column, row = column // BLOCK_SIDE, row // BLOCK_SIDE
    blocks = group_by_key(cell_keys(column, row))
    return low, {(int(column[b[0]]), int(row[b[0]])): xyz[b] for b in blocks}


def cells_of_block(
    outer: NDArray[np.float64],
    block: tuple[int, int],
    options: FilterOptions,
    points: Iterable[NDArray[np.float64]] = (),
    keep: bool = False,
) -> dict[str, NDArray[np.void]]:
    """Compute the cells of a block: one of the blocks of a :class:`GroundCells`.

    Parameters
    ----------
    outer : (n, 3) float64
        The lowest points of :func:`reduced_points`: all within :func:`reach_of_block` cells of the
        block, and few more.
    block : tuple of int
        Column and row in a grid of blocks of `BLOCK_SIDE` cells.
    options : FilterOptions
    points : iterable of (m, 3) float64
        All points that may be ground in the block, in parts.
    keep : bool
        Whether records hold what each step made.
    """
    core = GridWindow(block[0] * BLOCK_SIDE, block[1] * BLOCK_SIDE, BLOCK_SIDE, BLOCK_SIDE)
    return cells_of_window(outer, core, options, points, keep)


def cells_near(
    points: NDArray[np.float64],
    far: NDArray[np.float64],
    places: NDArray[np.float64],
    reach: float,
    options: FilterOptions,
) -> list[dict[str, NDArray[np.void]]]:
    """Compute the cells that heights near places depend on, and what each step made of them.

    Parameters
    ----------
    points : (3, n) float64
        Points that may be ground, in meters: all within `reach` and :func:`reach_near_cells` of the
        places, or more.
    far : (m, 3) float64
        The :func:`.wide_roofs.lowest_of_coarse_cells` of those farther away, up to
        :func:`reach_of_block`.
    places : (k, 2) float64
        In meters.
    reach : float
        Meters around places within which heights are right.
    options : FilterOptions

    Returns
    -------
    list of dict
        Blocks of a :class:`GroundCells`.
    """
    column, row = (cell_numbers(axis, options.cell) for axis in points[:2])
    outer = np.concatenate([_lowest_of_cells(points, column, row), far])
    at = cell_numbers(places, options.cell).T
    reach_cells = int(np.ceil(reach / options.cell)) + reach_of_cells(options)
    blocks = []
    for core in GridWindow.enclosing(*at).padded(reach_cells).pieces(BLOCK_SIDE):
        if core.padded(reach_cells).contains(*at).any():
            inside = np.ascontiguousarray(points[:, core.contains(column, row)].T)
            blocks.append(cells_of_window(outer, core, options, [inside], keep=True))
    return blocks


def reach_near_cells(options: FilterOptions) -> int:
    """Return how far around points, in cells, more than the lowest of coarse cells matters."""
    steps = _steps_of_block(options)
    near = steps.reach(MINIMUM_GRID, steps.last) + 1
    return reach_of_cells(options) + near + wide_roofs.RULES.cells_per_side(options.cell)


def _lowest_of_cells(
    points: NDArray[np.float64], column: NDArray[np.int64], row: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the lowest points (m, 3) of the cells of points (3, n)."""
    window = GridWindow.enclosing(column, row)
    count = window.width * window.height
    if count <= len(column):
        number = window.flat_index(column, row)
    else:  # most cells are empty
        cells, number = np.unique(cell_keys(column, row), return_inverse=True)
        count = len(cells)
    low = lowest_points(points[0], points[1], points[2], number, count)
    return points[:, low[low >= 0]].T


def cells_of_window(
    outer: NDArray[np.float64],
    core: GridWindow,
    options: FilterOptions,
    points: Iterable[NDArray[np.float64]] = (),
    keep: bool = False,
) -> dict[str, NDArray[np.void]]:
    """Compute the cells of a window as :func:`cells_of_block` those of a block."""
    steps, classify = _steps_of_block(options), cell_steps(options)
    wanted = core.padded(1)  # points blend the four cells around them
    low = _in_cells(_thinned_far_away(outer, wanted, steps, options.cell), options)
    # Openings reach into cells without points.
    overhang = max([*options.requested_radii, 0]) + FILL_RINGS + 2
    near = wanted.padded(max(overhang, steps.reach(classify.last, PROVISIONAL)))
    if not near.contains(low.column, low.row).any():
        return {}
    window = GridWindow.enclosing(low.column, low.row).padded(overhang)
    kept: list[NDArray[np.float32]] = []
    raster = steps.run(low, holes(window), wanted, _cut_into(kept, wanted) if keep else None)
    means = ground_means(_judged(points, raster, options), options.cell, raster.window)
    records = _records(raster, core, means, options.requested_radii, kept[: len(classify.steps)])
    return _in_squares(records)


def _cut_into(kept: list[NDArray[np.float32]], wanted: GridWindow) -> Keep:
    """Return a function that adds the wanted cells of rasters to a list."""

    def add(_: str, window: GridWindow, values: NDArray[np.float32]) -> None:
        kept.append(values[wanted.intersect(window).slices_in(window)])

    return add


def _thinned_far_away(
    lowest: NDArray[np.float64], wanted: GridWindow, steps: Chain, cell: float
) -> NDArray[np.float64]:
    """Return the lowest points (n, 3) near wanted cells, and far away those of coarse cells alone.

    This halves the memory of a block.
    """
    coarse = wide_roofs.RULES.cells_per_side(cell)
    near = wanted.padded(steps.reach(MINIMUM_GRID, steps.last))
    left, bottom = near.left // coarse * coarse, near.bottom // coarse * coarse
    right, top = near.left + near.width, near.bottom + near.height
    inside = np.ones(len(lowest), bool)
    for axis, first, end in ((0, left, right), (1, bottom, top)):
        number = cell_numbers(lowest[:, axis], cell)
        inside &= (number >= first) & (number < -(-end // coarse) * coarse)
    far = lowest_of_coarse_cells(lowest[~inside], cell)
    return np.concatenate([lowest[inside], far])


def _in_cells(xyz: NDArray[np.float64], options: FilterOptions) -> GroundPoints:
    """Return points (n, 3), all of which may be ground, with their cells."""
    x, y, z = np.ascontiguousarray(xyz.T)
    return GroundPoints.in_cells(x, y, z, np.ones(len(x), bool), options.cell)


def _judged(
    parts: Iterable[NDArray[np.float64]], raster: GroundRaster, options: FilterOptions
) -> Iterator[tuple[GroundPoints, NDArray[np.bool_]]]:
    """Yield parts of points (n, 3), and which are ground by the surface of a raster."""
    assert raster.surface is not None
    for xyz in parts:
        points = _in_cells(xyz, options)
        x, y, z, _, _, row = points
        above = heights_above(x, y, z, row, raster.surface, options.cell, options.threads)
        yield points, options.is_ground(points.use, *above)


def _records(
    raster: GroundRaster,
    core: GridWindow,
    means: CellMeans,
    radii: list[int],
    kept: list[NDArray[np.float32]],
) -> NDArray[np.void]:
    """Return the records (n,) of the cells of a raster that lie in the core and are not empty."""
    held, places = means
    stacks = {
        name: np.stack(rasters, axis=-1) if rasters else np.zeros((*raster.shape, 0), np.float32)
        for name, rasters in (("opened", [raster.opened[r] for r in radii]), ("kept", kept))
    }
    filled = np.zeros(raster.shape, bool)
    filled[core.intersect(raster.window).slices_in(raster.window)] = True
    known = [held, np.isfinite(raster.lowest), *np.isfinite(kept[:1])]
    filled &= np.any([*known, np.isfinite(stacks["opened"]).any(axis=-1)], axis=0)
    j, i = np.nonzero(filled)
    cells = np.empty(len(j), _record(len(radii), len(kept)))
    for name in ("lowest", "floor", "ground", "place"):
        cells[name] = getattr(raster, name)[filled]
    for name, values in (("held", held), ("means", places), *stacks.items()):
        cells[name] = values[filled]
    cells["column"], cells["row"] = i + raster.window.left, j + raster.window.bottom
    return cells
