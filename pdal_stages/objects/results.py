"""What objects are told apart by, and what was found: tables of objects, by kind, and whose each cell's points are."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass
from itertools import chain, compress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.grid import places_among
from ..base.settings import Settings, setting
from .cells import Kind, point_keys


def _setting(default: float, what: str, low: float, high: float, unit: str = "m"):
    return setting(default, "number", what, low, high, unit=unit)


@dataclass(frozen=True)
class ObjectSettings(Settings):
    """How objects are told apart; wrong values raise an OptionError."""

    cell: float = _setting(
        0.5,
        "Side of the grid's cells, about 1.4 times the spacing of points (1 for 2 points/m2), so that few cells of a roof "
        "are empty; where points are few the command objects enlarges the default, up to 4",
        0.05,
        100,
    )
    building_height: float = _setting(
        1.5, "Minimum height of a building's cells above the ground", 0, 100
    )
    building_area: float = _setting(
        4.0, "Minimum area of a building; smaller ones are left out", 0, 10_000, "m2"
    )
    step: float = _setting(
        2.5,
        "Height difference that separates two buildings, along two thirds of their roofs' border; 0 separates none",
        0,
        100,
    )
    roof_part: float = _setting(
        10.0,
        "Minimum area of a roof part; smaller ones (dormers) join their neighbor",
        0,
        10_000,
        "m2",
    )
    tree_height: float = _setting(3.0, "Minimum height of a tree", 0, 100)
    tree_area: float = _setting(1.0, "Minimum area of a tree's crown", 0, 1000, "m2")
    saddle: float = _setting(
        0.3, "Depth of the saddle in the canopy that separates two trees", 0, 10
    )
    smoothing: float = _setting(
        0.3, "Standard deviation of the Gaussian that smooths the canopy", 0, 5
    )
    dbh_factor: float = _setting(
        0.557,
        "For the stem diameter at breast height, `dbh`: dbh_factor times (height times crown diameter) to the power of "
        "dbh_power (Jucker and others 2017, who also give both for the forests of each region)",
        0,
        10,
        "",
    )
    dbh_power: float = _setting(0.809, "See dbh_factor", 0, 2, "")
    span_gap: float = _setting(2.0, "Gap between wires that separates two spans", 0.5, 20)


@dataclass
class Table:
    """Objects of a kind, in the order of their ids."""

    ids: NDArray[np.int64]
    columns: dict[str, NDArray]
    #: Of each object its cells: row, column and height (n, 3).
    cells: list[NDArray[np.float64]]
    #: Of spans: the line (k, 3) along each.
    paths: list[NDArray[np.float64]]

    def __len__(self) -> int:
        return len(self.ids)

    def cells_of(
        self, number: int
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
        """Rows, columns and heights of an object's cells."""
        row, column, z = self.cells[number].T
        return row.astype(np.int64), column.astype(np.int64), z

    def reasons(self) -> list[list[str]]:
        """Why each object is to be checked."""
        return [str(text).split(", ") if text else [] for text in self.columns.get("reason", ())]

    def having(self, reasons: Collection[str]) -> NDArray[np.bool_]:
        """Which objects are to be checked for one of the reasons."""
        return np.array([not set(reasons).isdisjoint(own) for own in self.reasons()], bool)

    def only(self, kept: NDArray[np.bool_]) -> Table:
        """Some of the objects."""
        columns = {name: values[kept] for name, values in self.columns.items()}
        return Table(
            self.ids[kept],
            columns,
            list(compress(self.cells, kept)),
            list(compress(self.paths, kept)),
        )


@dataclass
class Objects:
    """All objects, by kind, and which cells' points are theirs."""

    settings: ObjectSettings
    tables: dict[Kind, Table]
    key: NDArray[np.int64]  # sorted keys of cells
    owner: NDArray[np.int64]  # id of the object that has their points

    def without(self, reasons: Collection[str]) -> tuple[Objects, int]:
        """The objects that are not to be checked for one of the reasons; how many are left out."""
        left = {kind: table.having(reasons) for kind, table in self.tables.items()}
        gone = np.concatenate([table.ids[left[kind]] for kind, table in self.tables.items()])
        stays = ~np.isin(self.owner, gone)
        tables = {kind: table.only(~left[kind]) for kind, table in self.tables.items()}
        return Objects(self.settings, tables, self.key[stays], self.owner[stays]), gone.size

    def ids_at(self, x: NDArray, y: NDArray, kinds: NDArray) -> NDArray[np.int64]:
        """The id of each point's object, 0 where it is of none; `kinds` are numbers of :class:`Kind`, or -1."""
        if self.key.size == 0:
            return np.zeros(len(x), np.int64)
        at, there = places_among(self.key, point_keys(x, y, kinds, self.settings.cell))
        return np.where(there, self.owner[at], 0)

    def summary(self) -> dict[str, dict[str, Any]]:
        """Of each kind (``buildings``): how many objects, how many are to be checked, and why."""
        out = {}
        for kind, table in self.tables.items():
            reasons = table.reasons()
            out[kind.name.lower() + "s"] = {
                "objects": len(table),
                "to_be_checked": sum(map(bool, reasons)),
                "reasons": dict(sorted(Counter(chain.from_iterable(reasons)).items())),
            }
        return out
