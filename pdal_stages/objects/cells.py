"""What cells of an absolute grid say of the points in them: whole numbers, so that any order of points gives the same.

A record is made of one or of a million points alike, and records of the same cell are joined by adding and comparing.
So files may be read one after the other, in parts, in parallel, and overlapping areas joined afterwards.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.asprs import NOISE
from ..base.errors import StageError
from ..base.jit import njit


class Kind(IntEnum):
    """What a cell's points are; ids of objects begin with it."""

    GROUND = 0
    BUILDING = 1
    TREE = 2
    SPAN = 3
    DECK = 4
    TOWER = 5
    OTHER = 6  # of no interest, but something was seen there


#: ASPRS classes of each kind.
CLASSES: dict[Kind, tuple[int, ...]] = {
    Kind.GROUND: (2, 9, 11),
    Kind.BUILDING: (6,),
    Kind.TREE: (4, 5),
    Kind.SPAN: (13, 14),
    Kind.DECK: (17,),
    Kind.TOWER: (15,),
}
#: Cells of the ground are this many times as wide.
GROUND_CELLS = 2
#: Cells are too small where more than `MANY` hold fewer than `ENOUGH` points on average (``benchmarks/objectcells.py``).
MANY, ENOUGH = 100, 1.6
#: Height and place are counted in these, and the reliability.
MM = 1000.0
_HALF = 1 << 26  # rows and columns run from -_HALF to _HALF
_ROW, _KIND = 27, 54  # bits before them in a key
#: Name -> type and how two records are joined.
_COLUMNS: dict[str, tuple[type, np.ufunc]] = {
    "count": (np.int32, np.add),  # points
    "low": (np.int32, np.minimum),  # z of the lowest, mm
    "high": (np.int32, np.maximum),  # z of the highest, mm
    "sum": (np.int64, np.add),  # of z, mm
    "sure": (np.int64, np.add),  # of their reliabilities, thousandths
    "told": (np.int32, np.add),  # points that have one
}
_HOW: dict[Any, int] = {np.add: 0, np.minimum: 1, np.maximum: 2}
_KINDS = len(Kind)


def cell_keys(kind: int, row: NDArray, column: NDArray) -> NDArray[np.int64]:
    """One number for each cell; sorted by kind, then row by row from the south."""
    row, column = np.asarray(row, np.int64), np.asarray(column, np.int64)
    return (np.int64(kind) << _KIND) | ((row + _HALF) << _ROW) | (column + _HALF)


