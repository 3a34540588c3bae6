"""Classes that contradict their surroundings, mended by named rules, each of which counts what it changes.

A classifier looks at each point by itself. What is left are contradictions that a person sees at once: a building that
the ground filter calls ground, a patch of ground on a roof, a leaf in the middle of a roof or wall, one point against all
its neighbors. Neighborhoods are cubes of voxels of an absolute grid and their sums are whole numbers, so neither the order
of points nor the tile matters.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..base.asprs import NOISE
from ..base.errors import OptionError, StageError
from ..base.vegetation import by_height

#: Rules in the order in which they are applied.
RULES = ("ground", "islands", "roofs", "facades", "lone")
#: Side of a voxel, meters.
SIDE = 1.0
#: How many voxels to each side a rule looks.
_LOOKS = {"ground": 2, "islands": 1, "roofs": 1, "facades": 1, "lone": 1}
GROUND, VEGETATION, BUILDING = 2, (3, 4, 5), 6
#: Kinds of points that rules know.
_GROUND, _VEGETATION, _BUILDING, _OTHER = range(4)
#: Ground lies at most this far above the terrain, and nothing above this height is ground, meters.
LOW, HIGH = 0.3, 2.0
#: Neighbors that are enough to judge by, and the share of them that must be buildings, or of one kind.
ENOUGH, SHARE = 10, 0.9
#: A plane's greatest scatter, its least extent (standard deviations), and how far from it a point may lie, meters.
SCATTER, EXTENT, NEAR = 0.1, 0.3, 0.2
#: A wall leans less than this (vertical part of its normal), a roof more; a wall's least standard deviation of heights.
UPRIGHT, TALL = 0.2, 0.6
#: Coordinates in a voxel are whole numbers of this part of a meter, so that their sums are exact.
_PARTS = 1024.0


def reach(rules: Iterable[str] = RULES) -> float:
    """How far away points can change a point's class, meters: each rule reads what those before it made."""
    return (sum(_LOOKS[rule] for rule in rules) + 1) * SIDE  # and the point's own voxel


def consistent(
    xyz: ArrayLike,
    codes: ArrayLike,
    *,
    height: ArrayLike | None = None,
    ground: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    change: ArrayLike | None = None,
    rules: Sequence[str] = RULES,
    vegetation_heights: tuple[float, float] | None = None,
    figures: dict[str, Any] | None = None,
) -> NDArray[np.uint8]:
    """Class codes without the contradictions that the rules know.

    Parameters
    ----------
    xyz : array_like, shape (n, 3)
        Coordinates in meters.
    codes : array_like of uint8, shape (n,)
        Class codes; only ground (2), vegetation (3, 4, 5) and buildings (6) are changed, and into one another.
    height : array_like, shape (n,), optional
        Height above ground, meters; without it the rules ``ground`` and ``islands`` do nothing.
    ground : array_like, shape (n,), optional
        Whether a ground filter calls the point ground; without it the same.
    mask, change : array_like of bool, shape (n,), optional
        Points that are neighbors, and of these, those that may be changed; by default all.
    rules : sequence of str
        Some of :data:`RULES`: ``ground``: a building that the filter calls ground, below 0.3 m and away from all
        that stands, is ground. ``islands``: ground more than 2 m above the terrain is what its neighbors are. ``roofs``:
        vegetation in the plane of a roof is building. ``facades``: vegetation in the plane of a wall is building.
        ``lone``: one point against all its neighbors is of their class.
    vegetation_heights : pair of float, optional
        Below these heights, meters, what becomes vegetation is low (3) and medium (4), above high (5). Without them it is
        what most vegetation in the voxels around is, high where there is none.
    figures : dict, optional
        Receives the number of points that each rule changed.

    Returns
    -------
    ndarray of uint8, shape (n,)

    Raises
    ------
    OptionError
        If a rule is not known.
    StageError
        If shapes differ, or there are limits for heights and no heights.
    """
    if unknown := [rule for rule in rules if rule not in RULES]:
        raise OptionError(f"'rules' must be of {', '.join(RULES)}", found=", ".join(map(repr, unknown)))
    xyz = np.asarray(xyz, np.float64)
    out = np.array(codes, np.uint8)
    given = [np.asarray(a) for a in (height, ground, mask, change) if a is not None]
    if xyz.shape != (len(out), 3) or any(a.shape != out.shape for a in given):
        raise StageError("arrays must have one row per point", found=[xyz.shape, *(a.shape for a in given)])
    if vegetation_heights is not None and height is None:
        raise StageError("'vegetation_heights' needs 'height'")
    seen = np.isfinite(xyz).all(axis=1) & ~np.isin(out, NOISE)
    if mask is not None:
        seen &= np.asarray(mask, bool)
    counts = dict.fromkeys((rule for rule in RULES if rule in rules), 0)
    there = np.flatnonzero(seen)
    if len(there):
        high, flat = None, None if ground is None else np.asarray(ground)[there] != 0
        if height is not None:
            high = np.asarray(height, np.float64)[there]
        points = _Points(xyz, there, out[there], high, flat)
        free = points.kind != _OTHER
        if change is not None:
            free &= np.asarray(change, bool)[there]
        before = points.kind.copy()
        for rule in counts:
            rows, new = _RULES[rule](points)
            rows, new = rows[free[rows]], np.broadcast_to(new, rows.shape)[free[rows]]
            counts[rule] = int(np.count_nonzero(points.kind[rows] != new))
            points.kind[rows] = new
        other = np.flatnonzero(points.kind != before)
        made = np.array([GROUND, VEGETATION[-1], BUILDING], np.uint8)[points.kind[other]]
        if vegetation_heights is not None and high is not None:
            by_height(made, np.ones(len(made), bool), high[other], vegetation_heights)
        else:
            leaves = made == VEGETATION[-1]
            made[leaves] = points.vegetation_near(other[leaves], out[there])
        out[there[other]] = made
    if figures is not None:
        figures.update(counts)
    return out


