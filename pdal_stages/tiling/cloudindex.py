"""An index of a LAS or LAZ file: where its blocks of points lie, and how many points each tile has."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.errors import StageError
from ..base.lean import imported
from .byplace import CopyByPlace
from .grid import Box, TileGrid, check_number

#: Points of a block: LAZ is compressed in pieces of so many.
BLOCK = 50_000
#: Points of a file at most that a worker keeps in memory; 2,048 such files hold 250 MB or less.
SMALL = 2_500


@dataclass(frozen=True)
class CloudIndex:
    """Where the points of a file lie."""

    count: int
    boxes: NDArray[np.float64]  #: (n, 4) of each block of 50,000 points: a country has millions of them
    tiles: list[tuple[int, int, int]]  #: column, row and number of points of each tile
    copy: str = ""  #: a copy of the file by place, see :mod:`.byplace`; empty where none was made


def open_las(path: str, only: Sequence[str] = ()):
    """The file, for reading; StageError with the reason where it cannot be.

    `only`: the dimensions that are needed beside X, Y and the returns, by laspy's names of its selections (``Z``,
    ``CLASSIFICATION``, ...): LAZ 1.4 holds them apart, so the others take no time. They hold nothing then.
    """
    laspy = imported("laspy")
    more = {}
    if only:
        wanted = laspy.DecompressionSelection.base()
        for name in only:
            wanted |= laspy.DecompressionSelection[name]
        more["decompression_selection"] = wanted
    try:
        return laspy.open(path, **more)
    except Exception as error:  # laspy and the decompressor raise many types
        found = error if isinstance(error, OSError) else f"{type(error).__name__}: {error}"
        raise StageError("the input cannot be read", where=path, found=found) from None


def read_block(reader: Any, path: str, start: int, end: int):
    """Points from number `start` to `end`, a block at most; StageError where the file is cut short or damaged."""
    count = min(BLOCK, end - start)
    try:
        if reader.points_read != start:  # seeking to where one is costs, and forgets what is wanted
            reader.seek(start)
        points = reader.read_points(count)
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt | MemoryError):
            raise
        raise StageError(
            "the input is damaged", where=path, found=f"{type(error).__name__} at point {start:,}: {error}"
        ) from None
    if len(points) != count:
        raise StageError(
            "the input is cut short", where=path, found=f"it ends before point {start + count:,}"
        )
    return points


def index_las(path: str, grid: TileGrid, copy: str = "") -> CloudIndex:
    """Read a file once and say where its points lie; `copy`: a file for a copy by place, empty for none.

    Raises
    ------
    StageError
        If any of it cannot be read.
    """
    boxes: list[Box] = []
    tiles: Counter[tuple[int, int]] = Counter()
    with open_las(path) as reader, CopyByPlace(copy) as copying:
        total = int(reader.header.point_count)
        for start in range(0, total, BLOCK):
            points = read_block(reader, path, start, total)
            x, y = np.asarray(points.x), np.asarray(points.y)
            boxes.append((float(x.min()), float(y.min()), float(x.max()), float(y.max())))
            for i, j, number in counted(grid.index(x), grid.index(y)):
                tiles[i, j] += number
            check_number(len(tiles), f"{path}, tiles of {grid.size:g}")
            copying.add(points.array, x, y)
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
