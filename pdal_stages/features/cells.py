"""Cells of an absolute grid: means over them and those around them, one point for each, how many points they hold.

Means are of probabilities and of return flags: values are counted in 65535ths and added as whole numbers over a point's own
cell and the cells around it, then divided by the number of points there. So a mean has the same bits for any order of
points, number of threads, and in any tile that holds those cells; and a point costs as much in a dense cloud as in a sparse
one.

One point for each voxel bounds the cost of a point, and evens out how clouds are sampled. A sphere of 5 m holds 100,000
points of a drone's cloud, and 50 nearest neighbors there are a hand's breadth: features take long and mean something else
than in the clouds a model was trained on. So each voxel is represented by one of its points, and the others take its
result. Which one it is follows from the points' own coordinates and values: the same in any order and in any tile that
holds whole voxels.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.arrays import begins_run, hash_of
from ..base.errors import OptionError
from ..base.jit import njit
from .index import cell_keys

#: A share of 1.
WHOLE = 65535
#: Smallest and largest side of voxels, and of the cells whose points are counted for the density, in meters.
SMALLEST, LARGEST, CELL = 1e-4, 5.0, 2.0


def cell_means(
    coordinates: npt.NDArray[np.float64],
    shares: npt.NDArray[np.uint16],
    side: float,
    votes: bool = False,
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float32]]:
    """(cell of each point, means (cells, columns) over each cell and those around it).

    Two coordinates make columns of any height; they and `side`, one of :data:`SIDES`, are in meters. `shares` (n, columns)
    are in 65535ths; with `votes` the largest column of each point counts alone, as a whole.
    """
    keys, offsets = cell_keys(coordinates, side)
    order = np.argsort(keys)
    keys = keys[order]
    start = np.append(np.flatnonzero(begins_run(keys)), len(keys))
    occupied = keys[start[:-1]]
    cell = np.empty(len(keys), np.int32)
    del keys
    sums = np.zeros((len(occupied), shares.shape[1] + 1), np.int64)
    add_cells(order, start, shares, votes, cell, sums)
    means = np.empty((len(occupied), shares.shape[1]), np.float32)
    average_around(occupied, sums, offsets, means)
    return cell, means


def density(xyz: npt.NDArray[np.float64]) -> float:
    """Points per square meter: the median over the occupied cells of :data:`CELL` meters, 0 for an empty cloud.

    Strays, holes and the cloud's outline do not matter, and the order of the points does not.
    """
    if not len(xyz):
        return 0.0
    keys, _ = cell_keys(xyz[:, :2], CELL)
    keys.sort()
    starts = np.flatnonzero(begins_run(keys))
    return float(np.median(np.diff(np.append(starts, len(keys))))) / CELL**2


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
    #: Those of them, by their place in `rows`, ascending, that stand for a point that was asked for; None: all.
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

    `side` is a voxel's, in meters as `xyz`; 0 for none. `values` (n,) are what else is known of the points,
    and decide between points of the same coordinates. `rows` (m,) are the points asked for; the others are represented
    too, but are not listed. `there` (k,) are the points that are there at all, `rows` among them (default: all n).
    Both ascend.
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
    keys, _ = cell_keys(xyz, side)
    if there is None:
        order = np.argsort(keys)
    else:
        order = there[np.argsort(keys[there])]
    by = np.arange(len(xyz), dtype=np.int32 if len(xyz) < 2**31 else np.int64)
    single = choose_one_each(order, keys[order], hash_of([*xyz.T, *values], 0), by)
    return None if single else by


# ---- kernels --------------------------------------------------------------------------------------------


@njit
def add_cells(order, start, shares, votes, cell, sums):
    """Fill `cell` with each point's, and `sums` with each cell's shares (or votes) and, last, its points."""
    classes = shares.shape[1]
    for k in range(len(start) - 1):
        for j in range(start[k], start[k + 1]):
            i = order[j]
            cell[i] = k
            if votes:
                best = 0
                for c in range(1, classes):
                    if shares[i, c] > shares[i, best]:
                        best = c
                sums[k, best] += WHOLE
            else:
                for c in range(classes):
                    sums[k, c] += np.int64(shares[i, c])
        sums[k, classes] = start[k + 1] - start[k]


@njit
def average_around(keys, sums, offsets, means):
    """Fill `means`: over each cell and those around it, sums of shares / (WHOLE x points)."""
    classes = sums.shape[1] - 1
    rows = len(offsets)
    cursor = np.zeros(rows, np.int64)
    total = np.empty(classes + 1, np.int64)
    n = len(keys)
    for k in range(n):
        total[:] = 0
        for r in range(rows):
            middle = keys[k] + offsets[r]
            at = cursor[r]
            while at < n and keys[at] < middle - 1:
                at += 1
            cursor[r] = at
            while at < n and keys[at] <= middle + 1:
                for c in range(classes + 1):
                    total[c] += sums[at, c]
                at += 1
        whole = float(total[classes]) * WHOLE
        for c in range(classes):
            means[k, c] = float(total[c]) / whole


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
