"""One point for each voxel where a cloud is very dense: what bounds the cost of a point, whatever the sensor.

A sphere of 5 m holds 100,000 points of a drone's cloud, and 50 nearest neighbors there are a hand's breadth: features
take long and mean something else than in the clouds a model was trained on. Where an absolute column of :data:`COLUMN`
metres holds more points than wanted, each voxel in it, of the side at which a level surface has as many points as wanted, is
represented by one of its points, and the others take its result. Which one it is follows from the points' own
coordinates and values: the same in any order and in any tile that holds whole columns.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..base.hashing import coordinate_hash
from .cells import grid_keys
from .index import cell_numbers

#: Side in metres of the columns in which density is looked at; a power of two.
COLUMN = 4.0


def reach(density: float | None) -> float:
    """Metres around a tile that decide which points represent its voxels."""
    return 0.0 if not density else COLUMN + COLUMN / _along(density)


def _along(density: float) -> int:
    """Voxels along a column's side."""
    return max(round(COLUMN * density**0.5), 1)


@dataclass(frozen=True, eq=False)
class Representatives:
    """Points that stand for others.

    Attributes
    ----------
    rows : (m,) int64, ascending
        The representatives' rows in the cloud.
    wanted : (w,) int64, ascending, or None
        Those of them, by their place in `rows`, that stand for a point that was asked for; None: all.
    """

    rows: npt.NDArray[np.int64]
    wanted: npt.NDArray[np.int64] | None
    _members: npt.NDArray[np.int64]  # points asked for, by representative
    _start: npt.NDArray[np.int64]

    def members(
        self, block: npt.NDArray[np.int64] | slice
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """The cloud's points that a block of representatives stands for, and each one's place in the block."""
        first, last = self._start[:-1][block], self._start[1:][block]
        number = last - first
        place = np.repeat(np.arange(len(number)), number)
        before = np.cumsum(number) - number
        return self._members[np.arange(len(place)) + (first - before)[place]], place


def represent(
    xyz: npt.NDArray[np.float64],
    density: float,
    values: Iterable[npt.ArrayLike] = (),
    rows: npt.NDArray[np.int64] | None = None,
) -> Representatives | None:
    """Representatives of a cloud's points, or None where no column holds more than `density`.

    Parameters
    ----------
    xyz : (n, 3) float64
        Coordinates in metres.
    density : float
        Points per square metre of a column above which its voxels get one representative each.
    values : iterable of (n,) arrays
        What else is known of the points; decides between points of the same coordinates.
    rows : (m,) int64, ascending, optional
        Points asked for; the others are represented too, but are nobody's members.
    """
    along = _along(density)
    numbers = [_voxel_numbers(xyz[:, axis], along) for axis in range(3)]
    columns, _ = grid_keys([number // along for number in numbers[:2]])
    _, column, number = np.unique(columns, return_inverse=True, return_counts=True)
    crowded = np.flatnonzero((number > density * COLUMN**2)[column])
    if not len(crowded):
        return None
    keys, _ = grid_keys([number[crowded] for number in numbers])
    lots = coordinate_hash(
        np.column_stack([xyz[crowded], *(np.asarray(column, np.float64)[crowded] for column in values)]), 0
    )
    order = np.lexsort((lots, keys))
    first = np.append(True, keys[order[1:]] != keys[order[:-1]])
    chosen = crowded[order[first]]
    represented = np.arange(len(xyz))  # by whom
    represented[crowded[order]] = chosen[np.cumsum(first) - 1]
    keep = np.zeros(len(xyz), np.bool_)
    keep[represented] = True
    kept = np.flatnonzero(keep)
    by = np.searchsorted(kept, represented if rows is None else represented[rows])
    members = np.argsort(by, kind="stable")
    start = np.zeros(len(kept) + 1, np.int64)
    np.cumsum(np.bincount(by, minlength=len(kept)), out=start[1:])
    wanted = None if rows is None else np.flatnonzero(np.diff(start))
    return Representatives(kept, wanted, members if rows is None else rows[members], start)


def _voxel_numbers(values: npt.NDArray[np.float64], along: int) -> npt.NDArray[np.int64]:
    """Numbers of the voxels; those of a column lie in it whatever is rounded."""
    column = cell_numbers(values, COLUMN)
    inside = (values - column * COLUMN) * (along / COLUMN)
    return column * along + np.clip(inside.astype(np.int64), 0, along - 1)
