"""Cells that are best looked at together, in the order in which a person finds most wrong points per minute."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .cells import BUILDING, GROUND, Settings, rows_and_columns
from .expected import Outlook

#: Reasons in the order in which they are named where several hold alike, by the word in the tables.
REASONS = {
    "unsure": "unsure",
    "low_building": "building on ground",
    "raised": "ground raised above all around",
    "edge": "edge of survey",
    "unlike": "unlike anything in training",
    "strips": "classes of two strips disagree",
    "heights": "heights doubtful",
    "other": "like what was wrong elsewhere",
}
#: Share of the cells, those with most to expect, that make patches of their own.
HOT = 0.1
#: A patch has a reason if it holds for this share of its expected errors.
ENOUGH = 0.25
#: Ground is raised, and far from other ground, from so many meters on; a cell is at the edge below this share of neighbors;
#: strips disagree, or heights are doubtful, from this share of the points on.
RAISED, VOID, EDGE, STRIPS, DOUBTFUL = 1.5, 10.0, 0.75, 0.1, 0.1


@dataclass
class Patches:
    """Patches, best first; arrays have one value for each.

    Attributes
    ----------
    of_cell : (cells,) int64
        The patch of each cell of the outlook.
    errors, minutes, area : (n,) float64
        Points expected wrong, minutes to look at it, square meters of its cells.
    points : (n,) int64
    box : (n, 4) float64
        West, south, east, north of its cells, meters.
    tile : (n,) int32
        The number of the file that most of its points are of.
    reasons : list of tuple of str
        Keys of :data:`REASONS`, the strongest first.
    groups : (n, 3) float64
        Ground, vegetation and building points expected wrong.
    """

    of_cell: NDArray[np.int64]
    errors: NDArray[np.float64]
    minutes: NDArray[np.float64]
    area: NDArray[np.float64]
    points: NDArray[np.int64]
    box: NDArray[np.float64]
    tile: NDArray[np.int32]
    reasons: list[tuple[str, ...]]
    groups: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.errors)


def find_patches(seen: Outlook, settings: Settings) -> Patches:
    """The patches of all cells. What is hot in a block is seen at a glance, so it is one patch, and the rest another."""
    records = seen.records
    row, column = rows_and_columns(records.key)
    of_cell = _joined(row, column, _hot(seen.total), max(1, round(settings.block / records.side)))
    n = int(of_cell.max()) + 1 if len(of_cell) else 0

    def summed(values: NDArray) -> NDArray:
        return np.bincount(of_cell, values, n)

    errors, size = summed(seen.total), records.side
    area = summed(np.ones(len(records))) * size**2
    minutes = (settings.getting_there + settings.looking * area / 100.0) / 60.0
    box = np.empty((n, 4))
    for place, values, end in ((0, column, 0), (1, row, 0), (2, column, 1), (3, row, 1)):
        extreme = np.full(n, -np.inf if end else np.inf)
        (np.maximum if end else np.minimum).at(extreme, of_cell, values + end)
        box[:, place] = extreme * size
    # Most errors a minute first; of equals the southern, then the western one.
    order = np.lexsort((box[:, 0], box[:, 1], -np.round(errors / minutes, 9)))
    rank = np.empty(n, np.int64)
    rank[order] = np.arange(n)
    points = records.points.sum(axis=1)
    first = np.lexsort((records.tile, -points, of_cell))
    tile = records.tile[first[np.searchsorted(of_cell[first], np.arange(n))]] if n else np.empty(0, np.int32)
    groups = np.stack([summed(seen.errors[:, group]) for group in range(3)], axis=1)
    reasons = _reasons(seen, of_cell, n)
    return Patches(
        rank[of_cell],
        errors[order],
        minutes[order],
        area[order],
        summed(points)[order].astype(np.int64),
        box[order],
        tile[order],
        [reasons[one] for one in order],
        groups[order],
    )


def _hot(errors: NDArray[np.float64]) -> NDArray[np.bool_]:
    """The cells that most is expected of."""
    if not len(errors):
        return np.zeros(0, bool)
    return (errors > 0) & (errors >= np.quantile(errors, 1.0 - HOT))


def _joined(
    row: NDArray[np.int64], column: NDArray[np.int64], hot: NDArray[np.bool_], across: int
) -> NDArray[np.int64]:
    """(n,) the patch of each cell, numbered from 0 without gaps: the hot cells of a block, and its others."""
    block = np.stack([row // across, column // across, hot], axis=1)
    return np.unique(block, axis=0, return_inverse=True)[1].reshape(-1)


def _reasons(seen: Outlook, of_cell: NDArray[np.int64], n: int) -> list[tuple[str, ...]]:
    """Why each patch is looked at: what holds where its errors are expected."""
    found, errors = seen.found, seen.errors
    ground, building = errors[:, GROUND], errors[:, BUILDING]
    total = seen.total
    shares = {
        "unsure": total * np.minimum(found.unsure * 3.0, 1.0),
        "low_building": building * np.minimum(found.contrary * 5.0, 1.0),
        "raised": ground * (found.raised >= RAISED),
        "edge": total * (found.full < EDGE),
        "unlike": total * seen.unknown,
        "strips": total * (found.strips >= STRIPS),
        "heights": total * ((found.doubtful >= DOUBTFUL) | (found.void >= VOID)),
    }
    whole = np.maximum(np.bincount(of_cell, total, n), 1e-12)
    table = np.stack([np.bincount(of_cell, share, n) / whole for share in shares.values()], axis=1)
    names = list(shares)
    order = np.argsort(-np.round(table, 6), axis=1, kind="stable")
    out = []
    for share, places in zip(table, order, strict=True):
        named = tuple(names[place] for place in places if share[place] >= ENOUGH)
        out.append(named or ("other",))
    return out
