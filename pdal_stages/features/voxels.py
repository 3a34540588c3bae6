"""One point for each voxel, which bounds the cost of a point and evens out how clouds are sampled.

A sphere of 5 m holds 100,000 points of a drone's cloud, and 50 nearest neighbors there are a
hand's breadth: features take long and mean something else than in the clouds a model was trained
on. So each voxel is represented by one of its points, and the others take its result. Which one it
is follows from the points' own coordinates and values: the same in any order and in any tile that
holds whole voxels.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..base.errors import OptionError
from ..base.grid import compact_keys
from ..base.hashing import hash_rows
from ..base.jit import njit
from ..base.key_order import order_by_key

#: Smallest side of a voxel, meters: finer than the steps of most coordinates, so that a voxel holds
#: copies of one point alone.
SMALLEST = 1e-4
#: Largest side of a voxel, meters: the largest radius of the presets. Not tuned.
LARGEST = 5.0


def check_side(side: float) -> float:
    """Return a valid side of voxels, 0 for none; OptionError for another."""
    if side != 0 and not SMALLEST <= side <= LARGEST:
        raise OptionError(f"'voxel' must be 0, or {SMALLEST:g} to {LARGEST:g} m", found=f"{side:g}")
    return side


@dataclass(frozen=True, eq=False)
class Members:
    """The points that each of k representatives stands for."""

    _rows: npt.NDArray  #: (m,) rows in the cloud, representative by representative
    _start: npt.NDArray  #: (k + 1,) where those of each begin

    def take(
        self, block: npt.NDArray[np.int64] | slice
    ) -> tuple[npt.NDArray, npt.NDArray[np.int64]]:
        """Return the points that a block of representatives stands for, and their place in it."""
        first, last = self._start[:-1][block], self._start[1:][block]
        number = last - first
        place = np.repeat(np.arange(len(number)), number)
        before = np.cumsum(number) - number
        return self._rows[np.arange(len(place)) + (first - before)[place]], place

    def wanted(self) -> npt.NDArray[np.int64] | None:
        """Return which representatives stand for any point, ascending; None: all."""
        wanted = np.flatnonzero(np.diff(self._start))
        return None if 0 < len(wanted) == len(self._start) - 1 else wanted

    def reorder(self, order: npt.NDArray) -> Members:
        """Return the members of the representatives in another order."""
        rows, start = np.empty_like(self._rows), np.empty_like(self._start)
        copy_members(self._rows, self._start, order, rows, start)
        return Members(rows, start)


@dataclass(frozen=True, eq=False)
class Representatives:
    """Points that stand for others."""

    rows: npt.NDArray  #: (k,) their rows in the cloud, ascending
    members: Members  #: points asked for, by representative


def represent(
    xyz: npt.NDArray[np.float64],
    side: float,
    values: Iterable[npt.ArrayLike] = (),
    rows: npt.NDArray[np.int64] | None = None,
    usable: npt.NDArray[np.bool_] | None = None,
) -> Representatives | None:
    """Return representatives of a cloud's points, or None where each stands for itself.

    `side` is a voxel's, in meters as `xyz`; 0 for none. `values` (n,) are what else is known of
    the points, and decide between points of the same coordinates. `rows` (m,) are the points asked
    for, ascending; the others are represented too, but are not listed. `usable` (n,) tells which
    points are there at all, `rows` among them (default: all).
    """
    check_side(side)
    small = np.int32 if len(xyz) < 2**31 else np.int64
    by = _one_each(xyz, side, values, usable) if side and len(xyz) else None
    if by is None and usable is None:
        return None
    is_kept = np.zeros(len(xyz), np.bool_)
    is_kept[slice(None) if by is None else by] = True  # by itself for points that are not there
    if usable is not None:
        is_kept &= usable
        rows = np.flatnonzero(usable) if rows is None else rows
    kept = np.flatnonzero(is_kept).astype(small)
    place: npt.NDArray = np.cumsum(is_kept, dtype=small)
    np.subtract(place, 1, out=place)
    if by is not None:
        place = place[by]
    place = place if rows is None else place[rows]
    members = np.argsort(place, kind="stable").astype(small)
    start = np.searchsorted(place[members], np.arange(len(kept) + 1)).astype(small)
    members = members if rows is None else rows[members].astype(small)
    return Representatives(kept, Members(members, start))


def _one_each(
    xyz: npt.NDArray[np.float64],
    side: float,
    values: Iterable[npt.ArrayLike],
    usable: npt.NDArray[np.bool_] | None,
) -> npt.NDArray | None:
    """Return the point (n,) that stands for each; None where no voxel holds two.

    Points that are not `usable` stand for themselves.
    """
    keys, _ = compact_keys(xyz, side)
    if usable is None:
        order = order_by_key(keys)
    else:
        there = np.flatnonzero(usable)
        order = there[order_by_key(keys[there])]
    by = np.arange(len(xyz), dtype=np.int32 if len(xyz) < 2**31 else np.int64)
    single = choose_one_each(order, keys[order], hash_rows([*xyz.T, *values], 0), by)
    return None if single else by


@njit
def choose_one_each(order, keys, hashes, by):
    """Fill `by`: of points of equal keys, side by side in `order`, the first with the least hash.

    Return whether no two points have the same key.
    """
    single = True
    n = len(order)
    start = 0
    while start < n:
        end, best = start + 1, order[start]
        while end < n and keys[end] == keys[start]:
            i = order[end]
            if hashes[i] < hashes[best] or (hashes[i] == hashes[best] and i < best):
                best = i
            end += 1
        for k in range(start, end):
            by[order[k]] = best
        single = single and end == start + 1
        start = end
    return single


@njit
def copy_members(rows, start, order, new_rows, new_start):
    """Fill `new_rows` and `new_start` with the members of representatives in another order."""
    end = 0
    for k in range(len(order)):
        new_start[k] = end
        for i in range(start[order[k]], start[order[k] + 1]):
            new_rows[end] = rows[i]
            end += 1
    new_start[len(order)] = end
