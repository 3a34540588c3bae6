"""Sort points of inputs by location into an uncompressed copy, and cut tiles from it.

A LAZ file can only be read in chunks of 50,000 points, often along a flight line. Tiles read most
points several times (in each round, as halo of their neighbors), so they read the copy. It is
removed at the end of the run.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..base.files import whole_files
from ..base.grid import begins_run
from ..base.hashing import digest_of_file
from ..base.las_check import beyond_box
from ..base.las_points import Layout, read_records
from ..terrain.pieces import refuse_scattered
from .inputs import CloudIndex, InputSource, sum_points
from .options import Box, TileGrid, check_number

#: Points that are sorted at a time, to bound memory (not tuned).
_PART = 1_000_000
#: The points are sorted by cells; this many make up the side of a tile. A power of two, so that
#: tiles are whole cells in floats, too. Finer cells: fewer points are read in vain, in more places
#: of the file; not tuned.
_CELLS = 4


# ---- the copy, sorted by location ----------------------------------------------------------------


def _copy_type(layout: Layout) -> np.dtype:
    """Return the type of a point in the copy: its number in the file, and its record."""
    return np.dtype([("number", "<i8"), ("record", layout.dtype)])


def sort_points(path: str, grid: TileGrid, lone_grid: TileGrid, target: str) -> CloudIndex:
    """Read a file once, write its points into a sorted copy, and return their index.

    `lone_grid` is :attr:`.Survey.lone_grid`. WriteError where the copy cannot be written.
    """
    layout = Layout.of_file(path)
    dtype, cells = _copy_type(layout), grid.scaled(1 / _CELLS)
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    parts, held_squares = [np.empty((0, 4), np.int64)], [np.empty((0, 3), np.int64)]
    total = 0
    changed_ns, digest = os.stat(path).st_ctime_ns, digest_of_file(path)
    with whole_files(target, what="temporary") as (partial,), open(partial, "wb") as out:
        for records in read_records(path, layout, most=_PART):
            x, y = (layout.fields[axis].read(records) for axis in "XY")
            low = np.minimum(low, (x.min(), y.min()))
            high = np.maximum(high, (x.max(), y.max()))
            column, line = cells.index(x), cells.index(y)
            order = np.lexsort((column, line))
            rows = np.empty(len(records), dtype)
            rows["number"] = total + order
            rows["record"] = records[order]
            out.write(rows.tobytes())
            starts, counts = _runs(column[order], line[order])
            first = order[starts]
            parts.append(np.column_stack([column[first], line[first], total + starts, counts]))
            column, line = lone_grid.index(x)[order], lone_grid.index(y)[order]
            starts, counts = _runs(column, line)
            held_squares.append(np.column_stack([column[starts], line[starts], counts]))
            total += len(records)
        held = np.concatenate(parts)
        # Cells divide tiles exactly: powers of two do in floats.
        tiles = sum_points(np.column_stack([held[:, :2] // _CELLS, held[:, 3]]))
        check_number(len(tiles), f"{path}, tiles of {grid.size:g}")
    squares = sum_points(np.concatenate(held_squares))
    refuse_scattered(squares[:, 2].tolist())
    box = (*low.tolist(), *high.tolist())
    places = [(i, j, n) for i, j, n in tiles.tolist()]
    warning = (beyond_box(path, box) if total else None) or ""
    return CloudIndex(total, box, places, held, cells, digest, changed_ns, squares, warning, target)


def _runs(
    column: NDArray[np.int64], row: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the first (m,) of points that follow each other in a square, and their number."""
    starts = np.flatnonzero(begins_run(column) | begins_run(row))
    return starts, np.diff([*starts, len(column)])


def points_near(layout: Layout, index: CloudIndex, box: Box) -> tuple[NDArray[np.int64], NDArray]:
    """Return numbers (n,), ascending, and records (n,) of the points in a box, with its edges."""
    (i0, j0), (i1, j1) = (
        index.grid.index(np.array(corner)).tolist() for corner in (box[:2], box[2:])
    )
    i, j = index.cells[:, 0], index.cells[:, 1]
    near = index.cells[(i >= i0) & (i <= i1) & (j >= j0) & (j <= j1)]
    dtype = _copy_type(layout)
    parts = [np.empty(0, dtype)]
    with open(index.copy, "rb") as file:
        for _, _, first, count in near.tolist():
            file.seek(first * dtype.itemsize)
            parts.append(np.fromfile(file, dtype, count))
    rows = np.concatenate(parts)
    x, y = (layout.fields[axis].read(rows["record"]) for axis in "XY")
    rows = rows[(x >= box[0]) & (x <= box[2]) & (y >= box[1]) & (y <= box[3])]
    rows = rows[np.argsort(rows["number"])]
    return np.ascontiguousarray(rows["number"]), np.ascontiguousarray(rows["record"])


# ---- a tile and its halo -------------------------------------------------------------------------


@dataclass
class Piece:
    """Points of one input in a tile and around it, in their order."""

    source: InputSource
    layout: Layout
    records: NDArray  #: (n,)
    index: NDArray[np.int64]  #: (n,) number of each point in its input file
    #: (n,) distance outside the tile along the farther axis, in the unit of the coordinates; -1
    #: inside
    away: NDArray[np.float64]

    @cached_property
    def own_rows(self) -> NDArray[np.int64]:
        """Return the rows of the tile's own points."""
        return np.flatnonzero(self.away < 0)


def cut_all(
    grid: TileGrid,
    tile: tuple[int, int],
    sources: Sequence[InputSource],
    halo_units: float,
) -> list[Piece]:
    """Return the points of a tile and its halo, from every input that has any there.

    `halo_units` is in the unit of the coordinates.
    """
    box, inner = grid.box(tile, halo_units), grid.box(tile)
    pieces = []
    for source in sources:
        assert source.index is not None
        layout = source.layout
        numbers, records = points_near(layout, source.index, box)
        if not len(records):
            continue
        x, y = (layout.fields[axis].read(records) for axis in "XY")
        places = np.column_stack([grid.index(x), grid.index(y)])
        away = np.maximum(inner[0] - x, x - inner[2])
        away = np.maximum(away, np.maximum(inner[1] - y, y - inner[3]))
        away = np.where((places == tile).all(axis=1), -1.0, np.maximum(away, 0.0))
        pieces.append(Piece(source, layout, records, numbers, away))
    return pieces
