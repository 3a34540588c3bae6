"""The grid of square cells that all rooms share: numbers, keys, windows and neighbors of cells.

Cells are anchored to absolute coordinates: along each axis, cell i of a grid of `size` meters
holds the coordinates from i * size up to, but not including, (i + 1) * size. So every tile of a
cloud sees the same cells with the same points.

Order of axes: functions take (column, row), as x comes before y. Keys ascend row by row from the
south, and from west to east in a row. A raster is indexed [row, column], and its first row is the
southernmost.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from .errors import StageError

Integers = npt.NDArray[np.int64]

#: Largest number of a cell, either side of zero: doubles are exact up to twice this, so that sums
#: of two numbers are, too.
LARGEST_NUMBER = 2**52
#: Columns and rows of keys lie below this, either side of zero.
_KEY_LIMIT = 2**31 - 1
#: Bits of a key before the row, which the column takes.
_ROW_SHIFT = 32
#: Bits of a key before the layer: where there are layers, the row takes the 27 between.
_LAYER_SHIFT = 59
_LAYER_ROW_LIMIT = 2 ** (_LAYER_SHIFT - _ROW_SHIFT - 1)

#: Points whose compact keys are computed at a time: they stay in a core's cache.
_BATCH = 1 << 16
#: Axes of compact keys from the slowest to the fastest, by the number of axes.
_AXES = {2: (1, 0), 3: (1, 0, 2)}


def cell_numbers(coordinate: npt.NDArray[np.float64], size: float) -> Integers:
    """Return the number of the cell along one axis that each coordinate lies in.

    Parameters
    ----------
    coordinate : array of float64
        Any shape; in the unit of `size`.
    size : float
        Side of a cell. Divisions by powers of two are exact.

    Raises
    ------
    StageError
        For coordinates that no survey has, NaN too.
    """
    number = np.asarray(coordinate / size)
    np.floor(number, out=number)
    _refuse_beyond(number, LARGEST_NUMBER)
    return number.astype(np.int64)


def _refuse_beyond(number: npt.NDArray, limit: int) -> None:
    if number.size and not max(-number.min(), number.max()) < limit:
        raise StageError(
            "coordinates are too large for the grid",
            found=f"a cell number of {float(np.abs(number).max()):.3g}",
            cure="Remove stray points (filters.crop or filters.range), or use a larger cell",
        )


def cell_keys(column: npt.NDArray, row: npt.NDArray, layer: npt.NDArray | int = 0) -> Integers:
    """Return one number for each cell, ascending by layer, row and column.

    Parameters
    ----------
    column, row : arrays of int64
        One shape, below 2**31 - 1 either side of zero.
    layer : int or array of int64
        From 0 to 7: keeps cells of several kinds apart. Rows lie below 2**26 then.

    Raises
    ------
    StageError
        For cells that keys cannot hold.
    """
    _refuse_beyond(column, _KEY_LIMIT)
    _refuse_beyond(row, _LAYER_ROW_LIMIT if np.any(layer) else _KEY_LIMIT)
    return (np.asarray(layer, np.int64) << _LAYER_SHIFT) + (row << _ROW_SHIFT) + (column + 2**31)


def key_offset(columns: int, rows: int) -> int:
    """Return what leads from the key of a cell to that of the cell `columns` and `rows` further."""
    return (rows << _ROW_SHIFT) + columns


def cells_around(keys: Integers) -> Integers:
    """Return the keys, ascending and each once, of some cells and of those that touch them."""
    offsets = [key_offset(column, row) for column in (-1, 0, 1) for row in (-1, 0, 1)]
    return np.unique(np.add.outer(np.unique(keys), offsets))


def split_keys(keys: Integers) -> tuple[Integers, Integers, Integers]:
    """Return column, row and layer of keys of cells, whose rows lie below 2**26."""
    layer = (keys + (1 << (_LAYER_SHIFT - 1))) >> _LAYER_SHIFT
    keys = keys - (layer << _LAYER_SHIFT)
    return (keys & (2**_ROW_SHIFT - 1)) - 2**31, keys >> _ROW_SHIFT, layer


def begins_run(ascending: npt.NDArray) -> npt.NDArray[np.bool_]:
    """Return which values of a sorted array (n,) differ from the one before."""
    new = np.ones(len(ascending), np.bool_)
    np.not_equal(ascending[1:], ascending[:-1], out=new[1:])
    return new


def group_by_key(key: Integers) -> list[Integers]:
    """Return the indices of each group of equal keys (n,), by ascending key, then index."""
    order = np.argsort(key, kind="stable")
    return np.split(order, np.flatnonzero(begins_run(key[order]))[1:]) if len(key) else []


def places_among(
    ascending: npt.NDArray, wanted: npt.NDArray
) -> tuple[Integers, npt.NDArray[np.bool_]]:
    """Return the index of each wanted value in a non-empty ascending array, and if it is there."""
    place = np.minimum(np.searchsorted(ascending, wanted), len(ascending) - 1)
    return place, ascending[place] == wanted


class GridWindow(NamedTuple):
    """A rectangle of cells: its first column and row, and how many of them it has."""

    left: int
    bottom: int
    width: int
    height: int

    @classmethod
    def enclosing(cls, column: npt.NDArray, row: npt.NDArray) -> GridWindow:
        """Return the smallest window with all of some cells, empty where there are none."""
        if not (column.size and row.size):
            return cls(0, 0, 0, 0)
        left, bottom = int(column.min()), int(row.min())
        return cls(left, bottom, int(column.max()) + 1 - left, int(row.max()) + 1 - bottom)

    @classmethod
    def union(cls, windows: Iterable[GridWindow]) -> GridWindow:
        """Return the smallest window with the cells of all windows."""
        boxes = [
            (w.left, w.bottom, w.left + w.width, w.bottom + w.height) for w in windows if w.width
        ]
        left, bottom, right, top = np.array(boxes, np.int64).reshape(-1, 4).T
        return cls.enclosing(np.append(left, right - 1), np.append(bottom, top - 1))

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of a raster of the window: (rows, columns)."""
        return self.height, self.width

    def padded(self, cells: int) -> GridWindow:
        """Return the window with `cells` more on every side."""
        return GridWindow(
            self.left - cells, self.bottom - cells, self.width + 2 * cells, self.height + 2 * cells
        )

    def contains(self, column: Any, row: Any) -> Any:
        """Return which cells, arrays or numbers, lie in the window."""
        inside = (column >= self.left) & (column < self.left + self.width)
        return inside & (row >= self.bottom) & (row < self.bottom + self.height)

    def flat_index(self, column: npt.NDArray, row: npt.NDArray) -> npt.NDArray:
        """Return the index of cells in a flattened raster of the window."""
        return (row - self.bottom) * self.width + column - self.left

    def intersect(self, other: GridWindow) -> GridWindow:
        """Return the window of the cells that lie in both; one of no cells where there are none."""
        left, bottom = max(self.left, other.left), max(self.bottom, other.bottom)
        right = min(self.left + self.width, other.left + other.width)
        top = min(self.bottom + self.height, other.bottom + other.height)
        return GridWindow(left, bottom, max(right - left, 0), max(top - bottom, 0))

    def pieces(self, side: int) -> Iterator[GridWindow]:
        """Yield windows of at most `side` columns and rows that it consists of."""
        for bottom in range(self.bottom, self.bottom + self.height, side):
            for left in range(self.left, self.left + self.width, side):
                yield GridWindow(left, bottom, side, side).intersect(self)

    def slices_in(self, other: GridWindow) -> tuple[slice, slice]:
        """Return the rows and columns of this window in a raster of another one, which holds it."""
        j, i = self.bottom - other.bottom, self.left - other.left
        return slice(j, j + self.height), slice(i, i + self.width)


