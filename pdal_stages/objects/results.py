"""Settings and results of the detection: tables of objects, and the owner of each cell."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.grid import places_among
from ..base.json_types import JsonObject
from ..base.options import Settings, setting
from .cells import Kind, WireCubes, point_keys


def _number(default: float, low: float, high: float, unit: str, help: str) -> Any:
    """Return the setting of a number."""
    return setting(default, "number", help, low, high, unit=unit)


@dataclass(frozen=True)
class ObjectSettings(Settings):
    """Settings of the detection of objects; wrong values raise an OptionError.

    `saddle` was chosen on five plots of forest ("chosen" in benchmarks/trees.py).
    """

    cell: float = _number(
        0.5,
        0.05,
        100,
        "m",
        "Side of the grid's cells, about 1.4 times the spacing of points (1 for 2 points/m2), so "
        "that few cells of a roof are empty; where points are few the command objects enlarges "
        "the default, up to 4",
    )
    building_height: float = _number(
        1.5, 0, 100, "m", "Minimum height of a building's cells above the ground"
    )
    building_area: float = _number(
        4.0, 0, 10_000, "m2", "Minimum area of a building or deck; smaller ones are left out"
    )
    tree_height: float = _number(3.0, 0, 100, "m", "Minimum height of a tree")
    tree_area: float = _number(1.0, 0, 1000, "m2", "Minimum area of a tree's crown")
    saddle: float = _number(
        0.3, 0, 10, "m", "Depth of the saddle in the canopy that separates two trees"
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


@dataclass
class Objects:
    """All objects, by kind, and the owner of each cell's points."""

    settings: ObjectSettings
    tables: dict[Kind, ObjectTable]
    key: NDArray[np.int64]  #: (m,) sorted keys of cells that belong to objects but spans
    owner: NDArray[np.int64]  #: (m,) id of the object that has their points
    wires: WireCubes  #: cubes of wires ...
    span: NDArray[np.int64]  #: (w,) ... and the id of the span that has their points; 0 for none

    def ids_at(self, x: NDArray, y: NDArray, z: NDArray, kinds: NDArray) -> NDArray[np.int64]:
        """Return the id of each point's object, 0 for none; `kinds`: :class:`Kind`, or -1."""
        ids = np.zeros(len(x), np.int64)
        if self.key.size:
            rows = np.flatnonzero(kinds >= 0)
            keys = point_keys(x[rows], y[rows], kinds[rows], self.settings.cell)
            place, exists = places_among(self.key, keys)
            ids[rows] = np.where(exists, self.owner[place], 0)
        rows = np.flatnonzero(kinds == Kind.SPAN)
        places = WireCubes.places(x[rows], y[rows], z[rows], self.settings.cell)
        ids[rows] = np.append(self.span, 0)[self.wires.rows(places)]
        return ids

    def summary(self) -> dict[str, JsonObject]:
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
