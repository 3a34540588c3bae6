"""Classes that contradict their surroundings, mended by named rules, each of which counts what it changes.

Neighborhoods are cubes of voxels of an absolute grid and their sums are whole numbers, so neither the order of points nor
the tile matters.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import places_among
from ..base.jit import njit
from ..base.las import NOISE, by_height
from ..features.index import cell_keys

#: Rules in the order in which they are applied, and how many voxels to each side they look.
RULES = {"ground": 2, "islands": 1, "lone": 1}
#: Side of a voxel, meters.
SIDE = 1.0
GROUND, VEGETATION, BUILDING = 2, (3, 4, 5), 6
#: Kinds of points that rules know.
_GROUND, _VEGETATION, _BUILDING, _OTHER = range(4)
#: Ground lies at most this far above the terrain, and nothing above this height is ground, meters.
LOW, HIGH = 0.3, 2.0
#: Neighbors that are enough to judge by, and the share of them that must be of one kind.
ENOUGH, SHARE = 10, 0.9
_NONE = np.empty(0, np.int64)


def reach(rules: Iterable[str] = RULES) -> float:
    """How far away points can change a point's class, meters: each rule reads what those before it made."""
    return (sum(RULES[rule] for rule in rules) + 1) * SIDE  # and the point's own voxel


def consistent(
    xyz: NDArray[np.float64],
    codes: NDArray[np.uint8],
    *,
    height: NDArray | None = None,
    ground: NDArray | None = None,
    mask: NDArray[np.bool_] | None = None,
    change: NDArray[np.bool_] | None = None,
    rules: Sequence[str] = tuple(RULES),
    vegetation_heights: tuple[float, float] | None = None,
) -> tuple[NDArray[np.uint8], dict[str, int]]:
    """Class codes without the contradictions that the rules know, and the number of points that each rule changed.

    Parameters
    ----------
    xyz : (n, 3) float64
        Coordinates in meters.
    codes : (n,) uint8
        Class codes; only ground (2), vegetation (3, 4, 5) and buildings (6) are changed, and into one another.
    height, ground : (n,) ndarray, optional
        Height above ground, meters, and whether a ground filter calls the point ground; without either the rules
        ``ground`` and ``islands`` do nothing.
    mask, change : (n,) bool, optional
        Points that are neighbors, and of these, those that may be changed; by default all.
    rules : sequence of str
        Some of :data:`RULES`: ``ground``: a building that the filter calls ground, below 0.3 m, is ground where within
        two columns more is so than stands above 2 m. ``islands``: ground more than 2 m above the terrain is what its
        neighbors are. ``lone``: one point against all its neighbors is of their class.
    vegetation_heights : pair of float, optional
        Below these heights, meters, what becomes vegetation is low (3) and medium (4), above high (5); needs `height`.
        Without them it is what most vegetation in the voxels around is, high where there is none.
    """
    out = np.array(codes, np.uint8)
    seen = np.isfinite(xyz).all(axis=1) & ~np.isin(out, NOISE)
    there = np.flatnonzero(seen if mask is None else seen & mask)
    counts = {rule: 0 for rule in RULES if rule in rules}
    if not len(there):
        return out, counts
    high = None if height is None else np.asarray(height, np.float64)[there]
    flat = None if ground is None else ground[there] != 0
    voxels = _Voxels(xyz, there, out[there], high, flat)
    free = voxels.kind != _OTHER
    if change is not None:
        free &= change[there]
    before = voxels.kind.copy()
    for rule in counts:
        rows, new = getattr(voxels, rule)()
        rows, new = rows[free[rows]], np.broadcast_to(new, rows.shape)[free[rows]]
        counts[rule] = int(np.count_nonzero(voxels.kind[rows] != new))
        voxels.kind[rows] = new
    other = np.flatnonzero(voxels.kind != before)
    made = np.array([GROUND, VEGETATION[-1], BUILDING], np.uint8)[voxels.kind[other]]
    if vegetation_heights is not None and high is not None:
        by_height(made, np.ones(len(made), bool), high[other], vegetation_heights)
    else:
        leaves = made == VEGETATION[-1]
        made[leaves] = voxels.vegetation_near(other[leaves], out[there])
    out[there[other]] = made
    return out, counts


