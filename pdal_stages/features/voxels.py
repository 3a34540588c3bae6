"""One point for each voxel."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import OptionError
from ..base.grid import compact_keys
from ..base.hashing import hash_rows
from ..base.jit import njit

#: Smallest and largest side of voxels, meters.
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
    rows: npt.NDArray[Any]
    #: Those of them, by their place in `rows`, ascending, that stand for a point that was asked
    #: for; None: all.
    wanted: npt.NDArray[np.int64] | None
    _members: npt.NDArray[Any]  # points asked for, by representative
    _start: npt.NDArray[Any]

    def members(
        self, block: npt.NDArray[np.int64] | slice
    ) -> tuple[npt.NDArray[Any], npt.NDArray[np.int64]]:
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

    `side` is a voxel's, in meters as `xyz`; 0 for none. `values` (n,) are what else is known of
    the points, and decide between points of the same coordinates. `rows` (m,) are the points asked
    for; the others are represented too, but are not listed. `there` (k,) are the points that are
    there at all, `rows` among them (default: all n). Both ascend.
    """
    check_side(side)
    small = np.int32 if len(xyz) < 2**31 else np.int64
    by = _one_each(xyz, side, values, there) if side and len(xyz) else None
    if by is None and there is None:
        return None
    is_kept = np.zeros(len(xyz), np.bool_)
    is_kept[there if by is None else by] = True  # by itself for points that are not there
    if there is not None:
        gone = np.ones(len(xyz), np.bool_)
        gone[there] = False
        is_kept[gone] = False
        rows = there if rows is None else rows
    kept = np.flatnonzero(is_kept)
    place: npt.NDArray[Any] = np.cumsum(is_kept, dtype=small)
    np.subtract(place, 1, out=place)
    if by is not None:
        place = place[by]
    start = np.zeros(len(kept) + 1, small)
    asked = np.arange(0) if rows is None else rows
    members = np.empty(len(place) if rows is None else len(asked), small)
    list_members(place, rows is None, asked, start, members)
    wanted = np.flatnonzero(np.diff(start))
    return Representatives(
        kept.astype(small), None if 0 < len(wanted) == len(kept) else wanted, members, start
    )


def _one_each(
    xyz: npt.NDArray[np.float64],
    side: float,
    values: Iterable[npt.ArrayLike],
    there: npt.NDArray[np.int64] | None,
) -> npt.NDArray[Any] | None:
    """(n,) the point that stands for each, its own row for those not there; None where no voxel holds two."""
    keys, _ = compact_keys(xyz, side)
    if there is None:
        order = np.argsort(keys)
    else:
        order = there[np.argsort(keys[there])]
    by = np.arange(len(xyz), dtype=np.int32 if len(xyz) < 2**31 else np.int64)
    single = choose_one_each(order, keys[order], hash_rows([*xyz.T, *values], 0), by)
    return None if single else by


@njit
def choose_one_each(order, keys, hashes, by):
    """Fill `by`: of points of equal keys, which follow each other in `order`, the one of the least hash.

    Among equals the first. Whether no two points have the same key.
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
def list_members(place, all_asked, asked, start, members):
    """Fill `members`, the points asked for by their representatives' places, and where each one's begin, `start`."""
    for k in range(len(members)):
        start[place[k if all_asked else asked[k]] + 1] += 1
    for r in range(1, len(start)):
        start[r] += start[r - 1]
    for k in range(len(members)):
        i = k if all_asked else asked[k]
        r = place[i]
        members[start[r]] = i
        start[r] += 1
    for r in range(len(start) - 1, 0, -1):
        start[r] = start[r - 1]
    start[0] = 0