class _Points:
    """Points sorted into voxels: their kinds, and what lies around them."""

    def __init__(self, xyz, rows, codes, height, flat) -> None:
        self.xyz, self.rows, self.height, self.flat = xyz, rows, height, flat
        kinds = np.full(256, _OTHER, np.uint8)
        kinds[GROUND], kinds[list(VEGETATION)], kinds[BUILDING] = _GROUND, _VEGETATION, _BUILDING
        self.kind = kinds[codes]
        key, self.strides = np.zeros(len(rows), np.int64), np.ones(3, np.int64)
        room = 1
        for axis in (2, 1, 0):
            number = np.floor(xyz[rows, axis] / SIDE)
            low = number.min() - 2.0  # room for neighbors
            self.strides[axis] = room
            room *= int(number.max() - low) + 3
            if room > 2**62:
                raise StageError(
                    "points lie too far apart for a grid of voxels", cure="Drop stray points first"
                )
            key += (number - low).astype(np.int64) * self.strides[axis]
        self.keys, self.voxel = np.unique(key, return_inverse=True)

    def counts(self, kind: NDArray, kinds: int = 4) -> NDArray[np.int64]:
        """Points of each kind in each voxel, (voxels, kinds)."""
        both = np.bincount(self.voxel * kinds + kind, minlength=len(self.keys) * kinds)
        return both.reshape(-1, kinds)

    def neighbors(self, voxels: NDArray, step: tuple[int, ...]) -> NDArray:
        """The voxel a step away from each, -1 where it holds no points."""
        wanted = self.keys[voxels] + np.dot(step, self.strides)
        at = np.minimum(np.searchsorted(self.keys, wanted), len(self.keys) - 1)
        return np.where(self.keys[at] == wanted, at, -1)

    def around(self, values: NDArray, voxels: NDArray, levels: int = 1) -> NDArray:
        """Sums of values (all voxels, k) over the cube of voxels around some, (voxels, k)."""
        out = np.zeros((len(voxels), values.shape[1]), values.dtype)
        for step in _steps(levels):
            at = self.neighbors(voxels, step)
            out += np.where(at[:, None] >= 0, values[at], 0)
        return out

    def around_points(self, points: NDArray) -> NDArray:
        """Points of each kind in the cubes around the voxels of these points, (points, 4)."""
        voxels, at = np.unique(self.voxel[points], return_inverse=True)
        return self.around(self.counts(self.kind), voxels)[at]

    def vegetation_near(self, points: NDArray, codes: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The commonest class of vegetation around each of these points, the higher of two; where there is none, 5."""
        which = np.full(256, len(VEGETATION))
        which[list(VEGETATION[::-1])] = range(len(VEGETATION))
        voxels, at = np.unique(self.voxel[points], return_inverse=True)
        sums = self.around(self.counts(which[codes]), voxels)[:, : len(VEGETATION)]
        return np.array(VEGETATION[::-1], np.uint8)[sums.argmax(axis=1)][at]

    def places(self, points: NDArray) -> NDArray[np.float64]:
        """Where in their voxels points lie, (m, 3), whole numbers of parts of a meter."""
        xyz = self.xyz[self.rows[points]]
        return np.rint((xyz - np.floor(xyz / SIDE) * SIDE) * _PARTS)


def _steps(levels: int) -> Iterable[tuple[int, ...]]:
    return product((-1, 0, 1), (-1, 0, 1), range(-levels, levels + 1))


_NONE = np.empty(0, np.int64)


def _ground(points: _Points) -> tuple[NDArray, Any]:
    if points.height is None or points.flat is None:
        return _NONE, _GROUND
    built = points.kind == _BUILDING
    wrong = np.flatnonzero(built & points.flat & (points.height < LOW))
    # Feet of walls are labeled building as often as ground, so only what is away from all buildings is changed.
    stands = built & ~points.flat & (points.height > HIGH)
    column = points.keys // points.strides[1]
    steps = [i * points.strides[0] + j * points.strides[1] for i, j in product(range(-2, 3), repeat=2)]
    near = np.unique(column[points.voxel[stands]])[:, None] + np.array(steps) // points.strides[1]
    return wrong[~np.isin(column[points.voxel[wrong]], near)], _GROUND


def _islands(points: _Points) -> tuple[NDArray, Any]:
    if points.height is None or points.flat is None:
        return _NONE, _GROUND
    wrong = np.flatnonzero((points.kind == _GROUND) & ~points.flat & (points.height > HIGH))
    around = points.around_points(wrong)
    some = around[:, _BUILDING] + around[:, _VEGETATION] > 0
    new = np.where(around[:, _BUILDING] >= around[:, _VEGETATION], _BUILDING, _VEGETATION)
    return wrong[some], new[some]


def _in_planes(points: _Points, levels: int, upright: bool) -> tuple[NDArray, Any]:
    """Vegetation in the planes of buildings around it: leaning ones of roofs, or `upright` ones of walls."""
    built = np.flatnonzero(points.kind == _BUILDING)
    counts = points.counts(points.kind)
    green = np.flatnonzero(counts[:, _VEGETATION] > 0)
    if not len(built) or not len(green):
        return _NONE, _BUILDING
    around = points.around(counts, green, levels)
    many = around[:, _BUILDING]
    solid = (many >= ENOUGH) & (many >= SHARE * (many + around[:, _VEGETATION] + around[:, _OTHER]))
    green, many = green[solid], many[solid, None].astype(np.float64)
    # Sums of products of (1, x, y, z), which a step to another voxel changes by one matrix on either side.
    held, number = np.unique(points.voxel[built], return_inverse=True)
    at = np.column_stack([np.full(len(built), 1.0), points.places(built)])
    moments = np.zeros((len(held), 4, 4))
    for i, j in product(range(4), repeat=2):
        moments[:, i, j] = np.bincount(number, at[:, i] * at[:, j], len(held))
    where = np.full(len(points.keys) + 1, -1)  # the last is for no voxel
    where[held] = range(len(held))
    total = np.zeros((len(green), 4, 4))
    for step in _steps(levels):
        other = where[points.neighbors(green, step)]
        moved = np.eye(4)
        moved[1:, 0] = np.array(step) * SIDE * _PARTS
        total[other >= 0] += moved @ moments[other[other >= 0]] @ moved.T
    middle = total[:, 0, 1:] / many
    spread = total[:, 1:, 1:] / many[..., None] - middle[:, :, None] * middle[:, None]
    variance, axes = np.linalg.eigh(spread / _PARTS**2)
    normal = axes[..., 0]
    plane = (variance[:, 0] <= SCATTER**2) & (variance[:, 1] >= EXTENT**2)
    wall = np.abs(normal[:, 2]) < UPRIGHT
    plane &= wall & (spread[:, 2, 2] >= (TALL * _PARTS) ** 2) if upright else ~wall
    of = np.full(len(points.keys), -1)
    of[green[plane]] = np.flatnonzero(plane)
    leaves = np.flatnonzero((points.kind == _VEGETATION) & (of[points.voxel] >= 0))
    mine = of[points.voxel[leaves]]
    away = ((points.places(leaves) - middle[mine]) * normal[mine]).sum(axis=1)
    return leaves[np.abs(away) <= NEAR * _PARTS], _BUILDING


def _lone(points: _Points) -> tuple[NDArray, Any]:
    # Ground under leaves, and leaves above ground, are alone and right.
    counts = points.counts(points.kind)
    alone = np.flatnonzero(
        np.isin(points.kind, (_VEGETATION, _BUILDING)) & (counts[points.voxel, points.kind] == 1)
    )
    around, other = points.around_points(alone), _VEGETATION + _BUILDING - points.kind[alone]
    row, total = np.arange(len(alone)), around.sum(axis=1)
    against = (
        (around[row, points.kind[alone]] == 1) & (total > ENOUGH) & (around[row, other] >= SHARE * total)
    )
    return alone[against], other[against]


_RULES = {
    "ground": _ground,
    "islands": _islands,
    "roofs": lambda points: _in_planes(points, 1, False),
    "facades": lambda points: _in_planes(points, 2, True),
    "lone": _lone,
}
