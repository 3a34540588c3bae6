"""An index of a LAS or LAZ file: where its blocks of points lie, and how many points each tile has."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .byplace import CopyByPlace
from .grid import Box, TileGrid, check_number
from .lasfiles import all_points

#: Points of a file at most that a worker keeps in memory; 2,048 such files hold 250 MB or less.
SMALL = 2_500


@dataclass(frozen=True)
class CloudIndex:
    """Where the points of a file lie."""

    count: int
    boxes: NDArray[np.float64]  #: (n, 4) of each block of 50,000 points: a country has millions of them
    tiles: list[tuple[int, int, int]]  #: column, row and number of points of each tile
    copy: str = ""  #: a copy of the file by place, see :mod:`.byplace`; empty where none was made


def index_las(path: str, grid: TileGrid, copy: str = "") -> CloudIndex:
    """Read a file once and say where its points lie; `copy`: a file for a copy by place, empty for none.

    Raises
    ------
    StageError
        If any of it cannot be read.
    """
    boxes: list[Box] = []
    tiles: Counter[tuple[int, int]] = Counter()
    total = 0
    with CopyByPlace(copy) as copying:
        for array, x, y in all_points(path):
            boxes.append((float(x.min()), float(y.min()), float(x.max()), float(y.max())))
            only = grid.only(x, y)
            if only is not None:
                tiles[only] += len(x)
            else:
                for i, j, number in counted(grid.index(x), grid.index(y)):
                    tiles[i, j] += number
            check_number(len(tiles), f"{path}, tiles of {grid.size:g}")
            copying.add(array, x, y)
            total += len(x)
    return CloudIndex(
        total,
        np.array(boxes, np.float64).reshape(-1, 4),
        [(i, j, n) for (i, j), n in sorted(tiles.items())],
        copy,
    )


def counted(column: NDArray[np.int64], row: NDArray[np.int64]) -> list[tuple[int, int, int]]:
    """Every pair of a column and a row (n,) that there is, row by row, and how often."""
    if not column.size:
        return []
    left, bottom = int(column.min()), int(row.min())
    across, along = int(column.max()) - left + 1, int(row.max()) - bottom + 1
    if across * along <= 4 * len(column):
        counts = np.bincount((row - bottom) * across + (column - left))
        at = np.flatnonzero(counts)
        pairs = np.column_stack([at % across + left, at // across + bottom])
        counts = counts[at]
    else:  # strays
        pairs, counts = np.unique(np.column_stack([row, column]), axis=0, return_counts=True)
        pairs = pairs[:, ::-1]
    return [(i, j, n) for (i, j), n in zip(pairs.tolist(), counts.tolist(), strict=True)]
