"""Points of LAS files in boxes, of which only the parts are read that hold them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .columns import LazyColumns
from .las_check import beyond_box
from .las_points import LasColumns, Layout, read_records

#: West, south, east, north.
Box = Sequence[float]
#: Points of a file that are compared with the box in its header.
_PROBED = 1000
#: Points of a chunk of a LAZ file, as a rule: a part is read from the beginning of one.
_CHUNK = 50_000


@dataclass(eq=False)
class FilePoints(LazyColumns):
    """The dimensions of some points of files, which are read when they are asked for."""

    files: Sequence[str]
    layouts: Mapping[int, Layout]  #: by the number of the file; of those that hold points
    file: NDArray[np.int64]  #: (n,) number of each point's file, ascending
    number: NDArray[np.int64]  #: (n,) number of each point in its file, ascending for each
    columns: dict[str, NDArray]  #: (n,) dimensions that were read

    @cached_property
    def names(self) -> Collection[str]:  # type: ignore[override]
        """Return the names of the dimensions."""
        return dict.fromkeys(n for layout in self.layouts.values() for n in layout.fields).keys()

    def __getitem__(self, name: str) -> NDArray:
        """Return a dimension (n,)."""
        if name in self and name not in self.columns:
            self.load([name])
        return self.columns[name]

    def take(self, rows: NDArray[np.int64]) -> FilePoints:
        """Return some of the points, in their order."""
        columns = {name: values[rows] for name, values in self.columns.items()}
        return replace(self, file=self.file[rows], number=self.number[rows], columns=columns)

    def load(self, names: Collection[str]) -> None:
        """Read dimensions, all in one pass over the parts of files that hold points."""
        wanted = [name for name in names if name in self and name not in self.columns]
        parts: list[tuple[Layout, str | NDArray]] = []
        for index, layout in self.layouts.items():
            rows = self.number[self.file == index]
            for first, end in _runs(rows // _CHUNK):
                at, last = first * _CHUNK, min(end * _CHUNK, layout.header.count)
                for records in read_records(self.files[index], layout, at, last, only=wanted):
                    low, high = np.searchsorted(rows, (at, at + len(records)))
                    parts.append((layout, records[rows[low:high] - at]))
                    at += len(records)
        columns = LasColumns(parts)
        self.columns |= {name: columns[name] for name in wanted}


def read_around(
    files: Sequence[str],
    near: Box,
    far: Box,
    inner: Box,
    names: Collection[str] | None,
    see_far: Callable[[LasColumns], None],
) -> FilePoints:
    """Return the points in a box, of files that are read once.

    Parameters
    ----------
    files : sequence of str
    near, far, inner : sequence of float
        Boxes in the unit of the coordinates: of the points that are returned, of those that
        matter, and of those that `see_far` does not receive.
    names : collection of str, optional
        Dimensions that are read at once, where a file has them; by default all.
    see_far : callable
        Receives the points of the box `far` outside the box `inner`, in parts.
    """
    layouts, parts = {}, []
    held: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = []
    for index, path in enumerate(files):
        layout, at = Layout.of_file(path), 0
        if _is_apart(path, layout, far):
            continue
        only = None if names is None else [name for name in names if name in layout.fields]
        layouts[index] = layout
        for records in read_records(path, layout, only=only):
            x, y = (layout.fields[axis].read(records) for axis in "XY")
            rows = np.flatnonzero(inside_box(x, y, near))
            held.append((np.full(len(rows), index), at + rows))
            parts.append((layout, records if len(rows) == len(records) else records[rows]))
            outside = np.flatnonzero(inside_box(x, y, far) & ~inside_box(x, y, inner))
            if len(outside):
                see_far(LasColumns([(layout, records[outside])]))
            at += len(records)
    columns = LasColumns(parts)
    kept = [name for name in (names or columns.names) if name in columns]
    file, number = (
        np.concatenate([np.zeros(0, np.int64), *values])
        for values in (zip(*held, strict=True) if held else ((), ()))
    )
    return FilePoints(files, layouts, file, number, {name: columns[name] for name in kept})


def box_around(xy: NDArray[np.float64], reach: float) -> Box:
    """Return the box of places (n, 2), wider by a reach."""
    return [*(xy.min(axis=0) - reach), *(xy.max(axis=0) + reach)]


def inside_box(x: NDArray[np.float64], y: NDArray[np.float64], box: Box) -> NDArray[np.bool_]:
    """Return which points (n,) lie in a box."""
    return (x >= box[0]) & (x <= box[2]) & (y >= box[1]) & (y <= box[3])


def _is_apart(path: str, layout: Layout, box: Box) -> bool:
    """Return whether a file has no point in a box, by its header.

    Where its first points lie outside the box of the header, it may have some.
    """
    x0, y0, x1, y1 = layout.header.box
    if x0 <= box[2] and x1 >= box[0] and y0 <= box[3] and y1 >= box[1]:
        return False
    for records in read_records(path, layout, 0, min(_PROBED, layout.header.count), only=["X"]):
        x, y = (layout.fields[axis].read(records) for axis in "XY")
        return beyond_box(path, (x.min(), y.min(), x.max(), y.max())) is None
    return True


def _runs(numbers: NDArray[np.int64]) -> Iterator[tuple[int, int]]:
    """Yield the first of ascending numbers (n,) that follow each other, and the end after them."""
    distinct = np.unique(numbers)
    ends = np.flatnonzero(np.diff(distinct) > 1) + 1
    for run in np.split(distinct, ends) if len(distinct) else ():
        yield int(run[0]), int(run[-1]) + 1
