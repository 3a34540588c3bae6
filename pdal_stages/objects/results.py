"""Settings and results of the detection: tables of objects, and the owner of each cell."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass
from itertools import chain, compress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.checks import Settings, setting
from ..base.grid import places_among
from .cells import Kind, point_keys


def _number(limits: tuple[float, float, float, str], help: str) -> Any:
    """Return a number's setting from its default, lowest and highest value and unit."""
    default, low, high, unit = limits
    return setting(default, "number", help, low, high, unit=unit)


@dataclass(frozen=True)
class ObjectSettings(Settings):
    """Settings of the detection of objects; wrong values raise an OptionError.

    `saddle` and `smoothing` were chosen on five plots of forest ("chosen" in benchmarks/trees.py).
    """

    cell: float = _number(
        (0.5, 0.05, 100, "m"),
        "Side of the grid's cells, about 1.4 times the spacing of points (1 for 2 points/m2), so "
        "that few cells of a roof are empty; where points are few the command objects enlarges "
        "the default, up to 4",
    )
    building_height: float = _number(
        (1.5, 0, 100, "m"), "Minimum height of a building's cells above the ground"
    )
    building_area: float = _number(
        (4.0, 0, 10_000, "m2"), "Minimum area of a building or deck; smaller ones are left out"
    )
    step: float = _number(
        (2.5, 0, 100, "m"),
        "Height difference that separates two buildings, along two thirds of their roofs' border; "
        "0 separates none",
    )
    roof_part: float = _number(
        (10.0, 0, 10_000, "m2"),
        "Minimum area of a roof part; smaller ones (dormers) join their neighbor",
    )
    tree_height: float = _number((3.0, 0, 100, "m"), "Minimum height of a tree")
    tree_area: float = _number((1.0, 0, 1000, "m2"), "Minimum area of a tree's crown")
    saddle: float = _number(
        (0.3, 0, 10, "m"), "Depth of the saddle in the canopy that separates two trees"
    )
    smoothing: float = _number(
        (0.3, 0, 5, "m"), "Standard deviation of the Gaussian that smooths the canopy"
    )
    dbh_factor: float = _number(
        (0.557, 0, 10, ""),
        "For the stem diameter at breast height, `dbh`: dbh_factor times (height times crown "
        "diameter) to the power of dbh_power (Jucker and others 2017, who also give both for the "
        "forests of each region)",
    )
    dbh_power: float = _number((0.809, 0, 2, ""), "See dbh_factor")
    span_gap: float = _number(
        (2.0, 0.5, 20, "m"),
        "Gap between wires that separates two spans, rounded to an even number of cells; where "
        "that is 0, wires in cells that touch, also at a corner, are one span",
    )


@dataclass
class ObjectTable:
    """Objects of a kind, in the order of their ids."""

    ids: NDArray[np.int64]  #: (n,)
    columns: dict[str, NDArray]  #: (n,) measures and verdicts by name
    cells: list[tuple[NDArray, NDArray, NDArray]]  #: (k,) rows, columns, heights of each object
    paths: list[NDArray[np.float64]]  #: (k, 3) the line along each span; empty for other kinds

    def __len__(self) -> int:
        """Return the number of objects."""
        return len(self.ids)

    def reasons(self) -> list[list[str]]:
        """Return why each object is to be checked."""
        return [str(text).split(", ") if text else [] for text in self.columns.get("reason", ())]

    def has_reason(self, reasons: Collection[str]) -> NDArray[np.bool_]:
        """Return which objects are to be checked for one of the reasons."""
        return np.array([not set(reasons).isdisjoint(each) for each in self.reasons()], bool)

    def select(self, kept: NDArray[np.bool_]) -> ObjectTable:
        """Return a table of the objects in a mask (n,)."""
        columns = {name: values[kept] for name, values in self.columns.items()}
        cells, paths = list(compress(self.cells, kept)), list(compress(self.paths, kept))
        return ObjectTable(self.ids[kept], columns, cells, paths)


@dataclass
class Objects:
    """All objects, by kind, and the owner of each cell's points."""

    settings: ObjectSettings
    tables: dict[Kind, ObjectTable]
    key: NDArray[np.int64]  #: (m,) sorted keys of cells that belong to objects
    owner: NDArray[np.int64]  #: (m,) id of the object that has their points

    def without(self, reasons: Collection[str]) -> tuple[Objects, int]:
        """Return the objects that no listed reason applies to, and how many are left out."""
        left_out = {kind: table.has_reason(reasons) for kind, table in self.tables.items()}
        ids = np.concatenate([table.ids[left_out[kind]] for kind, table in self.tables.items()])
        stays = ~np.isin(self.owner, ids)
        tables = {kind: table.select(~left_out[kind]) for kind, table in self.tables.items()}
        return Objects(self.settings, tables, self.key[stays], self.owner[stays]), ids.size

    def ids_at(self, x: NDArray, y: NDArray, kinds: NDArray) -> NDArray[np.int64]:
        """Return the id of each point's object, 0 for none; `kinds`: :class:`Kind`, or -1."""
        ids = np.zeros(len(x), np.int64)
        if self.key.size:
            rows = np.flatnonzero(kinds >= 0)
            keys = point_keys(x[rows], y[rows], kinds[rows], self.settings.cell)
            place, exists = places_among(self.key, keys)
            ids[rows] = np.where(exists, self.owner[place], 0)
        return ids

    def summary(self) -> dict[str, dict[str, Any]]:
        """Return, by kind, the number of objects, how many are to be checked, and why."""
        out = {}
        for kind, table in self.tables.items():
            reasons = table.reasons()
            out[kind.name.lower() + "s"] = {
                "objects": len(table),
                "to_be_checked": sum(map(bool, reasons)),
                "reasons": dict(sorted(Counter(chain.from_iterable(reasons)).items())),
            }
        return out
