"""Records of grid cells: counts, heights and reliabilities of the points of each kind in each cell.

All values are whole numbers, so the order of points changes nothing. Records of the same cell are
joined by adding and comparing, so files may be read one after the other, in parts or in parallel,
and overlapping areas joined afterwards.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from ..base.asprs import NOISE, TERRAIN, WIRES
from ..base.errors import StageError
from ..base.grid import GridWindow, begins_run, cell_keys, cell_numbers, split_keys


class Kind(IntEnum):
    """Kind of the points of a record: the layer of a key, and the first part of ids."""

    GROUND = 0
    BUILDING = 1
    TREE = 2
    SPAN = 3
    DECK = 4
    OTHER = 5  #: classes that form no object; they show that the laser saw something there


#: ASPRS classes of each kind.
CLASSES: dict[Kind, tuple[int, ...]] = {
    Kind.GROUND: TERRAIN,
    Kind.BUILDING: (6,),
    Kind.TREE: (4, 5),
    Kind.SPAN: WIRES,
    Kind.DECK: (17,),
}
#: Width of a cell of the ground, in cells of the other kinds: ground below objects is sparse.
GROUND_WIDTH = 2
#: Heights are stored in millimeters.
MM = 1000.0
#: Reliabilities are stored in thousandths.
THOUSANDTHS = 1000.0
#: Mean points of the cells that hold any below which cells are too small: roofs fall apart (see
#: `sparse_kind`). One point a cell at random gives 1.58, and leaves 37 % of the cells empty.
MIN_POINTS_PER_CELL = 1.6
#: A kind with no more cells does not decide whether cells are too small; not tuned.
MIN_CELLS = 100
#: Smallest column that a key can hold.
_WESTMOST = 2 - 2**31
#: Columns of records: type, and the function that joins two records of one cell.
_COLUMNS: dict[str, tuple[type, np.ufunc]] = {
    "count": (np.int32, np.add),  # points
    "low": (np.int32, np.minimum),  # z of the lowest point, mm
    "high": (np.int32, np.maximum),  # z of the highest point, mm
    "sum": (np.int64, np.add),  # sum of z, mm
    "reliability": (np.int64, np.add),  # sum of reliabilities, thousandths
    "rated": (np.int32, np.add),  # points with a reliability
}


def object_id(kind: NDArray | int, row: NDArray | int, column: NDArray | int) -> NDArray[np.int64]:
    """Return ids of objects from the cell that represents each.

    Ids are below 2**53, so they are exact in JSON and as a double. Rows and columns are taken
    modulo 2**25: at 0.5 m, two places with the same id lie 16,777 km apart.
    """
    unit, low = np.int64(1), np.int64((1 << 25) - 1)
    row, column = np.asarray(row, np.int64), np.asarray(column, np.int64)
    return (np.asarray(kind, np.int64) * (unit << 50)) | ((row & low) << 25) | (column & low)


def kind_of_code(classes: Mapping[Kind, Sequence[int]]) -> NDArray[np.int8]:
    """Return the kind of each class code, (256,); -1 for codes of no kind."""
    table = np.full(256, -1, np.int8)
    for kind, codes in classes.items():
        for code in codes:
            if table[code] >= 0:
                other = Kind(table[code]).name.lower()
                raise StageError(
                    f"class {code} cannot stand for {other} and {kind.name.lower()}",
                    cure="Give each class one kind of object",
                )
            table[code] = kind
    return table


#: Values of records (n,): count, low, high, sum, reliability, rated (see `_COLUMNS`).
Values = dict[str, NDArray]


def _no_values() -> Values:
    return {name: np.empty(0, kind) for name, (kind, _) in _COLUMNS.items()}


def _joined(values: Values, order: NDArray[np.int64], first: NDArray[np.int64]) -> Values:
    """Return values of records (n,) in an order, of which those from each `first` on are joined."""
    return {
        name: join.reduceat(values[name][order], first, dtype=kind)
        for name, (kind, join) in _COLUMNS.items()
    }


def _concatenated(parts: Sequence[Values]) -> Values:
    return {name: np.concatenate([part[name] for part in parts]) for name in _COLUMNS}


@dataclass
class WireCubes:
    """Records of the cubes that hold points of wires, in the order of their places."""

    size: float  #: side of a cube, meters
    #: (n, 3) column, row and layer
    place: NDArray[np.int64] = field(default_factory=lambda: np.empty((0, 3), np.int64))
    columns: Values = field(default_factory=_no_values)  #: (n,) each

    @staticmethod
    def places(x: NDArray, y: NDArray, z: NDArray, size: float) -> NDArray[np.int64]:
        """Return column, row and layer (n, 3) of the cubes of points, whose axes are in meters."""
        return np.column_stack([cell_numbers(axis / size, 1.0) for axis in (x, y, z)])

    def middles(self) -> NDArray[np.float64]:
        """Return where the wires of each cube are (n, 3), meters: its middle, their mean height."""
        height = self.columns["sum"] / self.columns["count"] / MM
        return np.column_stack([(self.place[:, :2] + 0.5) * self.size, height])

    def rows(self, places: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the row of the cube at each place (n, 3); -1 for none."""
        count = len(self.place)
        every = np.concatenate([self.place, places])
        _, number = np.unique(every, axis=0, return_inverse=True)
        row = np.full(len(every), -1, np.int64)
        row[number.reshape(-1)[:count]] = np.arange(count)
        return row[number.reshape(-1)[count:]]

    def doubled(self) -> WireCubes:
        """Return records of the same points in cubes twice as wide."""
        return WireCubes(2 * self.size, self.place >> 1, self.columns).merged()

    def merged(self) -> WireCubes:
        """Return the records sorted, with one for each cube."""
        order = np.lexsort(self.place.T[::-1])
        place = self.place[order]
        first = np.flatnonzero((np.diff(place, axis=0, prepend=place[:1] - 1) != 0).any(axis=1))
        if not len(first):
            return WireCubes(self.size)
        return WireCubes(self.size, place[first], _joined(self.columns, order, first))


