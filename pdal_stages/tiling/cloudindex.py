"""An index of a LAS or LAZ file: where its blocks of points lie, and how many points each tile has."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..base.errors import StageError
from .grid import Box, Grid, touch

#: Points of a block: LAZ is compressed in pieces of so many.
BLOCK = 50_000


def open_las(path: str):
    """The file, for reading; StageError with the reason where it cannot be."""
    import laspy

    try:
        return laspy.open(path)
    except OSError as error:
        raise StageError("the input cannot be read", where=path, found=error.strerror or str(error)) from None
    except Exception as error:  # laspy and the decompressor raise many types
        raise StageError(
            "the input cannot be read", where=path, found=f"{type(error).__name__}: {error}"
        ) from None


def read_block(reader: Any, path: str, start: int, count: int):
    """`count` points from number `start`; StageError where the file is cut short or damaged."""
    try:
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


def index_las(path: str, size: float) -> dict[str, Any]:
    """Read a file once and describe it.

    Parameters
    ----------
    path : str
    size : float
        Side of the tiles.

    Returns
    -------
    dict
        ``count``; ``boxes``, the bounding box of each block of 50,000 points; ``tiles``, a list of
        (i, j, points).

    Raises
    ------
    StageError
        If any of it cannot be read.
    """
    grid = Grid(size)
    boxes: list[Box] = []
    tiles: dict[tuple[int, int], int] = {}
    with open_las(path) as reader:
        total = int(reader.header.point_count)
        for start in range(0, total, BLOCK):
            points = read_block(reader, path, start, min(BLOCK, total - start))
            x, y = np.asarray(points.x), np.asarray(points.y)
            boxes.append((float(x.min()), float(y.min()), float(x.max()), float(y.max())))
            pairs, counts = np.unique(
                np.column_stack([grid.index(x), grid.index(y)]), axis=0, return_counts=True
            )
            for (i, j), number in zip(pairs.tolist(), counts.tolist(), strict=True):
                tiles[i, j] = tiles.get((i, j), 0) + number
    return {
        "count": total,
        "boxes": boxes,
        "tiles": [[i, j, n] for (i, j), n in sorted(tiles.items())],
    }


def runs(boxes: list[Box], box: Box) -> list[tuple[int, int]]:
    """Blocks (first, one after the last) that may hold points of a box."""
    out: list[tuple[int, int]] = []
    for number, one in enumerate(boxes):
        if touch(one, box):
            if out and out[-1][1] == number:
                out[-1] = (out[-1][0], number + 1)
            else:
                out.append((number, number + 1))
    return out
