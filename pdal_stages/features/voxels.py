"""One point for each voxel of an absolute grid: what bounds the cost of a point, and evens out how clouds are sampled.

A sphere of 5 m holds 100,000 points of a drone's cloud, and 50 nearest neighbors there are a hand's breadth: features
take long and mean something else than in the clouds a model was trained on. So each voxel is represented by one of its
points, and the others take its result. Which one it is follows from the points' own coordinates and values: the same in
any order and in any tile that holds whole voxels.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..base.errors import OptionError
from ..base.hashing import hash_of
from ..base.runs import begins_run
from .cells import cell_keys

#: Smallest and largest side in meters.
SMALLEST, LARGEST = 1e-4, 5.0


def check_side(side: float) -> float:
    """A side there can be, 0 for no voxels; OptionError for others."""
    if side != 0 and not SMALLEST <= side <= LARGEST:
        raise OptionError(f"'voxel' must be 0, or {SMALLEST:g} to {LARGEST:g} m", found=f"{side:g}")
    return side


@dataclass(frozen=True, eq=False)
class Representatives:
    """Points that stand for others."""

    #: The representatives' rows in the cloud, ascending.
    rows: npt.NDArray[np.int64]
    #: Those of them, by their place in `rows`, ascending, that stand for a point that was asked for; None: all.
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
    side: float,
    values: Iterable[npt.ArrayLike] = (),
    rows: npt.NDArray[np.int64] | None = None,
    there: npt.NDArray[np.int64] | None = None,
) -> Representatives | None:
    """Representatives of a cloud's points, or None where each stands for itself.

    `side` is a voxel's, in meters as `xyz`; 0 for none. `values` (k,) are what else is known of the points that are there,
    and decide between points of the same coordinates. `rows` (m,) are the points asked for; the others are represented
    too, but are not listed. `there` (k,) are the points that are there at all, `rows` among them (default: all n).
    Both ascend.
    """
    check_side(side)
    found = _one_each(xyz if there is None else xyz[there], side, values)
    if there is None:
        if found is None:
            return None
        kept, by = found
    else:
        kept, place = found or (np.arange(len(there)), np.arange(len(there)))
        by = np.zeros(len(xyz), np.int64)
        kept, by[there] = there[kept], place
        rows = there if rows is None else rows
    if rows is not None:
        by = by[rows]
    members = np.argsort(by, kind="stable")
    start = np.zeros(len(kept) + 1, np.int64)
    np.cumsum(np.bincount(by, minlength=len(kept)), out=start[1:])
    asked = np.flatnonzero(np.diff(start))
    wanted = None if 0 < len(asked) == len(kept) else asked
    return Representatives(kept, wanted, members if rows is None else rows[members], start)


def _one_each(
    xyz: npt.NDArray[np.float64], side: float, values: Iterable[npt.ArrayLike]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]] | None:
    """(rows of one point per voxel, place therein of each point's), or None where no voxel holds two."""
    if not side or not len(xyz):
        return None
    keys, _ = cell_keys(xyz, side)
    order = np.argsort(keys)
    first = begins_run(keys[order])
    if first.all():
        return None
    start = np.flatnonzero(first)
    voxel = np.cumsum(first) - 1
    # Of each voxel the point of the least hash, among equals the one that comes first.
    hashes = hash_of([*xyz.T, *values], 0)[order]
    least = hashes == np.minimum.reduceat(hashes, start)[voxel]
    chosen = np.minimum.reduceat(np.where(least, order, len(xyz)), start)
    is_kept = np.zeros(len(xyz), np.bool_)
    is_kept[chosen] = True
    by = np.empty(len(xyz), np.int64)
    by[order] = (np.cumsum(is_kept) - 1)[chosen][voxel]
    return np.flatnonzero(is_kept), by
