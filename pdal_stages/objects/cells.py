"""What cells of an absolute grid say of the points in them: whole numbers, so that any order of points gives the same.

A record is made of one or of a million points alike, and records of the same cell are joined by adding and comparing.
So files may be read one after the other, in parts, in parallel, and overlapping areas joined afterwards.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from ..base.asprs import NOISE
from ..base.errors import StageError


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
#: Cells are too small where more than `MANY` hold fewer than `ENOUGH` points on average.
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


def cell_keys(kind: int, row: NDArray, column: NDArray) -> NDArray[np.int64]:
    """One number for each cell; sorted by kind, then row by row from the south."""
    row, column = np.asarray(row, np.int64), np.asarray(column, np.int64)
    return (np.int64(kind) << _KIND) | ((row + _HALF) << _ROW) | (column + _HALF)


def unpack(
    keys: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Kind, row and column of keys."""
    low = (1 << _ROW) - 1
    return keys >> _KIND, ((keys >> _ROW) & low) - _HALF, (keys & low) - _HALF


def object_id(kind: NDArray | int, row: NDArray | int, column: NDArray | int) -> NDArray[np.int64]:
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
    """Records of cells, sorted by key."""

    size: float  #: side of a cell, meters; those of the ground are `GROUND_CELLS` times as wide
    key: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))  #: (n,)
    #: name to (n,) values, see the table in the source: count, low, high, sum, ...
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
            0 to 1; NaN where it is not known.
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
        key, height = key[used], height[used]
        if max(-height.min(), height.max()) > 2**31 - 2:
            raise StageError(
                "heights lie beyond 2,000 km",
                found=f"{height.min() / MM:g} to {height.max() / MM:g} m",
            )
        z = height.astype(np.int32)
        given = np.full(len(z), np.nan) if reliability is None else np.asarray(reliability)[used]
        told = ~np.isnan(given)
        sure = np.rint(np.clip(np.where(told, given, 0.0), 0.0, 1.0) * MM).astype(np.int64)
        columns = {
            "count": np.ones(len(z), np.int32),
            "low": z,
            "high": z,
            "sum": z,
            "sure": sure,
            "told": told.astype(np.int32),
        }
        return cls(size, key, columns)._joined()

    def doubled(self) -> Cells:
        """Records of the same points in cells twice as wide."""
        kind, row, column = unpack(self.key)
        return Cells(
            2 * self.size, cell_keys(0, row >> 1, column >> 1) | (kind << _KIND), self.columns
        )._joined()

    def _joined(self) -> Cells:
        """Sorted, with one record for each cell."""
        if not len(self.key):
            return self
        order = np.argsort(self.key, kind="stable")
        key = self.key[order]
        first = np.flatnonzero(np.r_[True, key[1:] != key[:-1]])
        columns = {
            name: join.reduceat(self.columns[name][order], first, dtype=kind)
            for name, (kind, join) in _COLUMNS.items()
        }
        return Cells(self.size, key[first], columns)

    @staticmethod
    def join(parts: Sequence[Cells]) -> Cells:
        """Records of all parts' points together; cells of all parts have one size."""
        if len(parts) == 1:
            return parts[0]
        columns = {
            name: np.concatenate([part.columns[name] for part in parts]) for name in _COLUMNS
        }
        return Cells(parts[0].size, np.concatenate([part.key for part in parts]), columns)._joined()

    def of_kind(self, kind: Kind) -> Cells:
        """Those of a kind."""
        first, last = np.searchsorted(
            self.key, [np.int64(kind) << _KIND, np.int64(kind + 1) << _KIND]
        )
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
        return Cells(
            self.size, self.key[which], {name: v[which] for name, v in self.columns.items()}
        )


def point_keys(x: NDArray, y: NDArray, kinds: NDArray, size: float) -> NDArray[np.int64]:
    """Keys of the cells that points fall in; -1 for those of no kind (below 0)."""
    side = np.where(kinds == Kind.GROUND, size * GROUND_CELLS, size)
    row, column = np.floor(y / side), np.floor(x / side)
    used = kinds >= 0
    if not (np.maximum(np.abs(row), np.abs(column))[used] < _HALF).all():
        raise StageError(
            "coordinates lie too far out for the grid of cells",
            found=f"x {x.min():g} to {x.max():g}, y {y.min():g} to {y.max():g} m",
            cure="Drop stray points first, or give a larger 'cell'",
        )
    out = np.full(len(x), -1, np.int64)
    out[used] = cell_keys(0, row[used], column[used]) | (kinds[used].astype(np.int64) << _KIND)
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
