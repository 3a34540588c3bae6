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
class Representatives:
    """Points that stand for others."""

    #: The representatives' rows in the cloud, ascending.
    rows: npt.NDArray
    #: Those of them, by their place in `rows`, ascending, that stand for a point that was asked
    #: for; None: all.
    wanted: npt.NDArray[np.int64] | None
    _members: npt.NDArray  # points asked for, by representative
    _start: npt.NDArray

    def members(
        self, block: npt.NDArray[np.int64] | slice
    ) -> tuple[npt.NDArray, npt.NDArray[np.int64]]:
        """Return the points that a block of representatives stands for, and their place in it."""
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
    present: npt.NDArray[np.int64] | None = None,
) -> Representatives | None:
    """Return representatives of a cloud's points, or None where each stands for itself.

    `side` is a voxel's, in meters as `xyz`; 0 for none. `values` (n,) are what else is known of
    the points, and decide between points of the same coordinates. `rows` (m,) are the points asked
    for; the others are represented too, but are not listed. `present` (k,) are the points that are
    there at all, `rows` among them (default: all n). Both ascend.
    """
    check_side(side)
    small = np.int32 if len(xyz) < 2**31 else np.int64
    by = _one_each(xyz, side, values, present) if side and len(xyz) else None
    if by is None and present is None:
        return None
    is_kept = np.zeros(len(xyz), np.bool_)
    is_kept[present if by is None else by] = True  # by itself for points that are not there
    if present is not None:
        gone = np.ones(len(xyz), np.bool_)
        gone[present] = False
        is_kept[gone] = False
        rows = present if rows is None else rows
    kept = np.flatnonzero(is_kept)
    place: npt.NDArray = np.cumsum(is_kept, dtype=small)
    np.subtract(place, 1, out=place)
    if by is not None:
        place = place[by]
    place = place if rows is None else place[rows]
    members = np.argsort(place, kind="stable").astype(small)
    start = np.searchsorted(place[members], np.arange(len(kept) + 1)).astype(small)
    members = members if rows is None else rows[members].astype(small)
    wanted = np.flatnonzero(np.diff(start))
    return Representatives(
        kept.astype(small), None if 0 < len(wanted) == len(kept) else wanted, members, start
    )


def _one_each(
    xyz: npt.NDArray[np.float64],
    side: float,
    values: Iterable[npt.ArrayLike],
    present: npt.NDArray[np.int64] | None,
) -> npt.NDArray | None:
    """Return the point (n,) that stands for each; None where no voxel holds two.

    Points that are not `wanted` stand for themselves.
    """
    keys, _ = compact_keys(xyz, side)
    if present is None:
        order = np.argsort(keys)
    else:
        order = present[np.argsort(keys[present])]
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