@dataclass
class Cells:
    """Records of cells, sorted by key; make them with :meth:`from_points`."""

    size: float  #: side of a cell, meters; cells of the ground are `GROUND_WIDTH` times as wide
    key: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))  #: (n,)
    columns: Values = field(default_factory=_no_values)  #: (n,) each
    wires: WireCubes = field(default_factory=lambda: WireCubes(0.0))  #: as wide as the cells

    def __len__(self) -> int:
        """Return the number of records."""
        return len(self.key)

    @classmethod
    def from_points(
        cls,
        x: NDArray,
        y: NDArray,
        z: NDArray,
        codes: NDArray[np.uint8],
        size: float,
        *,
        reliability: NDArray | None = None,
        classes: Mapping[Kind, Sequence[int]] = CLASSES,
    ) -> Cells:
        """Return records of the cells that hold points.

        Parameters
        ----------
        x, y, z : (n,) float64
            Meters.
        codes : (n,) uint8
            Class codes; noise (7, 18) is left out.
        size : float
            Side of a cell, meters.
        reliability : (n,) float, optional
            0 to 1; NaN where it is not known.
        classes : mapping, optional
            Class codes of each kind.

        Raises
        ------
        StageError
            For coordinates or heights beyond the range of the grid.
        """
        table = kind_of_code(classes)
        table[(table < 0) & ~np.isin(np.arange(256), NOISE)] = Kind.OTHER
        kinds = table[codes]
        used = kinds >= 0
        if not used.any():
            return cls(size)
        height = np.rint(z[used] * MM)
        if max(-height.min(), height.max()) > 2**31 - 2:
            raise StageError(
                "heights lie beyond 2,000 km",
                found=f"{height.min() / MM:g} to {height.max() / MM:g} m",
            )
        key, height = point_keys(x[used], y[used], kinds[used], size), height.astype(np.int32)
        known = np.full(len(key), np.nan) if reliability is None else np.asarray(reliability)[used]
        rated = ~np.isnan(known)
        thousandths = np.rint(np.clip(np.where(rated, known, 0.0), 0.0, 1.0) * THOUSANDTHS)
        columns = {
            "count": np.ones(len(key), np.int32),
            **dict.fromkeys(("low", "high", "sum"), height),
            "reliability": thousandths.astype(np.int64),
            "rated": rated.astype(np.int32),
        }
        wire = np.flatnonzero(kinds[used] == Kind.SPAN)
        along_x, along_y, along_z = (axis[used][wire] for axis in (x, y, z))
        places = WireCubes.places(along_x, along_y, along_z, size)
        wires = WireCubes(size, places, {name: each[wire] for name, each in columns.items()})
        return cls(size, key, columns, wires.merged())._merged()

    def doubled(self) -> Cells:
        """Return records of the same points in cells twice as wide."""
        column, row, kind = split_keys(self.key)
        key = cell_keys(column >> 1, row >> 1, kind)
        return Cells(2 * self.size, key, self.columns, self.wires.doubled())._merged()

    def _merged(self) -> Cells:
        """Return the records sorted, with one for each cell."""
        if not len(self.key):
            return self
        order = np.argsort(self.key, kind="stable")
        key = self.key[order]
        first = np.flatnonzero(begins_run(key))
        return Cells(self.size, key[first], _joined(self.columns, order, first), self.wires)

    @staticmethod
    def join(parts: Sequence[Cells]) -> Cells:
        """Return records of the points of all parts together; cells of all parts have one size."""
        if len(parts) == 1:
            return parts[0]
        size, columns = parts[0].size, _concatenated([part.columns for part in parts])
        wires = WireCubes(
            size,
            np.concatenate([part.wires.place for part in parts]),
            _concatenated([part.wires.columns for part in parts]),
        )
        key = np.concatenate([part.key for part in parts])
        return Cells(size, key, columns, wires.merged())._merged()

    def of_kind(self, kind: Kind) -> Cells:
        """Return the records of one kind."""
        first, last = np.searchsorted(split_keys(self.key)[2], [kind, kind + 1])
        return self._select(slice(int(first), int(last)))

    def in_window(self, kind: Kind, window: GridWindow) -> Cells:
        """Return the records of one kind in a window of its cells."""
        rows = np.array([window.bottom, window.bottom + window.height])
        first, last = np.searchsorted(self.key, cell_keys(np.full(2, _WESTMOST), rows, kind))
        part = self._select(slice(int(first), int(last)))
        return part._select(window.contains(*split_keys(part.key)[:2]))

    def _select(self, rows: slice | NDArray[np.bool_]) -> Cells:
        values = {name: each[rows] for name, each in self.columns.items()}
        return Cells(self.size, self.key[rows], values)

    def sparse_kind(self) -> tuple[str, float] | None:
        """Return a kind with too few points for this cell size, and its mean per cell; or None.

        The kind is buildings, or trees where there are hardly any buildings.
        """
        for kind, name in ((Kind.BUILDING, "buildings"), (Kind.TREE, "trees")):
            count = self.of_kind(kind).columns["count"]
            if len(count) > MIN_CELLS:
                mean = float(count.mean())
                return (name, mean) if mean < MIN_POINTS_PER_CELL else None
        return None


def point_keys(x: NDArray, y: NDArray, kinds: NDArray, size: float) -> NDArray[np.int64]:
    """Return the key of each point's cell; `kinds` (n,) are of :class:`Kind`."""
    side = np.where(kinds == Kind.GROUND, size * GROUND_WIDTH, size)
    return cell_keys(cell_numbers(x / side, 1.0), cell_numbers(y / side, 1.0), kinds)


def refuse_unclassified(cells: Cells, codes: NDArray[np.uint8]) -> None:
    """Raise StageError where no point has a class that objects are made of, or none is ground."""
    if len(codes) == 0:
        return
    if len(cells) == len(cells.of_kind(Kind.OTHER)):
        what = "no point has a class that objects are made of, or that is ground"
        cure = "Classify the points first (pdal-stages classify), or name their classes"
    elif len(cells.of_kind(Kind.GROUND)) == 0:
        what = "there is no ground: objects' heights are measured from points of its classes"
        cure = "Classify the ground first (pdal-stages classify), or name its classes in 'ground'"
    else:
        return
    listed = ", ".join(str(code) for code in sorted(set(codes.tolist())))
    raise StageError(what, found=f"classes {listed}", cure=cure)
