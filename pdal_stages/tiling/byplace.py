"""Copies of inputs in which points lie by place, so that a tile reads those near it, and not all compressed with them.

The points of a LAZ file can only be read 50,000 at a time, and these often lie in a long strip. Without copies a tile that
needs a hundred meters of its neighbors reads most of them. A copy is made while a file is read for its index, holds the
points as an uncompressed file does, each with its number, and is removed when all tiles are done. It is only ever a short
cut: where there is none, or it is not whole, the input is read itself.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.runs import begins_run
from .grid import Box, touching

#: Points that are put in order together, and those of a cell of this order, about.
_PART, _CELL = 1_000_000, 8_192
_CELLS = np.dtype(
    [("box", "<f8", 4), ("part", "<i8"), ("points", "<i8"), ("numbers", "<i8"), ("count", "<i8")]
)
_END = np.dtype([("cells", "<i8"), ("width", "<i8"), ("count", "<i8"), ("magic", "S8")])
_MAGIC = b"by place"


def copy_bytes(count: int, point_bytes: int) -> int:
    """About how large a copy of so many points gets, of so many bytes each."""
    return count * (point_bytes + np.dtype(np.int64).itemsize)


class CopyByPlace:
    """Writes a copy; one that finds no room on the disk is not there in the end.

    Parameters
    ----------
    path : str
        Empty: nothing is written.
    """

    def __init__(self, path: str) -> None:
        self.path = path
        self._partial = path + ".partial"
        self._file: Any = None
        self._cells: list[NDArray] = []
        self._waiting: list[tuple[NDArray, NDArray[np.float64], NDArray[np.float64]]] = []
        self._count = self._held = self._width = self._parts = 0

    def __enter__(self) -> CopyByPlace:
        if self.path:
            with contextlib.suppress(OSError):
                self._file = open(self._partial, "wb")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self._try(self._finish)
        if self._file is not None:
            self._drop()

    def add(self, points: NDArray, x: NDArray[np.float64], y: NDArray[np.float64]) -> None:
        """The next points of the file, as records, and where they are."""
        if self._file is not None:
            self._waiting.append((points, x, y))
            self._held += len(points)
            if self._held >= _PART:
                self._try(self._write)

    def _try(self, step: Any) -> None:
        if self._file is not None:
            try:
                step()
            except OSError:
                self._drop()

    def _drop(self) -> None:
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._file.close()
        self._file = None
        self._waiting = []
        with contextlib.suppress(OSError):
            os.unlink(self._partial)

    def _write(self) -> None:
        """Put what waits in order."""
        if not self._held:
            return
        points, x, y = (np.concatenate(part) for part in zip(*self._waiting, strict=True))
        self._waiting = []
        cells = max(1, len(x) // _CELL)
        wide, high = float(np.ptp(x)), float(np.ptp(y))
        side = max(np.sqrt(wide * high / cells), max(wide, high) / cells, 1e-9)
        across, along = ((v - v.min()) // side for v in (x, y))
        # At most about four times as many as were asked for: they fit 16 bits, which sorts quickly.
        key = (along * (across.max() + 1) + across).astype(np.uint16)
        order = np.argsort(key, kind="stable")
        starts = np.flatnonzero(begins_run(key[order]))
        found = np.empty(len(starts), _CELLS)
        for column, (values, ends) in enumerate(
            ((x, np.minimum), (y, np.minimum), (x, np.maximum), (y, np.maximum))
        ):
            found["box"][:, column] = ends.reduceat(values[order], starts)
        self._width = points.dtype.itemsize
        begin = self._file.tell()
        found["part"] = self._parts
        found["points"] = begin + starts * self._width
        found["numbers"] = begin + len(x) * self._width + starts * 8
        found["count"] = np.diff(np.append(starts, len(x)))
        self._file.write(np.take(points, order).view(np.uint8))  # half the time of points[order]
        self._file.write((order + self._count).astype("<i8", copy=False))
        self._cells.append(found)
        self._parts += 1
        self._count += len(x)
        self._held = 0

    def _finish(self) -> None:
        self._write()
        cells = np.concatenate([np.empty(0, _CELLS), *self._cells])
        end = np.array([(len(cells), self._width, self._count, _MAGIC)], _END)
        self._file.write(cells.tobytes() + end.tobytes())
        self._file.close()
        os.replace(self._partial, self.path)
        self._file = None


def points_in(path: str, count: int, box: Box) -> Iterator[tuple[NDArray[np.int64], NDArray]] | None:
    """Numbers, ascending, and records of points of a file with `count`, all in a box and some around, out of its copy.

    None where there is no copy that is whole.
    """
    try:
        with open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
            file.seek(size - _END.itemsize)
            (end,) = np.frombuffer(file.read(), _END)
            if end["magic"] != _MAGIC or end["count"] != count:
                return None
            file.seek(size - _END.itemsize - int(end["cells"]) * _CELLS.itemsize)
            cells = np.frombuffer(file.read(int(end["cells"]) * _CELLS.itemsize), _CELLS)
    except (OSError, ValueError):
        return None
    return _read(path, cells[touching(cells["box"], box)], int(end["width"]))


def _read(path: str, cells: NDArray, width: int) -> Iterator[tuple[NDArray[np.int64], NDArray]]:
    with open(path, "rb") as file:

        def taken(places: NDArray, counts: NDArray, dtype: np.dtype) -> NDArray:
            parts = []
            for place, count in zip(places.tolist(), counts.tolist(), strict=True):
                file.seek(place)
                parts.append(np.fromfile(file, dtype, count))
            return np.concatenate(parts)

        for part in np.unique(cells["part"]).tolist():
            mine = cells[cells["part"] == part]
            numbers = taken(mine["numbers"], mine["count"], np.dtype("<i8"))
            points = taken(mine["points"], mine["count"], np.dtype((np.void, width)))
            order = np.argsort(numbers, kind="stable")
            yield numbers[order], np.take(points, order)