class _Voxels:
    """Points sorted into voxels, and the rules: each gives the points that it would change, and their kinds."""

    def __init__(self, xyz, rows, codes, height, flat) -> None:
        self.xyz, self.rows, self.height, self.flat = xyz, rows, height, flat
        kinds = np.full(256, _OTHER, np.uint8)
        kinds[GROUND], kinds[list(VEGETATION)], kinds[BUILDING] = _GROUND, _VEGETATION, _BUILDING
        self.kind = kinds[codes]
        keys, self.offsets = cell_keys(xyz[rows], SIDE)
        self.keys, self.voxel = np.unique(keys, return_inverse=True)

    def counts(self, kind: NDArray) -> NDArray[np.int64]:
        """Points of each of four kinds in each voxel, (voxels, 4)."""
        return np.bincount(self.voxel * 4 + kind, minlength=len(self.keys) * 4).reshape(-1, 4)

    def around(self, points: NDArray, kind: NDArray) -> NDArray[np.int64]:
        """Points of each kind in the cubes of voxels around those of these points, (points, 4)."""
        voxels, at = np.unique(self.voxel[points], return_inverse=True)
        before = np.insert(self.counts(kind).cumsum(axis=0), 0, 0, axis=0)
        total = np.zeros((len(voxels), 4), np.int64)
        _add_columns(self.keys, self.keys[voxels], self.offsets, before, total)
        return total[at]

    def vegetation_near(self, points: NDArray, codes: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The commonest class of vegetation around each of these points, the higher of two; where there is none, 5."""
        which = np.full(256, 3)
        which[list(VEGETATION[::-1])] = range(3)
        around = self.around(points, which[codes])[:, :3]
        return np.array(VEGETATION[::-1], np.uint8)[around.argmax(axis=1)]

    def ground(self) -> tuple[NDArray, Any]:
        if self.height is None or self.flat is None:
            return _NONE, _GROUND
        built = self.kind == _BUILDING
        low, stands = (
            built & self.flat & (self.height < LOW),
            built & ~self.flat & (self.height > HIGH),
        )
        # Feet of walls are labeled building as often as ground, so it is changed where more is low than stands.
        x, y = np.floor(self.xyz[self.rows, :2] / SIDE).T.astype(np.int64)
        column, at = np.unique((y << 32) + x, return_inverse=True)
        more = np.bincount(at, 1.0 * low - stands)
        own, of = np.unique(at[low], return_inverse=True)
        total = np.zeros(len(own))
        for i, j in product(range(-2, 3), repeat=2):
            place, there = places_among(column, column[own] + (i << 32) + j)
            total += more[place] * there
        return np.flatnonzero(low)[total[of] > 0], _GROUND

    def islands(self) -> tuple[NDArray, Any]:
        if self.height is None or self.flat is None:
            return _NONE, _GROUND
        wrong = np.flatnonzero((self.kind == _GROUND) & ~self.flat & (self.height > HIGH))
        _, green, built, _ = self.around(wrong, self.kind).T
        some = built + green > 0
        return wrong[some], np.where(built >= green, _BUILDING, _VEGETATION)[some]

    def lone(self) -> tuple[NDArray, Any]:
        # Ground under leaves, and leaves above ground, are alone and right.
        counts = self.counts(self.kind)
        judged = np.isin(self.kind, (_VEGETATION, _BUILDING))
        alone = np.flatnonzero(judged & (counts[self.voxel, self.kind] == 1))
        own = self.kind[alone]
        around, other = self.around(alone, self.kind), _VEGETATION + _BUILDING - own
        row, total = np.arange(len(alone)), around.sum(axis=1)
        against = (around[row, own] == 1) & (total > ENOUGH) & (around[row, other] >= SHARE * total)
        return alone[against], other[against]


@njit
def _add_columns(keys, asked, steps, before, total):
    """Add to `total` (n, 4) the points in three voxels, one above the other, at steps from those asked for, in order."""
    for step in steps:
        first = end = 0
        for k in range(len(asked)):
            while first < len(keys) and keys[first] < asked[k] + step - 1:
                first += 1
            while end < len(keys) and keys[end] <= asked[k] + step + 1:
                end += 1
            for kind in range(4):
                total[k, kind] += before[end, kind] - before[first, kind]