def unpack(keys: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Kind, row and column of keys."""
    low = (1 << _ROW) - 1
    return keys >> _KIND, ((keys >> _ROW) & low) - _HALF, (keys & low) - _HALF


def object_id(kind: NDArray | int, row: NDArray, column: NDArray) -> NDArray[np.int64]:
    """Ids of objects, from the cell that stands for each: below 2**53, so exact in JSON and as a double, too.

    Rows and columns are taken modulo 2**25: at 0.5 m, two places with the same id lie 16,777 km apart.
    """
    one, low = np.int64(1), np.int64((1 << 25) - 1)
    row, column = np.asarray(row, np.int64), np.asarray(column, np.int64)
    return (np.asarray(kind, np.int64) * (one << 50)) | ((row & low) << 25) | (column & low)


def kind_of_code(classes: Mapping[Kind, Sequence[int]]) -> NDArray[np.int8]:
    """The kind of each class code, 0 to 255; -1 for those of no interest."""
    table = np.full(256, -1, np.int8)
    for kind, codes in classes.items():
        for code in codes:
            if table[code] >= 0:
                raise StageError(
                    f"class {code} cannot stand for {Kind(table[code]).name.lower()} and {kind.name.lower()}",
                    cure="Give each class one kind of object",
                )
            table[code] = kind
    return table


@dataclass
class Cells:
    """Records of cells, sorted by key.

    Attributes
    ----------
    size : float
        Side of a cell, meters; those of the ground are `GROUND_CELLS` times as wide.
    key : (n,) int64
    columns : dict of str to (n,) ndarray
        See the table in the source: count, low, high, sum, ...
    """

    size: float
    key: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    columns: dict[str, NDArray] = field(
        default_factory=lambda: {name: np.empty(0, kind) for name, (kind, _) in _COLUMNS.items()}
    )

    def __len__(self) -> int:
        return len(self.key)

    @classmethod
    def of(
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
        """Records of points.

        Parameters
        ----------
        x, y, z : (n,) float64
            Meters.
        codes : (n,) uint8
            Class codes; noise (7, 18) is left out.
        size : float
            Side of a cell, meters.
        reliability : (n,) float, optional
            0 to 1.
        classes : mapping, optional
            Class codes of each kind.
        """
        table = kind_of_code(classes)
        table[(table < 0) & ~np.isin(np.arange(256), NOISE)] = Kind.OTHER
        kinds = table[codes]
        key = point_keys(x, y, kinds, size)
        height = np.rint(z * MM)
        used = key >= 0
        if not used.any():
            return cls(size)
        if not used.all():
            key, height = key[used], height[used]
        if max(-height.min(), height.max()) > 2**31 - 2:
            raise StageError(
                "heights lie beyond 2,000 km", found=f"{height.min() / MM:g} to {height.max() / MM:g} m"
            )
        if reliability is None:
            sure = np.empty(0, np.int64)
        else:
            given = np.asarray(reliability)
            sure = np.rint(np.clip(given if used.all() else given[used], 0.0, 1.0) * MM).astype(np.int64)
        place, keys = _places(key)
        columns = _sums(place, len(keys), height.astype(np.int32), sure)
        return cls(size, keys, dict(zip(_COLUMNS, columns, strict=True)))

    def doubled(self) -> Cells:
        """Records of the same points in cells twice as wide."""
        kind, row, column = unpack(self.key)
        return Cells(
            2 * self.size, cell_keys(0, row >> 1, column >> 1) | (kind << _KIND), self.columns
        )._joined()

    def _joined(self) -> Cells:
        """Sorted, with one record for each cell."""
        place, keys = _places(self.key)
        columns: dict[str, NDArray] = {}
        for name, values in self.columns.items():
            kind, join = _COLUMNS[name]
            columns[name] = _combined(place, len(keys), values.astype(kind, copy=False), _HOW[join])
        return Cells(self.size, keys, columns)

    @staticmethod
    def join(parts: Sequence[Cells]) -> Cells:
        """Records of all parts' points together."""
        if not parts:
            raise ValueError("there is nothing to join")
        if len({part.size for part in parts}) > 1:
            raise ValueError("cells of different sizes cannot be joined")
        if len(parts) == 1:
            return parts[0]
        columns = {name: np.concatenate([part.columns[name] for part in parts]) for name in _COLUMNS}
        return Cells(parts[0].size, np.concatenate([part.key for part in parts]), columns)._joined()

    def of_kind(self, kind: Kind) -> Cells:
        """Those of a kind."""
        first, last = np.searchsorted(self.key, [np.int64(kind) << _KIND, np.int64(kind + 1) << _KIND])
        return self._rows(slice(int(first), int(last)))

    def thin(self) -> tuple[str, float] | None:
        """What there are too few points of for cells of this size, and how many such a cell holds on average.

        Looked at are buildings, or trees where there are hardly any buildings.
        """
        for kind, what in ((Kind.BUILDING, "buildings"), (Kind.TREE, "trees")):
            some = self.of_kind(kind).columns["count"]
            if len(some) > MANY:
                mean = float(some.mean())
                return (what, mean) if mean < ENOUGH else None
        return None

    def within(self, kind: Kind, row: int, column: int, rows: int, columns: int) -> Cells:
        """Those of a kind in a rectangle of its cells."""
        first, last = np.searchsorted(
            self.key, cell_keys(kind, np.array([row, row + rows]), np.array([-_HALF, -_HALF]))
        )
        part = self._rows(slice(int(first), int(last)))
        _, _, column_of = unpack(part.key)
        return part._rows((column_of >= column) & (column_of < column + columns))

    def _rows(self, which) -> Cells:
        return Cells(self.size, self.key[which], {name: v[which] for name, v in self.columns.items()})


def point_keys(x: NDArray, y: NDArray, kinds: NDArray, size: float) -> NDArray[np.int64]:
    """Keys of the cells that points fall in; -1 for those of no kind (below 0)."""
    key, far = _point_keys(x, y, kinds, size, size * GROUND_CELLS)
    if far:
        raise StageError(
            "coordinates lie too far out for the grid of cells",
            found=f"x {x.min():g} to {x.max():g}, y {y.min():g} to {y.max():g} m",
            cure="Drop stray points first, or give a larger 'cell'",
        )
    return key


@njit
def _point_keys(x: NDArray, y: NDArray, kinds: NDArray, size: float, wide: float) -> tuple[NDArray, bool]:
    """Keys of points, and whether any lies beyond the grid."""
    out = np.full(len(x), -1, np.int64)
    far = False
    for n in range(len(x)):
        if kinds[n] < 0:
            continue
        side = wide if kinds[n] == 0 else size
        column, row = np.floor(x[n] / side), np.floor(y[n] / side)
        if not (abs(column) < _HALF and abs(row) < _HALF):
            far = True
            continue
        out[n] = (
            (np.int64(kinds[n]) << _KIND) | ((np.int64(row) + _HALF) << _ROW) | (np.int64(column) + _HALF)
        )
    return out, far


def _places(key: NDArray[np.int64]) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """The place of each key among the different ones, sorted; and those."""
    if key.size == 0:
        return np.empty(0, np.int32), key
    low, high = _extents(key)
    sides = np.maximum(high - low + 1, 0)
    many = int(sum(int(rows) * int(columns) for rows, columns in sides))
    if many > min(8 * key.size + (1 << 16), 2**31 - 1):  # strays, or few points in a wide area
        keys, place = np.unique(key, return_inverse=True)
        return place.astype(np.int32), keys
    return _counted_places(key, low, sides, many)


@njit
def _extents(key: NDArray) -> tuple[NDArray, NDArray]:
    """Lowest and highest row and column of each kind's keys."""
    low, high = np.full((_KINDS, 2), 4 * _HALF, np.int64), np.full((_KINDS, 2), -1, np.int64)
    one = (np.int64(1) << _ROW) - 1
    for k in key:
        kind, row, column = k >> _KIND, (k >> _ROW) & one, k & one
        low[kind, 0], high[kind, 0] = min(low[kind, 0], row), max(high[kind, 0], row)
        low[kind, 1], high[kind, 1] = min(low[kind, 1], column), max(high[kind, 1], column)
    return low, high


@njit
def _counted_places(key: NDArray, low: NDArray, sides: NDArray, many: int) -> tuple[NDArray, NDArray]:
    """The same where cells fill much of the area: by a table of it, without sorting."""
    one = (np.int64(1) << _ROW) - 1
    begin = np.zeros(_KINDS, np.int64)
    for kind in range(1, _KINDS):
        begin[kind] = begin[kind - 1] + sides[kind - 1, 0] * sides[kind - 1, 1]
    number = np.zeros(many, np.int32)
    place = np.empty(len(key), np.int32)
    for n in range(len(key)):
        k = key[n]
        kind = k >> _KIND
        at = ((k >> _ROW) & one) - low[kind, 0]
        at = begin[kind] + at * sides[kind, 1] + (k & one) - low[kind, 1]
        number[at] = 1
        place[n] = at
    count = 0
    for at in range(many):
        if number[at]:
            number[at] = count
            count += 1
    keys = np.empty(count, np.int64)
    for n in range(len(key)):
        place[n] = number[place[n]]
        keys[place[n]] = key[n]
    return place, keys


@njit
def _sums(
    place: NDArray, many: int, height: NDArray, sure: NDArray
) -> tuple[NDArray, NDArray, NDArray, NDArray, NDArray, NDArray]:
    """The columns of records of points, in the order of `_COLUMNS`; `sure` may be empty."""
    count, told = np.zeros(many, np.int32), np.zeros(many, np.int32)
    low, high = np.full(many, 2**31 - 1, np.int32), np.full(many, -(2**31), np.int32)
    total, reliability = np.zeros(many, np.int64), np.zeros(many, np.int64)
    for n in range(len(place)):
        p, z = place[n], height[n]
        count[p] += 1
        low[p], high[p] = min(low[p], z), max(high[p], z)
        total[p] += z
    for n in range(len(sure)):
        reliability[place[n]] += sure[n]
        told[place[n]] += 1
    return count, low, high, total, reliability, told


@njit
def _combined(place: NDArray, many: int, values: NDArray, how: int) -> NDArray:
    """Values of the same place together: 0 added, 1 the least, 2 the greatest."""
    out = np.zeros(many, values.dtype)
    first = np.ones(many, np.bool_)
    for n in range(len(place)):
        p = place[n]
        if first[p]:
            out[p], first[p] = values[n], False
        elif how == 0:
            out[p] += values[n]
        elif how == 1:
            out[p] = min(out[p], values[n])
        else:
            out[p] = max(out[p], values[n])
    return out


def refuse_unclassified(cells: Cells, codes: NDArray[np.uint8]) -> None:
    """An error for points without classes, and for points without ground."""
    if len(codes) == 0:
        return
    if len(cells) == len(cells.of_kind(Kind.OTHER)):
        raise StageError(
            "no point has a class that objects are made of, or that is ground",
            found="classes " + ", ".join(str(c) for c in sorted(set(codes.tolist()))),
            cure="Classify the points first (pdal-stages classify), or say what is what: 'buildings', 'trees', ...",
        )
    if len(cells.of_kind(Kind.GROUND)) == 0:
        raise StageError(
            "there is no ground: objects' heights are measured from points of its classes",
            found="classes " + ", ".join(str(c) for c in sorted(set(codes.tolist()))),
            cure="Classify the ground first (pdal-stages classify, or filters.smrf), or name its classes in 'ground'",
        )
