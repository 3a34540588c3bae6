"""Classes that contradict their surroundings, mended by named rules, each of which counts what it changes.

A classifier looks at each point by itself, and at what a pass before said of its surroundings. What is left are
contradictions that a person sees at once: a building that the ground filter calls ground, a clipped hedge that is a
building by a narrow margin, a patch of ground on a roof, a leaf in the middle of a roof's plane or of a wall, one point
against all its neighbors. Neighborhoods are cubes of voxels of an absolute grid, or pieces of such that touch, their sums
whole numbers, so neither the order of points nor the tile matters.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..base.asprs import NOISE
from ..base.errors import OptionError, StageError
from ..base.jit import device, njit
from ..base.unionfind import root as root_of
from ..base.vegetation import HIGH as HIGH_VEGETATION
from ..base.vegetation import by_height
from ..terrain.clusters import BITS, find, voxels

#: Rules in the order in which they are applied.
RULES = ("ground", "doubtful", "islands", "roofs", "facades", "lone")
#: Side of a voxel, meters.
SIDE = 1.0
#: A small piece of building: its greatest extent in voxels, and its least area in columns of voxels. It is doubtful where
#: the mean reliability of its points is below this. As found on labeled surveys that a model had not seen: of those from
#: 0.6 to 0.7 all gain; a survey's own model loses from 0.7 on.
PIECE, AREA, DOUBTFUL = 8, 3, 0.62
#: How far each rule looks around a voxel, in voxels: a small piece, and what it does not touch, is the farthest.
_LOOKS = {"ground": 2, "doubtful": PIECE, "islands": 1, "roofs": 1, "facades": 1, "lone": 1}
GROUND, VEGETATION, BUILDING = 2, (3, 4, 5), 6
#: Kinds of points that rules know.
_GROUND, _VEGETATION, _BUILDING, _OTHER = range(4)
#: Ground, in meters above the terrain at most; and what is surely none, at least.
LOW, HIGH = 0.3, 2.0
#: Neighbors that are enough to say something, and the share of them that must be buildings, or of one kind. As it was found
#: on labeled surveys: with 0.75, one point in eight that a plane claims is a leaf.
ENOUGH, SHARE, ALL = 10, 0.9, 0.9
#: A plane's scatter, and how far from it a point may lie and be of it, meters.
SCATTER, NEAR = 0.1, 0.2
#: Coordinates within a voxel are whole numbers of this part of a meter.
_PARTS = 1024.0
#: Reliabilities are summed as whole numbers of this part, which is what files round them to: of rounded ones the same.
_SHARES = 64.0


def reach(rules: Iterable[str] = RULES) -> float:
    """How far away points can change a point's class, meters: each rule reads what those before it made."""
    return (sum(_LOOKS[rule] for rule in rules) + 1) * SIDE  # and the point's own voxel