def compact_keys(coordinates: npt.NDArray[np.float64], size: float) -> tuple[Integers, Integers]:
    """Return keys of points' cells that are as small as the cloud allows, and offsets of neighbors.

    They serve sorting, not comparison between clouds: they count from the cloud's own first cell,
    so that few bits are needed.

    Parameters
    ----------
    coordinates : (n, 2) or (n, 3) array of float64
        Finite; three make cubes.
    size : float
        Side of a cell in the same unit.

    Returns
    -------
    keys : (n,) int64
        They ascend by row, column and height; cells side by side along the last axis follow each
        other.
    offsets : (3,) or (9,) int64
        Added to a key, they give the middle cells of the lines of three around its cell.

    Raises
    ------
    StageError
        For a cloud so wide that keys would need more than 62 bits.
    """
    axes, n = _AXES[coordinates.shape[1]], len(coordinates)
    spans = np.array(
        [[coordinates[:, k].min(), coordinates[:, k].max()] if n else [0.0, 0.0] for k in axes]
    )
    first, last = cell_numbers(spans, size).T
    # One empty cell beside the last, so that no cell has neighbors at the other end of the grid.
    lengths = [int(length) + 2 for length in last - first]
    _refuse_beyond(np.array([np.prod(np.array(lengths, float))]), 2**62)
    keys = np.empty(n, np.int64)
    for start in range(0, n, _BATCH):
        batch = slice(start, start + _BATCH)
        key: Integers | int = 0
        for place, (k, length) in enumerate(zip(axes, lengths, strict=True)):
            key = key * length + cell_numbers(coordinates[batch, k], size) - first[place]
        keys[batch] = key
    steps = [1]
    for length in lengths[1:]:
        steps = [step * length for step in steps] + [1]
    offsets = np.zeros(1, np.int64)
    for step in steps[:-1]:
        offsets = np.add.outer(offsets, np.array([-step, 0, step])).reshape(-1)
    return keys, np.sort(offsets)
