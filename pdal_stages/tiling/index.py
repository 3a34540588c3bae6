"""The first reading of an input: its points are sorted by place into an uncompressed copy, of which tiles read what is near.

A LAZ file can only be read in chunks of 50,000 points, which often lie in a long strip. Tiles read most points several
times (for the first round, as surroundings of their neighbors), so they read the copy. It is removed when the run is done.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..base.errors import StageError
from ..base.runs import begins_run
from .grid import Box, TileGrid, check_number
from .lasfiles import header_of, record_blocks

#: Points that are sorted together.
_PART = 1_000_000
#: The points are sorted by cells of this share of a tile.
_SHARE = 0.25


@dataclass(frozen=True)
class CloudIndex:
    """Where the points of a file lie."""

    count: int
    box: Box  #: of all points
    tiles: list[tuple[int, int, int]]  #: column, row and number of points of each tile
    cells: NDArray[np.int64]  #: (n, 4): column, row, place of the first point in the copy, number of points
    copy: str  #: the file with the points


def copy_type(header) -> np.dtype:
    """How the copy of a file holds a point: its number in the file, and its record."""
    return np.dtype([("number", "<i8"), ("record", header.point_format.dtype())])


def sort_points(path: str, grid: TileGrid, copy: str) -> CloudIndex:
    """Read a file once, write its points into `copy`, sorted by place, and say where they lie.

    Raises
    ------
    StageError
        If any of it cannot be read, or the copy cannot be written.
    """
    header = header_of(path)
    dtype, cells = copy_type(header), TileGrid(grid.size * _SHARE)
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    tiles: Counter[tuple[int, int]] = Counter()
    found = [np.empty((0, 4), np.int64)]
    total = 0
    try:
        with open(f"{copy}.partial", "wb") as out:
            for records in record_blocks(path, most=_PART):
                x, y = coordinates(records, header)
                low = np.minimum(low, (x.min(), y.min()))
                high = np.maximum(high, (x.max(), y.max()))
                order, starts = _groups(cells.index(x), cells.index(y))
                rows = np.empty(len(records), dtype)
                rows["number"] = total + order
                rows["record"] = records[order]
                out.write(rows.tobytes())
                first, counts = order[starts], np.diff([*starts, len(order)])
                found.append(
                    np.column_stack([cells.index(x[first]), cells.index(y[first]), total + starts, counts])
                )
                columns, lines = grid.index(x), grid.index(y)
                order, starts = _groups(columns, lines)
                for at, number in zip(order[starts], np.diff([*starts, len(order)]).tolist(), strict=True):
                    tiles[int(columns[at]), int(lines[at])] += number
                check_number(len(tiles), f"{path}, tiles of {grid.size:g}")
                total += len(records)
        os.replace(f"{copy}.partial", copy)
    except OSError as error:
        raise StageError(
            "the points could not be copied into the run's folder",
            where=path,
            found=f"{copy}: {error.strerror or error}",
            cure="Make room on the disk: --dry-run says how much is needed",
        ) from error
    box = (*low.tolist(), *high.tolist())
    return CloudIndex(
        total, box, [(i, j, n) for (i, j), n in sorted(tiles.items())], np.concatenate(found), copy
    )


def coordinates(records: NDArray, header) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """x and y of records."""
    x, y = (records[name] * header.scales[k] + header.offsets[k] for k, name in enumerate("XY"))
    return x, y


def _groups(column: NDArray[np.int64], row: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The order (n,) that puts points of one cell together, and where each cell begins in it."""
    order = np.lexsort((column, row))
    return order, np.flatnonzero(begins_run(column[order]) | begins_run(row[order]))


def points_near(path: str, index: CloudIndex, grid: TileGrid, box: Box) -> tuple[NDArray[np.int64], NDArray]:
    """Numbers, ascending, and records of the points of a file that lie in a box, edges included."""
    cells, header = TileGrid(grid.size * _SHARE), header_of(path)
    (i0, j0), (i1, j1) = (cells.index(np.array(corner)).tolist() for corner in (box[:2], box[2:]))
    i, j = index.cells[:, 0], index.cells[:, 1]
    near = index.cells[(i >= i0) & (i <= i1) & (j >= j0) & (j <= j1)]
    dtype = copy_type(header)
    try:
        rows = np.concatenate([np.empty(0, dtype), *_read(index.copy, near, dtype)])
    except OSError as error:
        raise StageError("the copy of an input cannot be read", where=path, found=error) from error
    x, y = coordinates(rows["record"], header)
    rows = rows[(x >= box[0]) & (x <= box[2]) & (y >= box[1]) & (y <= box[3])]
    rows = rows[np.argsort(rows["number"])]
    return np.ascontiguousarray(rows["number"]), np.ascontiguousarray(rows["record"])


def _read(copy: str, cells: NDArray[np.int64], dtype: np.dtype) -> Iterator[NDArray]:
    with open(copy, "rb") as file:
        for _, _, first, count in cells.tolist():
            file.seek(first * dtype.itemsize)
            yield np.fromfile(file, dtype, count)