def consistent(
    xyz: ArrayLike,
    codes: ArrayLike,
    *,
    height: ArrayLike | None = None,
    ground: ArrayLike | None = None,
    reliability: ArrayLike | None = None,
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
    reliability : array_like, shape (n,), optional
        Probability of the class, 0 or nan where it is not known; without it the rule ``doubtful`` does nothing.
    mask, change : array_like of bool, shape (n,), optional
        Points that are neighbors, and of these, those that may be changed; by default all.
    rules : sequence of str
        Some of :data:`RULES`: ``ground``: a building that the filter calls ground, below 0.3 m and away from all
        that stands, is ground. ``doubtful``: a piece of building that is detached, no longer than 8 m and unsure (a mean
        reliability below 0.62), is vegetation. ``islands``: ground more than
        2 m above the terrain is what its neighbors are. ``roofs``: vegetation in the plane of a roof is building.
        ``facades``: vegetation in the plane of a wall is building. ``lone``: one point against all its neighbors is of their
        class.
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
    given = [np.asarray(a) for a in (height, ground, reliability, mask, change) if a is not None]
    if xyz.shape != (len(out), 3) or any(a.shape != out.shape for a in given):
        raise StageError("arrays must have one row per point", found=[xyz.shape, *(a.shape for a in given)])
    if vegetation_heights is not None and height is None:
        raise StageError("'vegetation_heights' needs 'height'")
    seen = np.ones(len(out), bool) if mask is None else np.asarray(mask, bool)
    seen = seen & ~np.isin(out, NOISE) & np.isfinite(xyz).all(axis=1)
    may = seen if change is None else seen & np.asarray(change, bool)
    counts = dict.fromkeys(rules, 0)
    there = np.flatnonzero(seen)
    if len(out) < 2**31:
        there = there.astype(np.int32)
    if len(there):
        kinds = np.full(256, _OTHER, np.uint8)
        kinds[GROUND], kinds[list(VEGETATION)], kinds[BUILDING] = _GROUND, _VEGETATION, _BUILDING
        place, part = _placed(xyz, there)
        del xyz  # where the caller does not keep them, coordinates are let go of
        sure = None if reliability is None else np.asarray(reliability)[there]
        work = _Neighborhoods(place, part, kinds[out[there]], sure)
        del place, part, sure
        free = may[there] & (work.kind != _OTHER)
        del seen, may
        flat = None if ground is None else np.asarray(ground)[there] != 0
        above = (
            None
            if height is None
            else _Above((np.asarray(height) < LOW)[there], (np.asarray(height) > HIGH)[there])
        )
        before = work.kind.copy()
        for rule in RULES:
            if rule in rules:
                new = _RULES[rule](work, above, flat)
                changed = free & (new != work.kind)
                counts[rule] = int(np.count_nonzero(changed))
                work.kind = np.where(changed, new, work.kind)
        other = work.kind != before
        new = np.array([GROUND, HIGH_VEGETATION, BUILDING, 0], np.uint8)[work.kind[other]]
        if vegetation_heights is not None:
            heights = np.asarray(height, np.float64)[there[other]]
            by_height(new, np.ones(len(new), bool), heights, vegetation_heights)
        else:
            leaves = new == HIGH_VEGETATION
            new[leaves] = work.vegetation_near(np.flatnonzero(other)[leaves], out[there])
        out[there[other]] = new
    if figures is not None:
        figures.update(counts)
    return out


class _Above(NamedTuple):
    """Points below LOW and above HIGH, meters above ground."""

    low: NDArray[np.bool_]
    high: NDArray[np.bool_]


def _placed(xyz: NDArray[np.float64], rows: NDArray[Any]) -> tuple[NDArray[Any], NDArray[np.int16]]:
    """Columns, rows and levels (3, m) of these points' voxels, and (m, 3) where in these they lie."""
    ends = np.array([[math.inf] * 3, [-math.inf] * 3])
    _bounds(xyz, rows, ends)
    small = np.abs(ends).max() < 2**30
    place = np.empty((3, len(rows)), np.int32 if small else np.int64)
    part = np.empty((len(rows), 3), np.int16)
    _split(xyz, rows, place, part)
    return place, part


class _Neighborhoods:
    """Points sorted into voxels, and what is round these."""

    def __init__(
        self,
        place: NDArray[Any],
        part: NDArray[np.int16],
        kind: NDArray[np.uint8],
        reliability: NDArray[np.floating] | None = None,
    ) -> None:
        self.part, self.kind, self.reliability = part, kind, reliability
        column, row, level = place
        self.left, self.bottom = int(column.min()) - 2, int(row.min()) - 2
        self.width = int(column.max()) - self.left + 3
        self.voxel, self.keys, _, self.table = voxels(column, row, level, self.left, self.bottom, self.width)

    def counts(self) -> NDArray[np.int32]:
        """Points of each kind in each voxel, (voxels, 4)."""
        own = np.zeros((len(self.keys), 4), np.int32)
        _count(self.voxel, self.kind, own)
        return own

    def shares(self, own: NDArray[np.int32], wanted: NDArray[np.bool_]) -> NDArray[np.int32]:
        """Points of each kind in the cube of 3 x 3 x 3 voxels round each wanted voxel, (voxels, 4); 0 for the others."""
        sums = np.zeros_like(own)
        _add_round(self.keys, self.table, self.width, own, wanted, sums)
        return sums

    def beside(self, chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Points with one of the chosen in the 5 x 5 columns round their own, at any height."""
        held = np.zeros(len(self.keys), bool)
        held[self.voxel[chosen]] = True
        return self._near(held, 2)[self.voxel]

    def _near(self, held: NDArray[np.bool_], columns: int) -> NDArray[np.bool_]:
        """Voxels with one that is held in the columns around their own, so many to each side, at any height."""
        column = self.keys >> BITS
        around = range(-columns, columns + 1)
        steps = np.array([dj * self.width + di for dj in around for di in around])
        return np.isin(column, (np.unique(column[held])[:, None] + steps).ravel())

    def vegetation_near(self, rows: NDArray[np.int64], codes: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The commonest class of vegetation round each of these points, the higher of two; where there is none, 5."""
        if not len(rows):
            return np.empty(0, np.uint8)
        own, wanted = np.zeros((len(self.keys), 4), np.int32), np.zeros(len(self.keys), bool)
        which = np.full(256, len(VEGETATION), np.uint8)
        which[list(VEGETATION[::-1])] = range(len(VEGETATION))
        _count(self.voxel, which[codes], own)
        wanted[self.voxel[rows]] = True
        most = self.shares(own, wanted)[self.voxel[rows], : len(VEGETATION)].argmax(axis=1)
        return np.array(VEGETATION[::-1], np.uint8)[most]

    def doubtful_pieces(self) -> NDArray[np.bool_]:
        """Points of small detached pieces of building, of whose class they are unsure on average."""
        if self.reliability is None:
            return np.zeros(len(self.voxel), bool)
        of_building = np.bincount(self.voxel[self.kind == _BUILDING], minlength=len(self.keys)) > 0
        root, extent = _pieces(self.keys, self.table, self.width, of_building)
        known = (self.kind == _BUILDING) & (self.reliability > 0)
        piece = root[self.voxel[known]]
        points = np.bincount(piece, minlength=len(self.keys))
        # Sums of whole numbers, so in any order the same.
        total = np.bincount(piece, np.rint(self.reliability[known] * _SHARES), len(self.keys))
        doubtful = (points >= ENOUGH) & (extent <= PIECE) & (total < DOUBTFUL * _SHARES * points)
        mine = np.flatnonzero(of_building & doubtful[root])
        columns = np.unique(np.column_stack([root[mine], self.keys[mine] >> BITS]), axis=0)[:, 0]
        doubtful &= np.bincount(columns, minlength=len(self.keys)) >= AREA
        return (self.kind == _BUILDING) & doubtful[root[self.voxel]]

    def in_planes(self, levels: int, upright: bool) -> NDArray[np.bool_]:
        """Vegetation in planes of buildings near: leaning ones of roofs, or `upright` ones of walls."""
        own = self.counts()
        # Only voxels with buildings have moments, and only those with vegetation beside some are asked for a plane.
        held = own[:, _BUILDING] > 0
        built, green = _numbers(held), _numbers((own[:, _VEGETATION] > 0) & self._near(held, 1))
        moments = np.zeros((int(built.max(initial=-1)) + 1, 10), np.int64)
        _add_moments(self.voxel, self.kind, self.part, built, moments)
        planes = np.full((int(green.max(initial=-1)) + 1, 4), np.nan)
        _fit(self.keys, self.table, self.width, levels, upright, own, built, moments, green, planes)
        near = np.zeros(len(self.voxel), bool)
        _near_planes(self.voxel, self.kind, self.part, green, planes, near)
        return near


def _numbers(chosen: NDArray[np.bool_]) -> NDArray[np.int32]:
    """The chosen ones numbered from 0; -1 for the others."""
    numbers = np.cumsum(chosen, dtype=np.int32)
    numbers -= 1
    numbers[~chosen] = -1
    return numbers


def _ground(work: _Neighborhoods, above: _Above | None, flat) -> NDArray[np.uint8]:
    if above is None or flat is None:
        return work.kind
    wrong = (work.kind == _BUILDING) & flat & above.low
    if not wrong.any():
        return work.kind
    # Feet of walls are labeled building as often as ground, so only what is away from all buildings.
    stands = (work.kind == _BUILDING) & ~flat & above.high
    return np.where(wrong & ~work.beside(stands), np.uint8(_GROUND), work.kind)


def _doubtful(work: _Neighborhoods, above, flat) -> NDArray[np.uint8]:
    return np.where(work.doubtful_pieces(), np.uint8(_VEGETATION), work.kind)


def _islands(work: _Neighborhoods, above: _Above | None, flat) -> NDArray[np.uint8]:
    if above is None or flat is None:
        return work.kind
    wrong = (work.kind == _GROUND) & ~flat & above.high
    if not wrong.any():
        return work.kind
    wanted = np.zeros(len(work.keys), bool)
    wanted[work.voxel[wrong]] = True
    sums = work.shares(work.counts(), wanted)[:, [_VEGETATION, _BUILDING]]
    vegetation, building = sums[work.voxel].T
    new = np.where(building >= vegetation, _BUILDING, _VEGETATION).astype(np.uint8)
    return np.where(wrong & (building + vegetation > 0), new, work.kind)


def _roofs(work: _Neighborhoods, above, flat) -> NDArray[np.uint8]:
    return np.where(work.in_planes(1, False), np.uint8(_BUILDING), work.kind)


def _facades(work: _Neighborhoods, above, flat) -> NDArray[np.uint8]:
    return np.where(work.in_planes(2, True), np.uint8(_BUILDING), work.kind)


def _lone(work: _Neighborhoods, above, flat) -> NDArray[np.uint8]:
    new, own = work.kind.copy(), work.counts()
    alone = (own[:, [_VEGETATION, _BUILDING]] == 1).any(axis=1)
    _take_sides(work.voxel, work.kind, work.shares(own, alone), new)
    return new


_RULES = {
    "ground": _ground,
    "doubtful": _doubtful,
    "islands": _islands,
    "roofs": _roofs,
    "facades": _facades,
    "lone": _lone,
}


# ---- kernels --------------------------------------------------------------------------------------------


@njit
def _bounds(xyz, rows, ends):
    """Widen `ends` (2, 3), lowest and highest, by these points, in voxels."""
    for p in rows:
        for axis in range(3):
            number = math.floor(xyz[p, axis] * (1.0 / SIDE))
            ends[0, axis], ends[1, axis] = min(ends[0, axis], number), max(ends[1, axis], number)


@njit
def _split(xyz, rows, place, part):
    """Fill `place` (3, m) with voxels' columns, rows and levels, `part` (m, 3) with coordinates within these."""
    for i in range(len(rows)):
        p = rows[i]
        for axis in range(3):
            number = math.floor(xyz[p, axis] * (1.0 / SIDE))
            place[axis, i] = number
            part[i, axis] = np.int16(np.rint((xyz[p, axis] - number * SIDE) * _PARTS))


@njit
def _count(voxel, kind, own):
    for p in range(len(voxel)):
        own[voxel[p], kind[p]] += 1


@njit
def _pieces(keys, table, w, chosen):
    """The voxel that stands for each one's piece of chosen voxels that touch, and for these the extent in plan."""
    n = len(keys)
    parent = np.arange(n).astype(np.int32)
    for k in range(n):
        if not chosen[k]:
            continue
        for dj in range(2):
            for di in range(-1, 2):
                for dl in range(-1, 2):
                    if dj * 9 + di * 3 + dl > 0:
                        q = find(table, keys, keys[k] + ((dj * w + di) << BITS) + dl)
                        if q >= 0 and chosen[q]:
                            a, b = root_of(parent, k), root_of(parent, q)
                            if a < b:
                                parent[b] = a
                            else:
                                parent[a] = b
    box = np.empty((n, 4), np.int64)
    root = np.empty(n, np.int32)
    for k in range(n):
        r = root_of(parent, k)
        root[k] = r
        place = keys[k] >> BITS
        j, i = place // w, place % w
        if r == k:  # the first of its piece
            box[r, 0] = box[r, 1] = j
            box[r, 2] = box[r, 3] = i
        box[r, 0], box[r, 1] = min(box[r, 0], j), max(box[r, 1], j)
        box[r, 2], box[r, 3] = min(box[r, 2], i), max(box[r, 3], i)
    extent = np.empty(n, np.int64)
    for k in range(n):
        extent[k] = max(box[root[k], 1] - box[root[k], 0], box[root[k], 3] - box[root[k], 2]) + 1
    return root, extent


@njit
def _take_sides(voxel, kind, sums, new):
    """Give points that are alone against all their neighbors these ones' kind; `sums` are those round each voxel."""
    for p in range(len(voxel)):
        near = sums[voxel[p]]
        # Ground under leaves, and leaves above ground, are alone and right.
        if near[kind[p]] != 1 or kind[p] == _GROUND:
            continue
        n, most = 0, 0
        for k in range(4):
            n += near[k]
            most = k if near[k] > near[most] else most
        if n > ENOUGH and near[most] >= ALL * n and most != _OTHER and most != _GROUND:
            new[p] = most


@njit
def _add_round(keys, table, w, own, wanted, sums):
    """Fill `sums` of the wanted voxels with those of the cubes of 3 x 3 x 3 voxels round them."""
    for k in range(len(keys)):
        if not wanted[k]:
            continue
        for dj in range(-1, 2):
            for di in range(-1, 2):
                for dl in range(-1, 2):
                    q = find(table, keys, keys[k] + ((dj * w + di) << BITS) + dl)
                    if q >= 0:
                        for c in range(own.shape[1]):
                            sums[k, c] += own[q, c]


@njit
def _add_moments(voxel, kind, part, built, moments):
    for p in range(len(voxel)):
        if kind[p] == _BUILDING:
            m = moments[built[voxel[p]]]
            x, y, z = np.int64(part[p, 0]), np.int64(part[p, 1]), np.int64(part[p, 2])
            m[0] += 1
            m[1] += x
            m[2] += y
            m[3] += z
            m[4] += x * x
            m[5] += x * y
            m[6] += x * z
            m[7] += y * y
            m[8] += y * z
            m[9] += z * z


@device
def _shifted(m, dx, dy, dz, total):
    """Add moments, as seen from a voxel that lies so far away."""
    n, x, y, z = m[0], m[1], m[2], m[3]
    total[0] += n
    total[1] += x + n * dx
    total[2] += y + n * dy
    total[3] += z + n * dz
    total[4] += m[4] + 2 * dx * x + n * dx * dx
    total[5] += m[5] + dx * y + dy * x + n * dx * dy
    total[6] += m[6] + dx * z + dz * x + n * dx * dz
    total[7] += m[7] + 2 * dy * y + n * dy * dy
    total[8] += m[8] + dy * z + dz * y + n * dy * dz
    total[9] += m[9] + 2 * dz * z + n * dz * dz


@njit
def _fit(keys, table, w, levels, upright, own, built, moments, green, planes):
    """Fill `planes` (normal, distance from the voxel's corner; meters) of buildings round voxels with vegetation."""
    total = np.empty(10, np.int64)
    side = np.int64(SIDE * _PARTS)
    for k in range(len(keys)):
        if green[k] < 0:
            continue
        total[:] = 0
        points = 0
        for dj in range(-1, 2):
            for di in range(-1, 2):
                for dl in range(-levels, levels + 1):
                    q = find(table, keys, keys[k] + ((dj * w + di) << BITS) + dl)
                    if q >= 0:
                        points += own[q, _VEGETATION] + own[q, _BUILDING] + own[q, _OTHER]
                        if built[q] >= 0:
                            _shifted(moments[built[q]], di * side, dj * side, dl * side, total)
        n = total[0]
        if n < ENOUGH or n < SHARE * points:
            continue
        x, y, z = total[1] / n, total[2] / n, total[3] / n
        xx, xy, xz = total[4] / n - x * x, total[5] / n - x * y, total[6] / n - x * z
        yy, yz, zz = total[7] / n - y * y, total[8] / n - y * z, total[9] / n - z * z
        if upright:
            # The narrow direction in plan; a wall is tall, and long.
            half, apart = 0.5 * (xx + yy), np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
            wide, narrow = half + apart, half - apart
            if narrow > (SCATTER * _PARTS) ** 2 or wide < (0.4 * _PARTS) ** 2 or zz < (0.6 * _PARTS) ** 2:
                continue
            a, b = xy, narrow - xx
            if abs(a) + abs(b) < 1e-6 * wide:
                a, b = narrow - yy, xy
            length = np.sqrt(a * a + b * b)
            if length == 0.0:
                continue
            a, b, c = a / length, b / length, 0.0
        else:
            det = xx * yy - xy * xy
            if det < (0.09 * _PARTS * _PARTS) ** 2:
                continue
            gx, gy = (xz * yy - yz * xy) / det, (yz * xx - xz * xy) / det
            length = np.sqrt(1.0 + gx * gx + gy * gy)
            scatter = (zz - gx * xz - gy * yz) / (length * length)
            if scatter > (SCATTER * _PARTS) ** 2 or gx * gx + gy * gy > 4.0:
                continue
            a, b, c = -gx / length, -gy / length, 1.0 / length
        at = green[k]
        planes[at, 0], planes[at, 1], planes[at, 2] = a, b, c
        planes[at, 3] = a * x + b * y + c * z


@njit
def _near_planes(voxel, kind, part, green, planes, near):
    for p in range(len(voxel)):
        if kind[p] == _VEGETATION:
            k = green[voxel[p]]
            if k < 0:
                continue
            away = (
                planes[k, 0] * part[p, 0]
                + planes[k, 1] * part[p, 1]
                + planes[k, 2] * part[p, 2]
                - planes[k, 3]
            )
            near[p] = abs(away) <= NEAR * _PARTS
